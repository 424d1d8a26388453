"""Effective inertia of an arm with elastic joints in an impact: predictions compared with impacts in MuJoCo."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise

import numpy as np

from docs.studies.core import Request, machine, say, table
from docs.studies.elastic.figure import draw
from docs.studies.elastic.world import ElasticWorld, Measured
from impact_posture.impact.elasticity.elastic_impact import ElasticImpact
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.robot.joint_model import with_joint_model
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import load_robot
from impact_posture.robot.robot_spec import JointTransmissionSpec, TransmissionSpec
from impact_posture.system.optional_package import import_mujoco
from tests.support.arms import TIP, seven_joints
from tests.support.helpers import rng, unit

SPEED = 0.5  # approach speed, m/s
# Number of contact stiffnesses for each posture.  The stiffnesses are chosen such that x, computed with the
# compression time of the links alone, is between 0.05 and 2.
STIFFNESSES = 10
LEAST, LARGEST = 0.05, 2.0
# A normal is left out if the joints move the contact point along it by less than this value, m/rad.
_REACH = 0.15
EDGES = (0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0, 2.0)
MODELS = ("elastic", "link", "reflected")
# Stiffness of joints 1 to 4 and 5 to 7 of an arm with strain wave gears, N m/rad.  It is assumed for arms without a
# published stiffness.
ASSUMED = (14e3,) * 4 + (9e3,) * 3


@dataclass(frozen=True)
class Studied:
    """Robot, its contact frame, its elastic joints with their stiffness, and a description of the stiffness."""

    load: Callable[[], Robot]
    frame: str
    joints: tuple[str, ...]
    stiffness: tuple[float, ...]
    words: str

    @cache  # noqa: B019 (kept as long as the program runs)
    def robot(self) -> Robot:
        """Return the robot with springs at these joints and at no others."""
        loaded = self.load()
        springs = {
            name: JointTransmissionSpec("elastic", K) for name, K in zip(self.joints, self.stiffness, strict=True)
        }
        return replace(loaded, spec=replace(loaded.spec, transmission=TransmissionSpec(joints=springs)))


def panda() -> Robot:
    """Return the arm with rigid fingers."""
    return load_robot("panda", lock=("panda_finger_joint*",))


def talos_arm() -> Robot:
    """Return the right arm of TALOS, with a fixed pelvis and all other joints rigid."""
    return load_robot("talos", root="fixed", lock=("leg_*", "torso_*", "head_*", "arm_left_*", "gripper_*"))


STUDIED = {
    "panda": Studied(
        panda, "panda_hand_tcp", tuple(f"panda_joint{k}" for k in range(1, 8)), ASSUMED,
        "fingers rigid, springs of 14 (joints 1 to 4) and 9 kN m/rad **assumed**",
    ),
    "own arm": Studied(
        seven_joints, TIP, tuple(f"joint_{k}" for k in range(7)), (150.0,) * 7,
        "seven hinges between rods of 0.2 kg, rotors of 0.01 kg m², springs of 150 N m/rad, made up",
    ),
    "talos arm": Studied(
        talos_arm, "gripper_right_base_link", tuple(f"arm_right_{k}_joint" for k in range(1, 8)), ASSUMED,
        "right arm; the pelvis is fixed, all other joints are rigid, and the springs of `panda` are **assumed**",
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Row:
    """Errors of the predictions of all models for one impact."""

    robot: str
    x: float  # x for the compression time of the elastic response
    x_links: float  # x for the compression time of the links alone
    y: float  # rotation of the links' velocity jump by the springs during the compression
    error: dict[str, float]  # relative error of the peak link velocity, by model
    force_error: dict[str, float]
    torque_error: float  # relative error of the largest spring torque, elastic model


def rows_of(name: str, count: int, seed: int) -> Iterator[Row]:
    """Yield impacts of a robot in random postures with random normals and all contact stiffnesses."""
    studied = STUDIED[name]
    arm, generator = studied.robot(), rng(name, seed)
    low, high = (np.array(limit) for limit in (arm.model.lowerPositionLimit, arm.model.upperPositionLimit))
    low, high = np.maximum(low, -np.pi), np.minimum(high, np.pi)
    done = 0
    while done < count:
        q, n = generator.uniform(low, high), unit(generator)
        case = ImpactCase(arm, ImpactContact(studied.frame, tuple(n)))
        impact = ElasticImpact(case)
        oracle = impact.oracle.at(q)
        j = oracle.n @ oracle.J
        if np.linalg.norm(j[impact.joints]) < _REACH:
            continue
        done += 1
        rigid = {model: ImpactOracle(replace(case, robot=with_joint_model(arm, model))) for model in MODELS[1:]}
        quantities = {model: rigid_oracle.quantities(q) for model, rigid_oracle in rigid.items()}
        compliance = float(np.sum(j[impact.joints] ** 2 / impact.kappa))
        world = ElasticWorld(impact)
        a = oracle.solve(j)
        pull = np.zeros(arm.nv)
        pull[impact.joints] = impact.kappa * a[impact.joints]
        turning = float(np.sqrt(np.linalg.norm(oracle.solve(pull)) / np.linalg.norm(a)))
        for place in np.arange(STIFFNESSES) + generator.random(STIFFNESSES):
            x = LEAST * (LARGEST / LEAST) ** (place / STIFFNESSES)
            stiffness = (np.pi / 2 / x) ** 2 / compliance
            response = impact.response(q, stiffness, SPEED)
            if not LEAST <= response.compliance_ratio <= LARGEST:
                continue
            measured: Measured = world.compress(q, stiffness, SPEED, response.duration)
            peaks = {"elastic": response.peak_jump_norm}
            forces = {"elastic": response.force}
            for model, values in quantities.items():
                peaks[model], forces[model] = SPEED * np.sqrt(values.V), SPEED * np.sqrt(stiffness / values.G)
            yield Row(
                name, response.compliance_ratio, x, measured.duration * turning,
                {model: abs(value / measured.peak - 1) for model, value in peaks.items()},
                {model: abs(value / measured.force - 1) for model, value in forces.items()},
                float(np.abs(response.peak_torque - measured.torque).max() / measured.torque.max()),
            )  # fmt: skip


def lines(request: Request) -> Iterator[str]:
    """Yield results and tables, and draw the figure if the page is written."""
    import_mujoco()
    began = time.perf_counter()
    rows: list[Row] = []
    for name in (name for name in STUDIED if request.only in name):
        rows += rows_of(name, request.count, request.seed)
        say(f"{name}: {len(rows)} impacts, {time.perf_counter() - began:.0f} s")
    yield f"{request.count} random postures and normals (seed {request.seed}) of each robot, {len(rows)} impacts:"
    yield ""
    yield from (f"- `{name}`: {arm.words}; `{arm.frame}`" for name, arm in STUDIED.items() if request.only in name)
    yield from ("", f"Approach speed {SPEED:g} m/s, plastic, no damping. Errors are relative errors of norms.", "")
    yield from ("### Results", "", *_verdicts(rows, request), "")
    yield from ("### Error of the peak link velocity: median (largest), %", "")
    yield from (*_errors(rows, "error"), "", "### Error of the peak force: median (largest), %", "")
    yield from (*_errors(rows, "force_error"), "", "### Elastic model by robot: largest error, %", "")
    yield from table(
        ["robot", "impacts", "peak link velocity", "peak force", "largest spring torque"],
        [
            [name, str(len(own)), *(_percent(max(values)) for values in (
                [row.error["elastic"] for row in own], [row.force_error["elastic"] for row in own],
                [row.torque_error for row in own],
            ))]
            for name in STUDIED if (own := [row for row in rows if row.robot == name])
        ],
    )  # fmt: skip
    if request.write:
        draw(rows)
    say(f"{machine('mujoco')}; {time.perf_counter() - began:.0f} s")


def _verdicts(rows: Sequence[Row], request: Request) -> Iterator[str]:
    """Yield whether goals are met, and the range of x in which each rule of thumb is valid."""
    for model, values, goal, where in (
        ("elastic", "error", 0.10, "peak link velocity"), ("elastic", "force_error", 0.15, "peak force"),
    ):  # fmt: skip
        largest = max(getattr(row, values)[model] for row in rows)
        verdict = "met" if largest <= goal else "missed"
        if largest > goal:
            request.missed.append(f"{model} within {goal:.0%} of the {where}: {largest:.1%}")
        yield f"- `{model}` within {goal:.0%} of the {where} in every impact: **{verdict}**, {largest:.1%} at most."
    rules: tuple[tuple[str, float, str, Callable[[Row], bool]], ...] = (
        ("link", 0.20, "x ≤ 0.2", lambda row: row.x <= 0.2),
        ("link", 0.20, "x ≤ 0.2 with the time of the links alone", lambda row: row.x_links <= 0.2),
        ("link", 0.20, "y ≤ 1.5", lambda row: row.y <= 1.5),
        ("reflected", 0.17, "x ≥ 0.75", lambda row: row.x >= 0.75),
        ("reflected", 0.17, "x ≥ 0.75 with the time of the links alone", lambda row: row.x_links >= 0.75),
    )
    for model, goal, words, holds in rules:
        own = np.array([row.error[model] for row in rows if holds(row)])
        if len(own):
            yield (
                f"- `{model}` for {words}: peak link velocity within {goal:.0%} in {np.mean(own <= goal):.0%} of "
                f"{len(own)} impacts; median {np.median(own):.0%}, largest {own.max():.0%}."
            )
    best = np.array([min(row.error["link"], row.error["reflected"]) for row in rows if 0.2 < row.x < 0.75])
    yield (
        f"- For x between 0.2 and 0.75 the better of `link` and `reflected` is off by {np.median(best):.0%} in the "
        f"median and {best.max():.0%} at most."
    )


def _errors(rows: Sequence[Row], which: str) -> Iterator[str]:
    """Return a table of errors.  Rows are ranges of x, columns are models."""
    body = []
    for low, high in pairwise(EDGES):
        own = [getattr(row, which) for row in rows if low <= row.x < high]
        cells = [f"{low:g} – {high:g}", str(len(own))]
        for model in MODELS:
            errors = [error[model] for error in own]
            cells.append(f"{_percent(float(np.median(errors)))} ({_percent(max(errors))})" if own else "–")
        body.append(cells)
    yield from table(["x", "impacts", *MODELS], body)


def _percent(value: float) -> str:
    return f"{100 * value:.2g}" if value < 0.1 else f"{100 * value:.0f}"
