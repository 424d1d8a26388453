"""Impacts of a run: velocity jumps that the rigid-body model predicts, and measured velocity jumps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from impact_posture.dynamics.numeric import Numeric
from impact_posture.impact.evaluation.coulomb_jump import coulomb_jumps
from impact_posture.impact.evaluation.impact_effect import ImpactLoad, impact_effect
from impact_posture.impact.evaluation.velocity_jump import normal_jump
from impact_posture.impact.friction.coulomb_impact import coulomb_impact
from impact_posture.impact.impact_contact import point_on
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.simulation.metrics import before, impact_load
from impact_posture.simulation.run import Run
from impact_posture.simulation.setup import Setup
from impact_posture.simulation.world.throw import thrown_impulses, thrown_jumps


@dataclass(frozen=True)
class Prediction:
    """Prediction and measurement of one impact.  "Jump" means the velocity jump ``‖Δν‖``.

    Attributes:
        contact: Number of the contact, starting at 0.
        H: Squared jump per squared impulse just before the impact, ``nᵀΛ_c n``.
        G: Inverse effective mass along the normal just before the impact, ``nᵀBn`` with the mobility ``B = J M⁻¹Jᵀ``,
            1/kg.
        V: Squared jump per squared approach speed without friction, ``H/G²``.
        S: Squared jump per squared approach speed if the contact sticks; ``None`` if S is undefined.
        approach: Approach speed ``v`` of robot and surface (or ball) just before the impact, m/s.  For pushes, the
            impulse of the push, N·s.
        restitution: Coefficient of restitution ``e`` of the surface (or ball) at this speed; ``None`` for pushes.
        frictionless: Predicted jump without friction, ``(1+e) v √V``.  For pushes, ``√H`` times the impulse: the
            velocity of a robot without controller at the end of the push.
        sticking: Predicted jump if the contact sticks, ``(1+e) v √S``, for an approach along the normal; ``None``
            for pushes, falls, and if S is undefined.
        coulomb: Predicted jump with the friction of the surface, ``(1+e) v √C``, for an approach along the normal;
            ``None`` for pushes.
        measured: Measured jump (``peak_jump`` in :class:`~impact_posture.simulation.metrics.Metrics`).
        ratio: ``measured`` divided by ``coulomb`` (for pushes, by ``frictionless``); ``None`` if the divisor is
            almost zero.
        predicted_impact: Predicted effects on base, joints and contact, for the jump ``coulomb`` (for pushes,
            ``frictionless``).  The peak force is known only for pushes.
        measured_impact: Measured effects on base, joints and contact.
    """

    contact: int
    H: float
    G: float
    V: float
    S: float | None
    approach: float
    restitution: float | None
    frictionless: float
    sticking: float | None
    coulomb: float | None
    measured: float
    ratio: float | None
    predicted_impact: ImpactLoad
    measured_impact: ImpactLoad


def predict(setup: Setup, objective: WorstCaseObjective, run: Run) -> tuple[Prediction, ...]:
    """Predict each impact of a run with the rigid-body model at the last state before the impact.

    The contact law of the surface (or ball) determines the restitution
    (:meth:`~impact_posture.simulation.world.contact_law.ContactLaw.restitution`).  After a fall, all contacts
    strike together, but H, G, V and S are for the first contact alone.
    """
    scenario, predictions = setup.scenario, []
    numeric = Numeric(setup.robot.model)
    point = point_on(setup.robot, objective.contact.frame, objective.contact.offset)
    for window in run.of("impact"):
        if not window.touched:
            continue
        k = before(run.series, window)
        q, v = run.series.q[k], run.series.v[k]
        here = objective.oracle.quantities(q)
        sticking = force = restitution = None
        if scenario.push:
            force = float(np.linalg.norm(scenario.push.force))
            impulse = approach = force * scenario.push.duration
            velocity = approach * here.jump
            smooth, coulomb = approach * float(np.sqrt(here.H)), None
        elif scenario.throw:
            approach = scenario.throw.speed - float(scenario.normal @ numeric.at(q).jacobian(point)[:3] @ v)
            restitution = scenario.throw.restitution(approach, scenario.physics.timestep)
            rebound = normal_jump(approach, restitution)
            smooth, sticking, coulomb = thrown_jumps(objective.oracle, q, scenario.throw, rebound)
            pushed = thrown_impulses(objective.oracle, q, scenario.throw, rebound)[-1]
            velocity, impulse = objective.oracle.solve(objective.oracle.J.T @ pushed), float(here.normal @ pushed)
        else:
            approach = float(-scenario.normal @ numeric.at(q).jacobian(point)[:3] @ v)
            restitution = scenario.surface.restitution(approach, scenario.physics.timestep)
            rebound = normal_jump(approach, restitution)
            smooth = rebound * float(np.sqrt(here.V))
            sticking = None if here.S is None else rebound * float(np.sqrt(here.S))
            impact = coulomb_impact(objective.oracle, q)
            velocity, impulse = rebound * impact.jump, rebound * impact.mass
            if scenario.falls:
                first, *others = (replace(contact, friction=0.0) for contact in objective.contacts)
                slippery = replace(objective, contact=first, others=tuple(others))
                together, smoothly = (coulomb_jumps(each, q, rebound) for each in (objective, slippery))
                if together and smoothly:
                    velocity, impulse = together[0].velocity, sum(each.normal_impulse for each in together)
                    smooth, sticking = smoothly[0].norm, None
            coulomb = float(np.sqrt(velocity @ objective.oracle.weigh(velocity)))
        expected = smooth if coulomb is None else coulomb
        effect, measured = impact_effect(setup.robot, velocity), impact_load(setup, run.series, window)
        predicted = ImpactLoad(**vars(effect), impulse=impulse, peak_force=force, jump=expected)
        ratio = measured.jump / expected if expected > 1e-9 else None
        jumps = smooth, sticking, coulomb, measured.jump
        rigid = here.H, here.G, here.V, here.S
        comparison = ratio, predicted, measured
        predictions.append(Prediction(window.contact, *rigid, approach, restitution, *jumps, *comparison))
    return tuple(predictions)
