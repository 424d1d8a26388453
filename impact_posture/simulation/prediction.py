"""Impacts of a run: prediction of the rigid model, and measurement."""

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
    """Prediction of one impact.

    Attributes:
        contact: Number of the contact, from 0.
        H: ``nᵀΛ_c n`` just before the impact, squared jump per squared impulse.
        G: 1/kg.
        V: ``H/G²``.
        S: Squared jump per squared approach speed if the contact sticks, or ``None`` where it is undefined.
        approach: Approach speed of robot and surface (or ball) just before the impact, m/s.  For pushes, the impulse
            of the push, N·s.
        frictionless: Jump without friction and rebound, ``v √V``.  For pushes, ``√H`` times the impulse: the velocity
            of a robot without controller at the end of the push.
        sticking: Jump if the contact sticks, ``v √S`` (for an approach along the normal), or ``None`` for pushes.
        coulomb: Jump with the friction of the surface, ``v √C`` (likewise), or ``None`` for pushes.
        measured: Measured jump, as in :class:`~impact_posture.simulation.metrics.Metrics`.
        ratio: ``measured`` over ``coulomb`` (for pushes, over ``frictionless``), or ``None`` if the latter vanishes.
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
    """Predict the impacts of a run with the rigid model at the state before each."""
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
