"""The velocity jump of an impact by name and unit, and the share of each joint in ``H``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impact_posture.config.json_block import json_block
from impact_posture.dynamics.joints import joint_kind
from impact_posture.impact.quantities.impact_quantities import ImpactQuantities
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.model_joints import v_slice
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array


@dataclass(frozen=True, eq=False)
class Jump:
    """A predicted velocity jump.

    Attributes:
        velocity: ``Δν``, shape (nv,), m/s and rad/s.
        norm: ``‖Δν‖_W``.
        impulse: Impulse of the surface on the robot, world, shape (3,), N·s.
        largest: ``(name, value, unit)`` of the largest entries, largest first.
    """

    velocity: Array
    norm: float
    impulse: Array
    largest: tuple[tuple[str, float, str], ...]

    @property
    def impulse_size(self) -> float:
        """Size of the impulse, N·s."""
        return float(np.linalg.norm(self.impulse))

    def to_dict(self) -> dict[str, object]:
        """Return JSON content."""
        largest = [{"name": name, "value": value, "unit": unit} for name, value, unit in self.largest]
        return json_block(self) | {"largest": largest}


@dataclass(frozen=True)
class Dominance:
    """Whether one light joint makes up most of ``H``.

    Attributes:
        joint: The joint with the largest share.
        share: Its share of ``H = Σ a_i (Wa)_i``.
        base: Share of the floating base; zero for a fixed base.
        line: The finding in words.
    """

    joint: str
    share: float
    base: float
    line: str

    @property
    def dominates(self) -> bool:
        """Whether the joint carries more than half of ``H``."""
        return self.share > 0.5

    def to_dict(self) -> dict[str, object]:
        """Return JSON content."""
        return json_block(self) | {"dominates": self.dominates}


def tangent_units(robot: Robot) -> tuple[str, ...]:
    """Return ``m/s`` or ``rad/s`` for each of the nv velocity entries."""
    units: list[str] = []
    for index in range(1, robot.model.njoints):
        subspace = joint_kind(robot.model.joints[index], str(robot.model.names[index])).subspace
        units += ["m/s" if np.abs(column[:3]).max() > 0 else "rad/s" for column in subspace.T]
    return tuple(units)


def largest_entries(robot: Robot, values: Array) -> tuple[tuple[str, float, str], ...]:
    """Return ``(name, value, unit)`` of the five largest entries of a tangent vector, above 0.1 % of the first."""
    units = tangent_units(robot)
    return tuple((robot.tangent_names[k], float(values[k]), units[k]) for k in _largest(np.abs(values), 5))


def _largest(sizes: Array, count: int) -> list[int]:
    """Return the indices of the largest sizes, largest first, above 0.1 % of the first."""
    order = np.argsort(-sizes, kind="stable")[:count]
    return [int(k) for k in order if sizes[k] > 1e-3 * sizes[order[0]]]


def merged_entries(
    robot: Robot, *jumps: Jump | None, count: int = 6
) -> list[tuple[str, str, tuple[float | None, ...]]]:
    """Return ``(name, unit, values)`` of the entries that are largest in any jump; ``None`` for a missing jump."""
    units, names = tangent_units(robot), robot.tangent_names
    sizes = np.max([np.zeros(robot.nv), *(np.abs(j.velocity) for j in jumps if j is not None)], axis=0)
    return [
        (names[k], units[k], tuple(None if j is None else float(j.velocity[k]) for j in jumps))
        for k in _largest(sizes, count)
    ]


def weighed_jump(objective: WorstCaseObjective, velocity: Array, impulse: Array) -> Jump:
    """Measure the jump ``velocity``, shape (nv,), in the metric at the posture of the oracle."""
    norm = float(np.sqrt(max(float(velocity @ objective.oracle.weigh(velocity)), 0.0)))
    return Jump(velocity, norm, impulse, largest_entries(objective.robot, velocity))


def find_dominance(objective: WorstCaseObjective, found: ImpactQuantities) -> Dominance:
    """Find the joint with the largest share of H: the sum of ``a_i (Wa)_i / H`` over its entries."""
    robot, oracle = objective.robot, objective.oracle
    parts = found.jump * oracle.weigh(found.jump)
    width = 6 if robot.floating else 0
    if found.H <= 0 or not robot.joint_names:
        return Dominance("", 0.0, float(found.H > 0), "no joint takes part in H")
    base = float(parts[:width].sum() / found.H)
    slots = {name: v_slice(robot.model, robot.joint_id(name)) for name in robot.joint_names}
    shares = {name: float(parts[slot].sum() / found.H) for name, slot in slots.items()}
    joint = max(shares, key=lambda name: shares[name])
    share, k = shares[joint], slots[joint].start
    percent = f"{100 * share:.0f} %"
    if share > 0.5:
        unit = "kg" if tangent_units(robot)[k] == "m/s" else "kg·m²"
        line = (
            f"joint '{joint}' carries {percent} of H (armature {robot.model.armature[k]:.3g} of the "
            f"{oracle.M[k, k]:.3g} {unit} it moves)"
        )
        if objective.metric.kind != "kinetic":
            line += ("; the rest of the robot hardly counts" if share > 0.9 else "") + ": compare `metric` kinetic"
    elif base > 0.5:
        line = (
            f"no single joint dominates H (the base carries {100 * base:.0f} %; largest joint: '{joint}', {percent})"
        )
    else:
        line = f"no single joint dominates H (largest: '{joint}', {percent})"
    return Dominance(joint, share, base, line)
