"""Contacts that stay: their desired accelerations, and the friction pyramids of their forces."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from impact_posture.config.checked import checked
from impact_posture.config.demand import NonNegative, Positive
from impact_posture.config.problem_settings import SupportKind
from impact_posture.errors import ContactError
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array
from impact_posture.tsid.point_kinematics import Point
from impact_posture.tsid.qp.quadratic_program import stacked_rows
from impact_posture.tsid.state import State


@checked
@dataclass(frozen=True, eq=False)
class SupportContact:
    """A foot (or hand) on the ground.

    Attributes:
        point: Contact point.
        kind: ``point`` (3 forces) or ``surface`` (force and moment).
        half: Half extents (x, y) of a surface around the point, in the frame, meters.
        normal: Unit normal out of the ground, world.
        friction: Coulomb coefficient.
        least: Least normal force, N.
        kp: Stiffness that pulls the contact back to its place at ``reset``, 1/s².
        kd: Damping of the contact, 1/s.
        weight: Weight of the contact's acceleration in the cost; ``None`` makes it a hard constraint.  Points on one
            body can have dependent rows, whose rank changes with posture (the four feet of solo8 have rank 9 to 11
            of 12).  As constraints, they would then demand unbounded accelerations.
    """

    point: Point
    kind: SupportKind = "point"
    half: tuple[float, float] = (0.0, 0.0)
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    friction: Positive = 0.7
    least: NonNegative = 1.0
    kp: NonNegative = 100.0
    kd: NonNegative = 20.0
    weight: Positive | None = None

    def __post_init__(self) -> None:
        """Refuse a surface without extent and a normal that is not a unit vector."""
        where = f"contact at {self.point.frame}"
        if self.kind == "surface" and not min(self.half) > 0:
            raise ContactError("a surface without extent", where=where, hint="give half extents or kind 'point'")
        if not abs(float(np.linalg.norm(self.normal)) - 1) < 1e-9:
            raise ContactError("the normal is not a unit vector", where=where, hint="normalize it")

    @property
    def size(self) -> int:
        """Number of force components: 3, or 6 with the moment."""
        return 3 if self.kind == "point" else 6

    def cone(self, rotation: Array) -> Array:
        """Return the rows ``C f ≥ 0`` of the friction cone in world axes, shape (rows, size); normal force first.

        ``rotation`` is world from frame, shape (3, 3).  The x axis of the frame is the x axis of a sole.

        Raises:
            ContactError: The sole stands on its edge.
        """
        normal = np.array(self.normal)
        if self.kind == "point":
            return to_world(point_cone(self.friction), normal, np.eye(3)[0])
        return to_world(surface_cone(self.friction, *self.half), normal, rotation[:, 0])


@checked
def support_contacts(robot: Robot, *, friction: Positive = 0.7) -> tuple[SupportContact, ...]:
    """Return the supports of ``robot.toml`` on level ground with a Coulomb coefficient.

    Soles are hard constraints, points have a weight.
    """
    return tuple(
        SupportContact(
            Point(s.frame, s.offset), s.kind, s.size, friction=friction, weight=None if s.kind == "surface" else 1e4
        )
        for s in robot.spec.supports
    )


class ContactStack:
    """Stack of contacts as ``J ν̇ = a`` and ``least ≤ cone · f``, with forces ``f`` in world axes.

    Attributes:
        contacts: Contacts from top to bottom.
        rows: Rows of each contact in ``J`` and in ``f``.
        size: Number of all rows.
        J: Shape (size, nv).
        a: Desired acceleration of the contacts minus drift, shape (size,): ``−K_d Jν + K_p e − J̇ν``.
        cone: Shape (cone rows, size), constant after ``reset``.
        cone_rows: Rows of each contact in ``cone``.
        least: Lower bounds of the cone's rows.
        weight: Shape (size,), zero for hard rows.
        hard: Whether a row is a hard constraint, shape (size,).
    """

    def __init__(self, robot: Robot, contacts: Sequence[SupportContact]) -> None:
        self.contacts = tuple(contacts)
        sizes = np.array([c.size for c in contacts], dtype=int)
        self.rows, self.size = stacked_rows(sizes.tolist())
        self.J = np.zeros((self.size, robot.nv))
        self.a, self._drift, self._e, self._v = np.zeros((4, self.size))
        # Position and rotation of each contact at reset.
        self._home = [(np.zeros(3), np.eye(3)) for _ in contacts]
        self._kp, self._kd = (np.repeat([getattr(c, key) for c in contacts], sizes) for key in ("kp", "kd"))
        self.weight = np.repeat([c.weight or 0.0 for c in contacts], sizes)
        self.hard = np.repeat(np.array([c.weight is None for c in contacts], dtype=bool), sizes)
        self.cone_rows, count = stacked_rows(c.cone(np.eye(3)).shape[0] for c in contacts)
        self.cone, self.least = np.zeros((count, self.size)), np.zeros(count)

    def reset(self, state: State) -> None:
        """Hold the contacts at their present places."""
        for k, (contact, rows, cone_rows) in enumerate(zip(self.contacts, self.rows, self.cone_rows, strict=True)):
            here = state.at(contact.point)
            self._home[k] = here.position.copy(), here.rotation.copy()
            self.cone[cone_rows, rows] = contact.cone(here.rotation)
            self.least[cone_rows.start] = contact.least

    def update(self, state: State) -> None:
        """Move to the present state."""
        if not self.size:
            return
        for contact, rows, (position, rotation) in zip(self.contacts, self.rows, self._home, strict=True):
            here, size = state.at(contact.point), contact.size
            self.J[rows] = here.jacobian[:size]
            self._drift[rows] = here.drift[:size]
            self._v[rows] = here.velocity[:size]
            e = self._e[rows]
            np.subtract(position, here.position, out=e[:3])
            if size == 6:
                e[3:] = here.rotation @ pin.log3(here.rotation.T @ rotation)
        np.multiply(self._kp, self._e, out=self.a)
        self._v *= self._kd
        self.a -= self._v
        self.a -= self._drift


def point_cone(friction: float) -> Array:
    """Return the rows ``C f ≥ 0``: ``f_z ≥ 0`` and ``|f_x|, |f_y| ≤ μ' f_z``, shape (5, 3), z along the normal.

    With ``μ' = μ/√2``, the pyramid lies inside the Coulomb cone.
    """
    mu = friction / np.sqrt(2)
    return np.array([[0, 0, 1], [-1, 0, mu], [1, 0, mu], [0, -1, mu], [0, 1, mu]], dtype=float)


def surface_cone(friction: float, half_x: float, half_y: float) -> Array:
    """Return the cone of wrenches at a sole's center from forces in the pyramids at its four corners, shape (17, 6).

    The rows are ``f_z ≥ 0``, four rows of friction, four rows that keep the center of pressure on the sole, and
    eight rows that bound the yaw moment (Caron, Pham, Nakamura 2015, "Stability of surface contacts for humanoid
    robots", eq. 16 to 20):
    ``−μ(X+Y)f_z + |Y f_x − μ τ_x| + |X f_y − μ τ_y| ≤ τ_z ≤ μ(X+Y)f_z − |Y f_x + μ τ_x| − |X f_y + μ τ_y|``.
    """
    mu, x, y = friction / np.sqrt(2), half_x, half_y
    rows = np.zeros((17, 6))
    rows[:5, :3] = point_cone(friction)
    rows[5:9, 2] = (y, y, x, x)
    rows[5:9, 3:5] = [[1, 0], [-1, 0], [0, 1], [0, -1]]
    signs = list(itertools.product((1.0, -1.0), repeat=2))
    for k, (s, t) in enumerate(signs):
        rows[9 + k] = [-s * y, -t * x, mu * (x + y), s * mu, t * mu, 1]
        rows[13 + k] = [-s * y, -t * x, mu * (x + y), -s * mu, -t * mu, -1]
    return rows


def to_world(cone: Array, normal: Array, heading: Array) -> Array:
    """Return a cone of forces (and moments) in world axes, with z along ``normal`` and x along ``heading``.

    Raises:
        ContactError: The heading of a sole points along the normal.
    """
    x = heading - normal * (normal @ heading)
    if np.linalg.norm(x) < 1e-6:
        if cone.shape[1] == 6:
            raise ContactError("the sole stands on its edge", where="contact", hint="put the sole on the ground")
        other = np.eye(3)[int(np.argmin(np.abs(normal)))]
        x = other - normal * (normal @ other)
    x /= np.linalg.norm(x)
    R = np.column_stack([x, np.cross(normal, x), normal])
    turned = cone.copy()
    for k in range(0, cone.shape[1], 3):
        turned[:, k : k + 3] = cone[:, k : k + 3] @ R.T
    return turned
