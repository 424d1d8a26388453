"""Variants of a robot model: with more or less armature, or with a payload."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from impact_posture.config.checked import checked
from impact_posture.config.demand import Factors, Positive
from impact_posture.config.json_block import jsonable
from impact_posture.errors import InputError
from impact_posture.robot.joint_model import with_joint_model
from impact_posture.robot.robot import Robot

AS_MODELED = "as modeled"
# Largest number of variants, because the optimization contains a separate model for every variant.
MOST_VARIANTS = 12


@checked
@dataclass(frozen=True)
class Payload:
    """A point mass (kg) at the origin of a frame."""

    frame: str
    mass: Positive


@dataclass(frozen=True, eq=False)
class ModelVariant:
    """Possible model of the robot: a factor on the armature in robot.toml, and an optional payload."""

    name: str
    robot: Robot
    armature_factor: float = 1.0
    payload: Payload | None = None

    def to_dict(self) -> dict[str, object]:
        """Return the fields of the variant for JSON."""
        return {
            "name": self.name,
            "armature_factor": self.armature_factor,
            "payload": jsonable(self.payload),
            "model_sha256": self.robot.model_sha256,
        }


@checked
def build_model_variants(
    robot: Robot, armature_range: Factors | None, payloads: Sequence[Payload]
) -> tuple[ModelVariant, ...]:
    """Return all combinations of an armature factor (1, lowest or highest) and a payload (none, or one of them).

    ``armature_range`` contains the lowest and the highest factor.  The first variant is the unchanged robot.  The
    result is empty if there are neither a range nor payloads.

    Raises:
        InputError: A range or mass is invalid, the armature is zero, or there are too many variants.
        FrameNotFound: The robot lacks the frame of a payload.
    """
    factors = _factors(robot, armature_range)
    for payload in payloads:
        robot.frame_id(payload.frame)
        if robot.model.frames[robot.frame_id(payload.frame)].parentJoint == 0:
            fault = f"frame '{payload.frame}' is welded to the world, where a mass changes nothing"
            raise InputError(fault, where="payload", hint="choose a frame on a moving link")
        if payloads.count(payload) > 1:
            fault = f"{payload.mass:g} kg at '{payload.frame}' is given twice"
            raise InputError(fault, where="payload", hint="remove one of them")
    variants = tuple(_variant(robot, factor, payload) for payload in (None, *payloads) for factor in factors)
    if len(variants) > MOST_VARIANTS:
        hint = f"give at most {MOST_VARIANTS} combinations"
        raise InputError(f"{len(variants)} model variants, each a separate model", where="payload", hint=hint)
    return variants if len(variants) > 1 else ()


def _factors(robot: Robot, armature_range: tuple[float, float] | None) -> list[float]:
    if armature_range is None:
        return [1.0]
    low, high = armature_range
    armature = np.asarray(robot.model.armature)
    if not armature[np.isfinite(armature)].any():
        none = robot.armature.any() and f"no armature with the joint model '{robot.joint_model}'"
        fault = f"{robot.name} has {none or 'no armature'}, so a factor changes nothing"
        hint = "leave it out" if none else "state an armature with `armature` or in robot.toml"
        raise InputError(fault, where="armature_range", hint=hint)
    return [1.0, *sorted({low, high} - {1.0})]


def _variant(robot: Robot, factor: float, payload: Payload | None) -> ModelVariant:
    if factor == 1 and payload is None:
        return ModelVariant(AS_MODELED, robot)
    words, model = [], pin.Model(robot.model)
    model.armature = factor * robot.armature
    if factor != 1:
        words.append(f"armature × {factor:g}")
    if payload is not None:
        words.append(f"{payload.mass:g} kg at {payload.frame}")
        frame = model.frames[robot.frame_id(payload.frame)]
        mass = pin.Inertia(payload.mass, np.array(frame.placement.translation), np.zeros((3, 3)))
        model.inertias[frame.parentJoint] = model.inertias[frame.parentJoint] + mass
    stated = replace(robot, model=model, stated_armature=None)
    return ModelVariant(", ".join(words), with_joint_model(stated, robot.joint_model), factor, payload)


def between(variants: Sequence[ModelVariant], count: int, seed: int) -> list[Robot]:
    """Return ``count`` random robots between the variants of :func:`build_model_variants`.

    Each robot has a random factor on the armature, and one of the payloads with a random fraction of its mass.
    """
    generator = np.random.default_rng(seed)
    factors = [variant.armature_factor for variant in variants]
    payloads = [variant.payload for variant in variants if variant.payload is not None]
    robots = []
    for _ in range(count):
        # Draw the logarithm of the factor uniformly, because the factors 1/2 and 2 are then equally far from 1.
        factor = float(np.exp(generator.uniform(np.log(min(factors)), np.log(max(factors)))))
        payload = None
        if payloads:
            whole = payloads[generator.integers(len(payloads))]
            payload = replace(whole, mass=float(generator.uniform(0, whole.mass)))
        robots.append(_variant(variants[0].robot, factor, payload).robot)
    return robots
