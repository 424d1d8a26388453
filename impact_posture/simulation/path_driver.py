"""Controller that plays a path to the offline optimum."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from impact_posture.path.posture_path import PosturePath
from impact_posture.simulation.driver import Driver
from impact_posture.simulation.reference import ReferencePoint
from impact_posture.simulation.scenario import Setup
from impact_posture.simulation.sensor_noise import Reading
from impact_posture.tsid.body_tasks import BodyTaskLead
from impact_posture.tsid.controller import Command
from impact_posture.tsid.posture_tasks import JointPosture


class PathDriver(Driver):
    """Nominal controller whose posture follows a timed path, from :meth:`brace` on.

    Between two points of the path, the posture is interpolated on the manifold, velocity and acceleration linearly.
    Center of mass and base orientation follow too.

    Attributes:
        path: The path, which begins at the start of the scenario, as far as that satisfies the constraints.
    """

    def __init__(self, setup: Setup, posture: JointPosture, path: PosturePath) -> None:
        """Set the path."""
        super().__init__(setup, posture)
        self.path = path
        self._since: float | None = None
        self._body = BodyTaskLead(setup.robot.model)

    def reset(self, q: np.ndarray) -> Command:
        """Begin at rest."""
        self._since = None
        rest = np.zeros(self.setup.robot.nv)
        self.posture.lead(q, rest, rest)
        return super().reset(q)

    def brace(self) -> None:
        """Start the path."""
        self._since = 0.0

    def tick(self, reading: Reading, reference: ReferencePoint | None = None) -> Command:
        """Return the command on the way."""
        if self._since is not None and self.level < 1:
            self._since += self.controller.period
            self._lead(self._since)
        return super().tick(reading, reference)

    @property
    def level(self) -> float:
        """Share of the duration of the path that has passed, 0 to 1."""
        if self._since is None:
            return 0.0
        return min(1.0, self._since / self.path.duration) if self.path.duration else 1.0

    def _lead(self, since: float) -> None:
        path, model = self.path, self.setup.robot.model
        if since >= path.duration:
            q, v, a = path.q[-1], np.zeros(model.nv), np.zeros(model.nv)
        else:
            k = int(np.searchsorted(path.t, since, side="right")) - 1
            share = (since - path.t[k]) / (path.t[k + 1] - path.t[k])
            q = np.asarray(pin.interpolate(model, path.q[k], path.q[k + 1], share))
            v, a = ((1 - share) * x[k] + share * x[k + 1] for x in (path.v, path.a))
        self.posture.lead(q, v, a)
        self._body.lead(self._body_tasks, q, v, a)
