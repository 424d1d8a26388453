"""One robot's configurations and normals, and the numbers that every peer must agree on."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.impact.contact import ImpactContact, point_on
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.objective import ImpactObjective
from impact_posture.impact.oracle import ImpactOracle
from impact_posture.robot.robot import Robot

Vector = NDArray[np.float64]

COUNT = 256
# Differences call H so many times that a few configurations do.
FEW = 16
STEP = 1e-5


@dataclass(frozen=True)
class Case:
    """One robot, free of supports, W = I, with a normal and a configuration for each call.

    Attributes:
        robot: The robot.
        frame: Contact frame.
        q: Configurations, shape (COUNT, nq).
        n: World unit normals, shape (COUNT, 3).
    """

    robot: Robot
    frame: str
    q: Vector
    n: Vector

    @staticmethod
    def of(robot: Robot, frame: str) -> Case:
        """Random configurations, the same on every run.

        Raises:
            FrameNotFound: The robot has no such frame.
            ContactError: Nothing that moves carries the frame.
        """
        point_on(robot, frame)
        rng, start = np.random.default_rng(0), robot.posture()
        # The base anywhere in any attitude, the joints some way around the default posture.
        width = np.full(robot.nv, 1.0)
        width[: 6 if robot.floating else 0] = np.pi / 2
        q = [pin.integrate(robot.model, start, rng.uniform(-width, width)) for _ in range(COUNT)]
        n = rng.normal(size=(COUNT, 3))
        return Case(robot, frame, np.array(q), n / np.linalg.norm(n, axis=1, keepdims=True))

    @cached_property
    def objective(self) -> ImpactObjective:
        """What is exported."""
        return ImpactObjective(self.robot, ImpactContact(self.frame, (0.0, 0.0, 1.0)))

    @property
    def point(self) -> tuple[int, Vector]:
        """Joint that carries the contact point, and the point in its link."""
        found = point_on(self.robot, self.frame)
        return found.joint, np.array(found.position, dtype=float)

    @property
    def plain(self) -> bool:
        """Whether every joint has one number in ``q`` and in ``v``, but for a free-flyer at the root."""
        base = 1 if self.robot.floating else 0
        joints = list(zip(self.robot.model.nqs, self.robot.model.nvs, strict=True))[1 + base :]
        return all(tuple(pair) == (1, 1) for pair in joints)

    @cached_property
    def reference(self) -> tuple[Vector, Vector]:
        """H and ∇H by the oracle's dense linear algebra, which shares no code with any of the peers."""
        H, gradients = [], []
        for q, n in zip(self.q, self.n, strict=True):
            x, y, z = (float(v) for v in n)
            oracle = ImpactOracle(ImpactCase(self.robot, ImpactContact(self.frame, (x, y, z))))
            H.append(oracle.quantities(q).H)
            gradients.append(oracle.gradient_H(q))
        return np.array(H), np.array(gradients)

    @cached_property
    def moved(self) -> Vector:
        """``q``, and ``q ⊕ ±h e_i`` of the first configurations, shape (FEW, 1 + 2 nv, nq)."""
        nv, model = self.robot.nv, self.robot.model
        steps = np.concatenate([np.zeros((1, nv)), *[STEP * np.stack([e, -e]) for e in np.eye(nv)]])
        return np.array([[pin.integrate(model, q, step) for step in steps] for q in self.q[:FEW]])
