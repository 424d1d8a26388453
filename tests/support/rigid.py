"""Impact of a robot whose feet are fixed exactly, by the impulse dynamics of Pinocchio."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from impact_posture.impact.worst_case_objective import WorstCaseObjective
from tests.support.helpers import Vector
from tests.support.pinocchio_values import frame_jacobian, mass_matrix


class Rigid:
    """Velocity jumps and foot impulses for unit impulses along the world axes, by ``pin.impulseDynamics``."""

    def __init__(self, base: WorstCaseObjective, q: Vector) -> None:
        self._base = base
        self.at(q)

    def at(self, q: Vector) -> Rigid:
        base, model = self._base, self._base.robot.model
        frames = [(base.robot.frame_id(s.frame), s.offset, s.rows) for s in base.supports]
        self.Js = np.vstack([frame_jacobian(model, q, frame, offset)[:rows] for frame, offset, rows in frames])
        self.J = frame_jacobian(model, q, base.robot.frame_id(base.contact.frame))[:3]
        self.free = np.linalg.solve(mass_matrix(model, q), self.J.T)
        data = model.createData()
        columns, impulses = [], []
        for impact in self.free.T:
            columns.append(np.array(pin.impulseDynamics(model, data, q, impact, self.Js, 0.0, 0.0)))
            impulses.append(np.array(data.impulse_c))
        self.jumps, self.impulses = np.array(columns).T, np.array(impulses).T
        return self

    def quantities(self, q: Vector) -> dict[str, object]:
        n = np.array(self._base.contact.normal)
        mobility = self.at(q).J @ self.jumps
        H, G = float(np.sum((self.jumps @ n) ** 2)), float(n @ mobility @ n)
        stuck = self.jumps @ np.linalg.solve(mobility, n)
        return {
            "H": H,
            "G": G,
            "V": H / G**2,
            "S": float(stuck @ stuck),
            "jump": self.jumps @ n,
            "support_impulse": self.impulses @ n,
            "ellipsoid": self.jumps.T @ self.jumps,
        }
