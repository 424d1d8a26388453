"""Contacts of an impact, and the inertia of supports that stay on the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from impact_posture.config.argument_types import check_types
from impact_posture.config.settings import FRICTION, NormalFrame, Vector3
from impact_posture.dynamics.tree import PointOnLink
from impact_posture.errors import ContactError, InputError, shown
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import Support as Support
from impact_posture.system.arrays import Array

# A normal shorter than this is zero up to rounding.
_DUST = 1e-9
# A normal whose length differs from 1 by less is a unit vector up to rounding.
_UNIT = 1e-15
# Largest impulse and speed.  Their squares, times the numbers of a robot, must stay within the range of doubles.
LARGEST = 1e100
# Compliance times the mass of the robot: the default, and the least value that leaves enough digits.
_DEFAULT_COMPLIANCE, _LEAST_COMPLIANCE = 1e-4, 1e-6


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


def default_compliance(robot: Robot) -> float:
    """Return the default support compliance ε in 1/kg: a foot is held as if it weighed 10⁴ robots.

    ``M a − J_sᵀ f = Jᵀ n, J_s a + ε f = 0`` is smooth in ``q`` for any ε > 0.  Its effect on the jump
    differs from that of rigid feet by a share of at most ``ε/(σ + ε)``.  σ is the least eigenvalue of ``J_sM⁻¹J_sᵀ``
    above zero.  The share is 1e-4 where the feet bear the mass of the robot.  It is larger where ``J_s`` nearly loses
    rank.
    """
    return _DEFAULT_COMPLIANCE / robot.mass


def least_compliance(robot: Robot) -> float:
    """Return the least compliance ε that the symbolic kernel and the C export allow, 1/kg.

    Both add ``1/ε`` to the inertia of the feet and subtract it again on the way to the base.  This costs as many
    digits as ``ε`` has zeros; about eight digits are left at this limit.
    """
    return _LEAST_COMPLIANCE / robot.mass


def check_compliance(robot: Robot, compliance: float) -> None:
    """Refuse a support compliance ε, 1/kg, that is below :func:`least_compliance` or not finite.

    Raises:
        InputError: The compliance is too small, negative or not finite.
    """
    least = least_compliance(robot)
    if not (np.isfinite(compliance) and compliance >= least):
        raise InputError(
            f"the compliance is {compliance:g} 1/kg",
            where="support_compliance",
            hint=f"give at least {least:.3g}, 1e-6 over the mass, because rounding outweighs stiffer feet below it",
        )


def heavy_feet_rounding(robot: Robot, compliance: float) -> float:
    """Return the rounding error of ``M + J_sᵀJ_s/ε`` relative to the default compliance; it grows with ``1/ε``."""
    return max(1.0, default_compliance(robot) / compliance)


def support_inertia(robot: Robot, supports: tuple[Support, ...], compliance: float) -> dict[int, Array]:
    """Return ``J_sᵀJ_s/ε`` by link, as 6×6 inertias: point masses ``1/ε``, and moments ``1/ε`` for a surface."""
    extra: dict[int, Array] = {}
    for support in supports:
        point = point_on(robot, support.frame, support.offset)
        jacobian = np.eye(6)
        jacobian[:3, 3:] = -pin.skew(point.position)
        jacobian = jacobian[: support.rows]
        extra[point.joint] = extra.get(point.joint, np.zeros((6, 6))) + jacobian.T @ jacobian / compliance
    return extra
