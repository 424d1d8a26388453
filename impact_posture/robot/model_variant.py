"""The same robot under other assumptions: more or less armature, a payload."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from impact_posture.errors import InputError
from impact_posture.robot.robot import Robot

AS_MODELED = "as modeled"
# Each variant is a model of its own in the program.
MOST_VARIANTS = 12


@dataclass(frozen=True)
class Payload:
    """A point mass at the origin of a frame.

    Attributes:
        frame: The frame that carries it.
        mass: kg.
    """

    frame: str
    mass: float


@dataclass(frozen=True, eq=False)
class ModelVariant:
    """One of the models that the robot may turn out to be.

    Attributes:
        name: What it is called in outputs.
        robot: The robot under its assumptions.
        armature_factor: What the stated armature is multiplied by.
        payload: What it carries besides, or ``None``.
    """

    name: str
    robot: Robot
    armature_factor: float = 1.0
    payload: Payload | None = None

    def to_dict(self) -> dict[str, object]:
        """JSON content."""
        payload = self.payload
        return {
            "name": self.name,
            "armature_factor": self.armature_factor,
            "payload": None if payload is None else {"frame": payload.frame, "mass": payload.mass},
            "model_sha256": self.robot.model_sha256,
        }


def build_model_variants(
    robot: Robot, armature_range: tuple[float, float] | None, payloads: Sequence[Payload]
) -> tuple[ModelVariant, ...]:
    """All pairs of an armature (as stated, lowest, highest) with a payload (none, or one of those given).

    Args:
        robot: As modeled; the first variant.
        armature_range: Factors on the stated armature, lowest and highest.
        payloads: Each is there or not, one at a time.

    Returns:
        Empty where nothing is uncertain.

    Raises:
        InputError: A range or a mass that makes no sense, a factor on an armature of zero, or too many variants.
        FrameNotFound: Of a payload.
    """
    factors = _factors(robot, armature_range)
    for payload in payloads:
        robot.frame_id(payload.frame)
        if not (np.isfinite(payload.mass) and payload.mass > 0):
            raise InputError(
                f"the mass at '{payload.frame}' is {payload.mass:g}", where="payload", hint="give kg above zero"
            )
        if robot.model.frames[robot.frame_id(payload.frame)].parentJoint == 0:
            raise InputError(
                f"frame '{payload.frame}' is welded to the world: a mass there changes nothing",
                where="payload",
                hint="choose a frame on a moving link",
            )
        if payloads.count(payload) > 1:
            raise InputError(f"{payload.mass:g} kg at '{payload.frame}' is given twice", where="payload",
                             hint="remove one")  # fmt: skip
    found = [_variant(robot, factor, payload) for payload in (None, *payloads) for factor in factors]
    if len(found) > MOST_VARIANTS:
        raise InputError(
            f"{len(found)} model variants, each a model of its own",
            where="payload",
            hint=f"have at most {MOST_VARIANTS}",
        )
    return tuple(found) if len(found) > 1 else ()


def _factors(robot: Robot, armature_range: tuple[float, float] | None) -> list[float]:
    if armature_range is None:
        return [1.0]
    low, high = armature_range
    if not (np.isfinite([low, high]).all() and 0 < low <= high):
        raise InputError(
            f"the armature's range is {low:g} to {high:g}",
            where="armature_range",
            hint="give two factors above zero on the stated armature, the lower first, such as 0.5 2",
        )
    if not robot.armature.any():
        raise InputError(
            f"{robot.name} has no armature: a factor on zero changes nothing",
            where="armature_range",
            hint="state one with `armature` or in robot.toml",
        )
    return [1.0, *sorted({low, high} - {1.0})]


def _variant(robot: Robot, factor: float, payload: Payload | None) -> ModelVariant:
    words = []
    model = robot.model
    if factor != 1 or payload is not None:
        model = pin.Model(robot.model)
    if factor != 1:
        words.append(f"armature × {factor:g}")
        model.armature = factor * robot.armature
    if payload is not None:
        words.append(f"{payload.mass:g} kg at {payload.frame}")
        frame = model.frames[robot.frame_id(payload.frame)]
        mass = pin.Inertia(payload.mass, np.array(frame.placement.translation), np.zeros((3, 3)))
        model.inertias[frame.parentJoint] = model.inertias[frame.parentJoint] + mass
    same = robot if model is robot.model else replace(robot, model=model)
    return ModelVariant(", ".join(words) or AS_MODELED, same, factor, payload)


def between(model_variants: Sequence[ModelVariant], count: int, seed: int) -> list[Robot]:
    """Draw robots between model variants, with any factor on the armature and any share of one of the payloads.

    Args:
        model_variants: As :func:`build_model_variants` gives them, the robot as modeled first.
        count: How many.
        seed: Of the draw.
    """
    generator = np.random.default_rng(seed)
    factors = [variant.armature_factor for variant in model_variants]
    payloads = [variant.payload for variant in model_variants if variant.payload is not None]
    found = []
    for _ in range(count):
        # Evenly in the logarithm: half and twice are equally far from what is stated.
        factor = float(np.exp(generator.uniform(np.log(min(factors)), np.log(max(factors)))))
        payload = None
        if payloads:
            whole = payloads[generator.integers(len(payloads))]
            payload = replace(whole, mass=float(generator.uniform(0, whole.mass)))
        found.append(_variant(model_variants[0].robot, factor, payload).robot)
    return found
