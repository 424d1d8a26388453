"""The contact of an impact, and points on the links of a robot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from impact_posture.config.checked import checked
from impact_posture.config.demand import Direction, FiniteVector, Vector3, between
from impact_posture.config.problem_settings import FRICTION, NormalFrame
from impact_posture.dynamics.tree import PointOnLink
from impact_posture.errors import ContactError
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import Support as Support

# A normal is treated as a unit vector if its length differs from 1 by at most this value.
_UNIT = 1e-15
# Largest allowed impulse (N·s) and speed (m/s).  The square of a larger value, multiplied by H or V, could overflow.
LARGEST = 1e100


@checked
@dataclass(frozen=True)
class ImpactContact:
    """A point of the robot that will touch a surface.

    Attributes:
        frame: Name of the frame to which the contact point is fixed.
        normal: Direction out of the surface, towards the robot, shape (3,).  The argument can have any length; the
            attribute is a unit vector.
        offset: Position of the contact point in the coordinates of ``frame``, shape (3,), m.
        normal_frame: Axes of ``normal``: ``world``, or ``contact`` for axes that turn with the frame.
        impulse: Largest impulse λ̄ along the normal, N·s.
        friction: Coulomb coefficient μ.

    Raises:
        InputError: The normal is zero, a number is not finite, the friction is negative, or ``normal_frame`` is
            neither ``world`` nor ``contact``.
    """

    frame: str
    normal: Direction
    offset: FiniteVector = (0.0, 0.0, 0.0)
    normal_frame: NormalFrame = "world"
    # For a larger or smaller impulse, the objective λ̄²H would be outside the range of doubles.
    impulse: Annotated[float, between(1 / LARGEST, LARGEST, "N·s")] = 1.0
    friction: Annotated[float, between(0, LARGEST)] = FRICTION

    def __post_init__(self) -> None:
        n = np.array(self.normal, dtype=float)
        # Divide by the largest entry first, because the squares of large entries overflow.  A unit normal stays
        # unchanged, so a copy of a contact has exactly the same normal.
        if abs(np.linalg.norm(n / np.abs(n).max()) * np.abs(n).max() - 1) > _UNIT:
            n = n / np.abs(n).max()
            n = n / np.linalg.norm(n)
        object.__setattr__(self, "normal", tuple(float(v) for v in n))
        object.__setattr__(self, "offset", tuple(float(v) for v in self.offset))
        object.__setattr__(self, "impulse", float(self.impulse))

    def to_dict(self) -> dict[str, object]:
        """Return JSON content."""
        return {
            "frame": self.frame,
            "offset": list(self.offset),
            "normal": list(self.normal),
            "normal_frame": self.normal_frame,
            "impulse_bound": self.impulse,
            "friction": self.friction,
        }


def point_on(robot: Robot, frame: str, offset: Vector3 = (0.0, 0.0, 0.0)) -> PointOnLink:
    """Return the point at ``offset`` (m, coordinates of ``frame``), attached to the link that carries ``frame``.

    Raises:
        FrameNotFound: The robot has no such frame.
        ContactError: The frame is welded to the world.
    """
    carrier = robot.model.frames[robot.frame_id(frame)]
    if carrier.parentJoint == 0:
        hint = "choose a frame on a moving link, or `root` free-flyer"
        raise ContactError(f"frame '{frame}' is welded to the world and cannot move", where=robot.name, hint=hint)
    position = carrier.placement.act(np.array(offset, dtype=float))
    return PointOnLink(int(carrier.parentJoint), np.array(position), np.array(carrier.placement.rotation))
