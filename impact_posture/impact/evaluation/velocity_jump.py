"""The predicted velocity jump of an impact at an approach speed, with the coefficient of restitution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impact_posture.config.json_block import json_block
from impact_posture.dynamics.joints import joint_kind
from impact_posture.impact.quantities.impact_quantities import ImpactQuantities
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array


@dataclass(frozen=True, eq=False)
class Jump:
    """A predicted velocity jump.

    Attributes:
        velocity: ``Δν``, shape (nv,), m/s and rad/s.
        norm: ``‖Δν‖_W``.
        impulse: Impulse of the surface on the robot, world, shape (3,), N·s.
        largest: ``(name, value, unit)`` of the largest entries in descending order.
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


def tangent_units(robot: Robot) -> tuple[str, ...]:
    """Return ``m/s`` or ``rad/s`` for each of the nv velocity entries."""
    units: list[str] = []
    for index in range(1, robot.model.njoints):
        subspace = joint_kind(robot.model.joints[index], str(robot.model.names[index])).subspace
        units += ["m/s" if np.abs(column[:3]).max() > 0 else "rad/s" for column in subspace.T]
    return tuple(units)


def largest_entries(robot: Robot, values: Array) -> tuple[tuple[str, float, str], ...]:
    """Return ``(name, value, unit)`` of the five largest entries of a tangent vector above 0.1 % of the largest."""
    units = tangent_units(robot)
    return tuple((robot.tangent_names[k], float(values[k]), units[k]) for k in _largest(np.abs(values), 5))


def _largest(sizes: Array, count: int) -> list[int]:
    """Return the indices of the largest sizes above 0.1 % of the largest, in descending order."""
    order = np.argsort(-sizes, kind="stable")[:count]
    return [int(k) for k in order if sizes[k] > 1e-3 * sizes[order[0]]]


def merged_entries(
    robot: Robot, *jumps: Jump | None, count: int = 6
) -> list[tuple[str, str, tuple[float | None, ...]]]:
    """Return ``(name, unit, values)`` of the entries that are largest in any jump; value ``None`` for no jump."""
    units, names = tangent_units(robot), robot.tangent_names
    sizes = np.max([np.zeros(robot.nv), *(np.abs(j.velocity) for j in jumps if j is not None)], axis=0)
    return [
        (names[k], units[k], tuple(None if j is None else float(j.velocity[k]) for j in jumps))
        for k in _largest(sizes, count)
    ]


def frictionless_jump(objective: WorstCaseObjective, quantities: ImpactQuantities, rebound: float) -> Jump | None:
    """Return ``Δν = (1+e) v_n a/G`` with the impulse ``(1+e) v_n/G`` along n; ``None`` if the contact is blocked.

    ``rebound`` is ``(1+e) v_n`` with the coefficient of restitution e and the approach speed v_n, m/s.
    """
    if quantities.blocked:
        return None
    G = quantities.G
    return weighed_jump(objective, quantities.jump * rebound / G, quantities.normal * rebound / G)


def sticking_jump(objective: WorstCaseObjective, quantities: ImpactQuantities, rebound: float) -> Jump | None:
    """Return ``Δν = (1+e) v_n M⁻¹Jᵀ(JM⁻¹Jᵀ)⁻¹ n``, arguments as :func:`frictionless_jump`; ``None`` without S."""
    if quantities.sticking_jump is None or quantities.sticking_impulse is None:
        return None
    return weighed_jump(objective, quantities.sticking_jump * rebound, quantities.sticking_impulse * rebound)


def weighed_jump(objective: WorstCaseObjective, velocity: Array, impulse: Array) -> Jump:
    """Return the jump ``velocity``, shape (nv,), with its norm at the last posture of the oracle."""
    norm = float(np.sqrt(max(float(velocity @ objective.oracle.weigh(velocity)), 0.0)))
    return Jump(velocity, norm, impulse, largest_entries(objective.robot, velocity))
