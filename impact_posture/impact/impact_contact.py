"""Contacts of an impact, and the inertia of supports that stay on the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impact_posture.config.argument_types import check_types
from impact_posture.config.settings import FRICTION, NormalFrame, Vector3
from impact_posture.dynamics.tree import PointOnLink
from impact_posture.errors import ContactError, shown
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import Support as Support

# A normal shorter than this is zero up to rounding.
_DUST = 1e-9
# A normal whose length differs from 1 by less is a unit vector up to rounding.
_UNIT = 1e-15
# Largest impulse and speed.  Their squares, times the numbers of a robot, must stay within the range of doubles.
LARGEST = 1e100


@dataclass(frozen=True)
class ImpactContact:
    """A point of the robot that will touch a surface.

    Attributes:
        frame: The frame that carries the contact point.
        normal: Direction out of the surface, towards the robot, shape (3,).  Any length is accepted, and the
            attribute is a unit vector.
        offset: Contact point from the frame's origin, in the frame, meters.
        normal_frame: Axes of ``normal``: the world, or the contact frame, with which the normal turns.
        impulse: Largest impulse λ̄ along the normal, N·s.
        friction: Coulomb coefficient μ.

    Raises:
        ContactError: The normal is zero, a number is not finite, or the friction is negative.
        InputError: ``normal_frame`` is neither ``world`` nor ``contact``.
    """

    frame: str
    normal: Vector3
    offset: Vector3 = (0.0, 0.0, 0.0)
    normal_frame: NormalFrame = "world"
    impulse: float = 1.0
    friction: float = FRICTION

    def __post_init__(self) -> None:
        if not isinstance(self.frame, str):
            raise ContactError(f"'{shown(self.frame)}' is no name", where="frame", hint="give the name of a frame")
        check_types(type(self).__init__, vars(self) | {"normal": (0, 0, 1)})
        try:
            n = np.array(self.normal, dtype=float)
        except (TypeError, ValueError, OverflowError):
            n = np.zeros(0)
        if n.shape != (3,) or not np.isfinite(n).all() or np.abs(n).max() < _DUST:
            raise ContactError(
                f"the normal {shown(self.normal)} has no direction",
                where="normal",
                hint="give three numbers, not all zero",
            )
        offset = np.array(self.offset, dtype=float)
        if offset.shape != (3,) or not np.isfinite(offset).all():
            raise ContactError("the offset is not finite", where="offset", hint="give three numbers")
        if not (np.isfinite(self.impulse) and self.impulse > 0):
            raise ContactError(f"the impulse bound is {self.impulse:g}", where="impulse", hint="give N·s above zero")
        if not 1 / LARGEST <= self.impulse <= LARGEST:
            raise ContactError(
                f"with an impulse bound of {self.impulse:g} the objective λ̄²H is beyond double precision",
                where="impulse",
                hint=f"give {1 / LARGEST:g} to {LARGEST:g} N·s",
            )
        if not 0 <= self.friction <= LARGEST:
            raise ContactError(
                f"the coefficient is {self.friction:g}", where="friction", hint=f"give 0 to {LARGEST:g}"
            )
        # Divide by the largest entry first, because squares of long vectors overflow.  A unit normal stays as it is,
        # so that a copy of a contact equals it to the last digit.
        if abs(np.linalg.norm(n / np.abs(n).max()) * np.abs(n).max() - 1) > _UNIT:
            n = n / np.abs(n).max()
            n = n / np.linalg.norm(n)
        object.__setattr__(self, "normal", tuple(float(v) for v in n))
        object.__setattr__(self, "offset", tuple(float(v) for v in offset))
        object.__setattr__(self, "impulse", float(self.impulse))


def point_on(robot: Robot, frame: str, offset: Vector3 = (0.0, 0.0, 0.0)) -> PointOnLink:
    """Resolve a frame and an offset in it to a point on a link.

    Raises:
        FrameNotFound: There is no such frame.
        ContactError: The frame is welded to the world.
    """
    found = robot.model.frames[robot.frame_id(frame)]
    if found.parentJoint == 0:
        raise ContactError(
            f"frame '{frame}' is welded to the world and cannot move",
            where=robot.name,
            hint="choose a frame on a moving link, or `root='free-flyer'`",
        )
    position = found.placement.act(np.array(offset, dtype=float))
    return PointOnLink(int(found.parentJoint), np.array(position), np.array(found.placement.rotation))
