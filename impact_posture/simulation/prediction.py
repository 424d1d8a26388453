"""What the rigid model says of each impact of a run, and what came."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from impact_posture.dynamics.numeric import Numeric
from impact_posture.impact.contact import point_on
from impact_posture.impact.objective import ImpactObjective
from impact_posture.simulation.metrics import before, jump
from impact_posture.simulation.run import Run
from impact_posture.simulation.scenario import RepeatedContacts, Setup

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Prediction:
    """Of one impact.

    Attributes:
        contact: Which, from 0.
        H: ``nᵀΛ_c n`` just before it, squared jump per squared impulse.
        G: 1/kg.
        V: ``H/G²``.
        S: The same when it sticks; ``None`` where undefined.
        approach: Speed into the surface just before it, m/s; for pushes the push's impulse, N·s.
        frictionless: Jump without friction and rebound, ``v √V``; for pushes ``√H`` times the impulse, which a robot
            that no controller holds would have at the end of the push.
        sticking: Jump if the contact sticks, ``v √S`` (for the approach along the normal); ``None`` for pushes.
        measured: As in :class:`~impact_posture.simulation.metrics.Metrics`.
    """

    contact: int
    H: float
    G: float
    V: float
    S: float | None
    approach: float
    frictionless: float
    sticking: float | None
    measured: float

    def to_dict(self) -> dict[str, object]:
        """JSON content, with ``ratio``: measured over frictionless."""
        ratio = self.measured / self.frictionless if self.frictionless > 1e-9 else None
        return {**asdict(self), "ratio": ratio}


def predict(setup: Setup, objective: ImpactObjective, run: Run) -> tuple[Prediction, ...]:
    """Hold a run's impacts against the rigid model at the state before each."""
    task, found = setup.scenario.task, []
    numeric = Numeric(setup.robot.model)
    point = point_on(setup.robot, objective.contact.frame, objective.contact.offset)
    for window in run.impacts:
        if not window.touched:
            continue
        k = before(run.series, window)
        q, v = run.series.q[k], run.series.v[k]
        here = objective.oracle.quantities(q)
        measured = jump(setup, run.series, window)
        if isinstance(task, RepeatedContacts):
            speed = float(-setup.scenario.normal @ numeric.at(q).jacobian(point)[:3] @ v)
            smooth, stick = speed * np.sqrt(here.V), None if here.S is None else speed * float(np.sqrt(here.S))
        else:
            speed = float(np.linalg.norm(task.force)) * task.duration
            smooth, stick = speed * np.sqrt(here.H), None
        found.append(
            Prediction(window.contact, here.H, here.G, here.V, here.S, speed, float(smooth), stick, measured)
        )
    return tuple(found)
