"""The predicted velocity jump of an impact at an approach speed, with the coefficient of restitution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impact_posture.config.json_block import JsonBlock
from impact_posture.impact.evaluation.impact_effect import ImpactEffect, impact_effect, tangent_units
from impact_posture.impact.quantities.impact_quantities import ImpactQuantities
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array


@dataclass(frozen=True, eq=False)
class Jump(JsonBlock):
    """A predicted velocity jump.

    Attributes:
        velocity: Velocity jump ``Δν``, shape (nv,), m/s and rad/s.
        norm: Norm ``‖Δν‖_W`` of the jump, with the weight matrix ``W`` of the metric.
        impulse: Impulse of the surface on the robot, world axes, shape (3,), N·s.
        normal_impulse: Part of the impulse along the normal, N·s.
        effect: Jump of the base and of the worst joint.
        largest: Largest entries of ``Δν`` as ``(name, value, unit)``, in descending order.
    """

    velocity: Array
    norm: float
    impulse: Array
    normal_impulse: float
    effect: ImpactEffect
    largest: tuple[tuple[str, float, str], ...]

    @property
    def impulse_size(self) -> float:
        """Magnitude of the impulse, friction included, N·s."""
        return float(np.linalg.norm(self.impulse))

    def to_dict(self) -> dict[str, object]:
        """Return JSON content."""
        largest = [{"name": name, "value": value, "unit": unit} for name, value, unit in self.largest]
        return super().to_dict() | {"largest": largest}


def largest_entries(robot: Robot, values: Array) -> tuple[tuple[str, float, str], ...]:
    """Return up to five entries of a tangent vector as ``(name, value, unit)``, in descending order of size.

    Entries below 0.1 % of the largest entry are omitted.
    """
    units = tangent_units(robot)
    return tuple((robot.tangent_names[k], float(values[k]), units[k]) for k in _largest(np.abs(values), 5))


def _largest(sizes: Array, count: int) -> list[int]:
    order = np.argsort(-sizes, kind="stable")[:count]
    return [int(k) for k in order if sizes[k] > 1e-3 * sizes[order[0]]]


def merged_entries(
    robot: Robot, *jumps: Jump | None, count: int = 6
) -> list[tuple[str, str, tuple[float | None, ...]]]:
    """Return ``(name, unit, values)`` of the velocity entries that are largest in any of the jumps.

    ``values`` has one value per jump; the value is ``None`` for a jump that is ``None``.
    """
    units, names = tangent_units(robot), robot.tangent_names
    sizes = np.max([np.zeros(robot.nv), *(np.abs(j.velocity) for j in jumps if j is not None)], axis=0)
    return [
        (names[k], units[k], tuple(None if j is None else float(j.velocity[k]) for j in jumps))
        for k in _largest(sizes, count)
    ]


def normal_jump(speed: float, restitution: float) -> float:
    """Return ``(1+e) v_n``, by which the impact changes the normal velocity of the contact point, m/s."""
    return (1 + restitution) * speed


def frictionless_jump(objective: WorstCaseObjective, quantities: ImpactQuantities, rebound: float) -> Jump | None:
    """Return the jump ``Δν = (1+e) v_n a/G``, whose impulse along n is ``(1+e) v_n/G``.

    ``rebound`` is :func:`normal_jump`, m/s.  Return ``None`` if the contact cannot move along the normal.
    """
    if quantities.blocked:
        return None
    G = quantities.G
    return weighed_jump(objective, quantities.jump * rebound / G, quantities.normal * rebound / G)


def sticking_jump(objective: WorstCaseObjective, quantities: ImpactQuantities, rebound: float) -> Jump | None:
    """Return the jump ``Δν = (1+e) v_n M⁻¹Jᵀ(JM⁻¹Jᵀ)⁻¹ n``; ``None`` if S does not exist.

    The arguments are as in :func:`frictionless_jump`.
    """
    if quantities.sticking_jump is None or quantities.sticking_impulse is None:
        return None
    return weighed_jump(objective, quantities.sticking_jump * rebound, quantities.sticking_impulse * rebound)


def weighed_jump(objective: WorstCaseObjective, velocity: Array, impulse: Array) -> Jump:
    """Return a :class:`Jump` from ``velocity``, shape (nv,), at the last posture of the oracle.

    ``impulse`` acts at the first contact, world axes, shape (3,).
    """
    norm = float(np.sqrt(max(float(velocity @ objective.oracle.weigh(velocity)), 0.0)))
    along = float(objective.oracle.n @ impulse)
    effect = impact_effect(objective.robot, velocity)
    return Jump(velocity, norm, impulse, along, effect, largest_entries(objective.robot, velocity))
