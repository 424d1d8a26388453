"""Impacts of a run: velocity jumps that the rigid-body model predicts, and measured velocity jumps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impact_posture.dynamics.numeric import Numeric
from impact_posture.impact.impact_contact import point_on
from impact_posture.impact.kinds.kinds_by_name import KINDS
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.simulation.metrics import before, jump
from impact_posture.simulation.run import Run
from impact_posture.simulation.setup import Setup
from impact_posture.simulation.world.throw import thrown_jumps


@dataclass(frozen=True)
class Prediction:
    """Prediction and measurement of one impact.  "Jump" means the velocity jump ``‖Δν‖``.

    Attributes:
        contact: Number of the contact, starting at 0.
        H: ``nᵀΛ_c n`` just before the impact: squared jump per squared impulse.
        G: ``nᵀBn`` just before the impact, with the mobility ``B = J M⁻¹Jᵀ``, 1/kg.
        V: ``H/G²``: squared jump per squared approach speed without friction.
        S: Squared jump per squared approach speed if the contact sticks; ``None`` if S is undefined.
        approach: Approach speed ``v`` of robot and surface (or ball) just before the impact, m/s.  For pushes, the
            impulse of the push, N·s.
        frictionless: Predicted jump without friction and rebound, ``v √V``.  For pushes, ``√H`` times the impulse:
            the velocity of a robot without controller at the end of the push.
        sticking: Predicted jump if the contact sticks, ``v √S``, for an approach along the normal; ``None`` for
            pushes and if S is undefined.
        coulomb: Predicted jump with the friction of the surface, ``v √C``, for an approach along the normal;
            ``None`` for pushes.
        measured: Measured jump (``peak_jump`` in :class:`~impact_posture.simulation.metrics.Metrics`).
        ratio: ``measured`` divided by ``coulomb`` (for pushes, by ``frictionless``); ``None`` if the divisor is
            almost zero.
    """

    contact: int
    H: float
    G: float
    V: float
    S: float | None
    approach: float
    frictionless: float
    sticking: float | None
    coulomb: float | None
    measured: float
    ratio: float | None


def predict(setup: Setup, objective: WorstCaseObjective, run: Run) -> tuple[Prediction, ...]:
    """Predict each impact of a run with the rigid-body model at the last state before the impact."""
    scenario, predictions = setup.scenario, []
    numeric = Numeric(setup.robot.model)
    point = point_on(setup.robot, objective.contact.frame, objective.contact.offset)
    for window in run.of("impact"):
        if not window.touched:
            continue
        k = before(run.series, window)
        q, v = run.series.q[k], run.series.v[k]
        here = objective.oracle.quantities(q)
        if scenario.push:
            approach = float(np.linalg.norm(scenario.push.force)) * scenario.push.duration
            smooth, sticking, coulomb = approach * float(np.sqrt(here.H)), None, None
        elif scenario.throw:
            approach = scenario.throw.speed - float(scenario.normal @ numeric.at(q).jacobian(point)[:3] @ v)
            smooth, sticking, coulomb = thrown_jumps(objective.oracle, q, scenario.throw, approach)
        else:
            approach = float(-scenario.normal @ numeric.at(q).jacobian(point)[:3] @ v)
            smooth = approach * float(np.sqrt(here.V))
            sticking = None if here.S is None else approach * float(np.sqrt(here.S))
            coulomb = approach * float(np.sqrt(KINDS["coulomb"](objective.oracle).value(q)))
        measured = jump(setup, run.series, window)
        expected = smooth if coulomb is None else coulomb
        ratio = measured / expected if expected > 1e-9 else None
        jumps = smooth, sticking, coulomb, measured
        predictions.append(Prediction(window.contact, here.H, here.G, here.V, here.S, approach, *jumps, ratio))
    return tuple(predictions)
