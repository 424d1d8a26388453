"""The loads under which a robot has to hold its posture: at rest before the impact, and pushing afterwards."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.tree import PointOnLink
from impact_posture.errors import InputError, listed
from impact_posture.impact.impact_contact import ImpactContact, point_on
from impact_posture.impact.objective import Objective
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.constraints.constraint import Constraint
from impact_posture.posture.constraints.requirements import Requirements
from impact_posture.posture.loads.equilibrium import Equilibrium, Thrusts
from impact_posture.posture.loads.holdable import Holdable, ReachableWrench
from impact_posture.posture.loads.holding_forces import HoldingForces
from impact_posture.posture.loads.static_load import ForceSource, StaticLoad
from impact_posture.robot.actuation import allocation_matrix, thrust_limits, torque_limits
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array

# Number of edges of the pyramid inside a friction cone.
_EDGES = 4
# Upper limit of the friction coefficient.  With a larger coefficient, the edges of the friction pyramid would be
# nearly horizontal and could hardly support weight.
_MOST_FRICTION = 10.0
# Singular values of the map from rotor thrusts and foot forces to the base wrench count as zero below this fraction
# of the largest singular value.
_RANK = 1e-9


@dataclass(frozen=True, eq=False)
class LoadCase:
    """One load that the robot has to hold; ``name`` is for example ``at rest``.

    The rows of ``unreachable``, shape (6 − r, 6), are combinations of the base wrench that rotors and feet cannot
    produce.  Here r is the rank of the map from rotor thrusts and foot forces to the base wrench.  For a fixed base,
    there are no such rows.
    """

    name: str
    description: str
    equilibrium: Equilibrium
    unreachable: Array

    def constraints(self) -> list[Constraint]:
        """Return the constraints for this load."""
        rest, holdable = self.equilibrium, Holdable(self.name, self.equilibrium, self.description)
        if not len(self.unreachable):
            return [holdable]
        load = StaticLoad(rest.load.model, [source for source in rest.load.sources if not source.lower.size])
        return [ReachableWrench(self.name, load, self.unreachable / rest.weight), holdable]


@dataclass(frozen=True, eq=False)
class LoadCases:
    """All loads of a problem, with notes for the user about missing data.

    If ``cases`` is empty, ``unknown`` is the reason.
    """

    cases: tuple[LoadCase, ...] = ()
    notes: tuple[str, ...] = ()
    unknown: str = ""

    def holding(self, q: Array) -> HoldingForces | None:
        """Return the forces that hold ``q`` under all load cases; ``None`` if there are no load cases."""
        if not self.cases:
            return None
        first, *others = [HoldingForces.of(case.name, case.equilibrium, case.unreachable, q) for case in self.cases]
        return replace(first, other_loads=tuple(others))


def load_cases(objective: Objective, q: Array, requirements: Requirements) -> LoadCases:
    """Return the load cases if the data of the robot are sufficient; ``q`` is a posture with the feet in place.

    Before the impact, no force acts on the contact.  If ``hold_force`` is set, the robot must also hold this force
    along the normal of every contact.  For each payload of the robot, the same load cases are added for the robot
    with this payload.

    Raises:
        InputError: ``hold_force`` is set, but the data of the robot are not sufficient.
    """
    robot, force, share = objective.robot, requirements.hold_force, requirements.limit_share
    weight = robot.mass * float(np.linalg.norm(robot.model.gravity.linear))
    rotors = _rotors(robot, weight, share) if robot.floating else []
    feet = _feet(objective, weight, requirements.friction) if robot.floating else []
    # The motor of the leader also moves its followers, which have no motors.
    limits = np.where(robot.followers, np.inf, share * torque_limits(robot.model))
    reach, rank = _reach(StaticLoad(robot.model, [*rotors, *feet]), q) if robot.floating else (np.zeros((0, 6)), 0)
    unknown = ""
    if robot.floating and not (rotors or feet):
        unknown = "there are neither rotors nor feet that could hold the robot up"
    elif feet and rank < 6:
        unknown = f"feet with friction {requirements.friction:g} at these points cannot balance the robot at rest"
    elif not robot.floating and not np.isfinite(limits).any():
        unknown = "no effort limit of a joint is known"
    if unknown and force:
        raise InputError(
            f"{force:g} N cannot be checked: {unknown}", where="hold_force", hint="leave out `hold_force`"
        )
    if unknown:
        return LoadCases((), (f"whether the robot can hold the posture is not checked: {unknown}",), unknown)
    notes = _unlimited(robot)
    kinds = ["joint torques", *["rotor thrusts"] * bool(rotors), *["forces of the feet"] * bool(feet)]
    what = " and ".join([", ".join(kinds[:-1]), kinds[-1]] if kinds[1:] else kinds)
    sources, balance, thrusts = [*rotors, *feet], reach[:rank], Thrusts()
    if rotors and not feet and rank == rotors[0].lower.size:
        # The base wrench determines the thrusts of independent rotors, so these thrusts need no unknowns.
        limit = weight * rotors[0].lower, weight * rotors[0].upper
        thrusts = Thrusts(rotors[0].names, np.asarray(np.linalg.pinv(rotors[0].columns / weight)), *limit)
        sources, balance = [], balance[:0]
    within = "limits" if share == 1 else f"{100 * share:g} % of their limits"
    cases = []
    for model, variant in _models(objective):
        for pushed in (0.0, force) if force else (0.0,):
            pushes = [_push(robot, contact, pushed) for contact in objective.contacts] if pushed else []
            names = robot.tangent_names
            rest = Equilibrium(
                model, [*sources, *pushes], weight, limits, robot.coupling_matrix, balance, thrusts, names
            )
            name = (f"while it pushes with {pushed:g} N" if pushed else "at rest") + variant
            cases.append(LoadCase(name, f"{what} within {within} {name}", rest, reach[rank:]))
    return LoadCases(tuple(cases), tuple(notes))


def _unlimited(robot: Robot) -> list[str]:
    """Return notes that name the joints whose torque is not checked, because no effort limit is known."""
    unlimited = np.isinf(torque_limits(robot.model)) & robot.projector.any(axis=0)
    unlimited[: robot.first_joint] = False
    slots = [slot for slot in Chart.of(robot.model).slots if unlimited[slot.v].any()]
    driven = [slot.name for slot in slots if slot.kind.family in ("revolute", "continuous", "prismatic")]
    passive = [slot.name for slot in slots if slot.name not in driven]
    limit = "no effort limit above zero is stated; state it in robot.toml [limits.effort]"
    torque = f"at rest, the torque of {listed(driven)} is not checked, because {limit}"
    balance = f"at rest, the balance of {listed(passive)} is not checked, because no actuator drives it"
    return [torque] * bool(driven) + [balance] * bool(passive)


def _reach(load: StaticLoad, q: Array) -> tuple[Array, int]:
    """Return orthonormal combinations of the base wrench as rows, the r reachable combinations first, and r."""
    vectors, values, _ = np.linalg.svd(load.torque(q, np.zeros(load.count)).by_force[:6])
    return vectors.T, int((values > _RANK * values.max(initial=0.0)).sum())


def _models(objective: Objective) -> list[tuple[pin.Model, str]]:
    """Return the model of the robot and its models with payloads, each with a suffix for the names of load cases."""
    models = [(objective.robot.model, "")]
    if isinstance(objective, WorstCaseObjective):
        for variant in objective.model_variants[1:]:
            # Variants that change the armature are skipped, because the armature does not change the weight.
            if variant.payload is not None and variant.armature_factor == 1:
                models.append((variant.robot.model, f" ({variant.name})"))
    return models


def _rotors(robot: Robot, weight: float, share: float) -> list[ForceSource]:
    propulsion = robot.spec.propulsion
    if propulsion is None:
        return []
    least, most = thrust_limits(propulsion)
    middle, half = (most + least) / 2, share * (most - least) / 2
    low, high = (np.full(len(propulsion.rotors), limit / weight) for limit in (middle - half, middle + half))
    columns = weight * allocation_matrix(robot.model, propulsion)
    names = tuple(rotor.name for rotor in propulsion.rotors)
    return [ForceSource(PointOnLink(1, np.zeros(3), np.eye(3)), columns, low, high, names, in_frame=True)]


def _feet(objective: Objective, weight: float, friction: float) -> list[ForceSource]:
    """Return the foot forces, at contact points or corners of soles, in units of the robot's weight.

    Each force is a nonnegative combination of the edges of a friction pyramid around the world z axis.
    """
    angles = 2 * np.pi * np.arange(_EDGES) / _EDGES
    slope = min(friction, _MOST_FRICTION)
    edges = np.array([slope * np.cos(angles), slope * np.sin(angles), np.ones(_EDGES)])
    sources = []
    for support in objective.supports:
        columns, lower = np.vstack([edges, np.zeros_like(edges)]), np.zeros(_EDGES)
        for corner in support.corners if support.has_sole else (support.offset,):
            point = point_on(objective.robot, support.frame, corner)
            names = (support.frame,) * lower.size
            sources.append(ForceSource(point, weight * columns, lower, np.full(lower.size, np.inf), names))
    return sources


def _push(robot: Robot, contact: ImpactContact, force: float) -> ForceSource:
    point = point_on(robot, contact.frame, contact.offset)
    wrench = np.append(force * np.array(contact.normal), np.zeros(3))
    return ForceSource(point, in_frame=contact.normal_frame == "contact", constant=wrench)
