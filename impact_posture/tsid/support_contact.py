"""Contacts that do not move: their desired accelerations, and the friction pyramids of their forces."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from impact_posture.config.checked import checked
from impact_posture.config.demand import NonNegative, Positive
from impact_posture.config.problem_settings import FRICTION, SupportKind
from impact_posture.errors import ContactError
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array
from impact_posture.tsid.point_kinematics import Point
from impact_posture.tsid.qp.quadratic_program import stacked_rows
from impact_posture.tsid.state import State

# Least length of the component of ``heading`` that is orthogonal to the normal.
ACROSS = 1e-6


@checked
@dataclass(frozen=True, eq=False)
class SupportContact:
    """Contact of a foot or a hand with the ground.

    Attributes:
        point: Contact point.
        kind: ``point`` transmits a force; ``surface`` transmits a force and a moment.
        half: Half extents of a surface around the point along the x and y axes of the frame, m.
        normal: Unit normal out of the ground, world.
        friction: Coulomb coefficient.
        least: Lower bound on the normal force, N.
        kp: Stiffness that pulls the contact back to its pose at the last ``reset``, 1/s².
        kd: Damping of the contact, 1/s.
        weight: Weight of the contact's acceleration in the cost; with ``None``, the contact is a hard constraint.
            The rows of several points can be dependent, and their rank can change with the posture.  For example, the
            12 rows of solo8's feet have rank 9 to 11.  If these rows were hard constraints, they would require
            unbounded accelerations.
    """

    point: Point
    kind: SupportKind = "point"
    half: tuple[float, float] = (0.0, 0.0)
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    friction: Positive = FRICTION
    least: NonNegative = 1.0
    kp: NonNegative = 100.0
    kd: NonNegative = 20.0
    weight: Positive | None = None

    def __post_init__(self) -> None:
        """Raise :class:`ContactError` if a surface has no extent or the normal is not a unit vector."""
        where = f"contact at {self.point.frame}"
        if self.kind == "surface" and not min(self.half) > 0:
            raise ContactError("a surface without extent", where=where, hint="give half extents or kind 'point'")
        if not abs(float(np.linalg.norm(self.normal)) - 1) < 1e-9:
            raise ContactError("the normal is not a unit vector", where=where, hint="normalize it")

    @property
    def size(self) -> int:
        """Number of force and moment components: 3 for a point, 6 for a surface."""
        return 3 if self.kind == "point" else 6

    def cone(self, rotation: Array) -> Array:
        """Return the matrix ``C`` of the friction cone ``C f ≥ 0`` in world axes, shape (rows, size).

        The first row of ``C f`` is the normal force.  ``rotation`` is world from frame, shape (3, 3).  The x axis of
        a sole is the x axis of the frame.

        Raises:
            ContactError: The sole stands on its edge.
        """
        normal = np.array(self.normal)
        if self.kind == "point":
            return to_world(point_cone(self.friction), normal, np.eye(3)[0])
        return to_world(surface_cone(self.friction, *self.half), normal, rotation[:, 0])


@checked
def support_contacts(robot: Robot, *, friction: Positive = FRICTION) -> tuple[SupportContact, ...]:
    """Return the supports of ``robot.toml`` as contacts on level ground.

    ``friction`` is the Coulomb coefficient.  Soles are hard constraints; point contacts have a weight in the cost.
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
        contacts: Contacts in the order of their rows.
        rows: Rows of each contact in ``J`` and in ``f``.
        size: Total number of rows.
        J: Jacobian of all contacts, shape (size, nv).
        a: Desired acceleration of the contacts minus drift, shape (size,): ``−K_d Jν + K_p e − J̇ν``.
        cone: Friction cones of all contacts, shape (cone rows, size); constant after ``reset``.
        cone_rows: Rows of each contact in ``cone``.
        least: Lower bounds of the rows of ``cone``.
        weight: Weight of each row in the cost, shape (size,); zero for hard rows.
        hard: Whether each row is a hard constraint, shape (size,).
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
        """Set the targets of the contacts to their present poses."""
        for k, (contact, rows, cone_rows) in enumerate(zip(self.contacts, self.rows, self.cone_rows, strict=True)):
            here = state.at(contact.point)
            self._home[k] = here.position.copy(), here.rotation.copy()
            self.cone[cone_rows, rows] = contact.cone(here.rotation)
            self.least[cone_rows.start] = contact.least

    def update(self, state: State) -> None:
        """Compute ``J`` and ``a`` at ``state``."""
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
    """Return ``C``, shape (5, 3), of ``C f ≥ 0``: ``f_z ≥ 0`` and ``|f_x|, |f_y| ≤ μ' f_z``, with z along the normal.

    With ``μ' = μ/√2``, the pyramid lies inside the Coulomb cone.
    """
    mu = friction / np.sqrt(2)
    return np.array([[0, 0, 1], [-1, 0, mu], [1, 0, mu], [0, -1, mu], [0, 1, mu]], dtype=float)


def surface_cone(friction: float, half_x: float, half_y: float) -> Array:
    """Return the matrix of the contact wrench cone of a rectangular sole, shape (17, 6).

    The cone contains the wrenches at the center of the sole that friction forces at the four corners can produce
    (Caron, Pham, Nakamura 2015, "Stability of surface contacts for humanoid robots", eq. 16 to 20).  The
    first row is ``f_z ≥ 0``.  Four rows limit friction, and four rows keep the center of pressure on the sole.  Eight
    rows limit the yaw moment:
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
    """Rotate a friction cone to world axes from contact axes, with z along ``normal`` and x along ``heading``.

    Raises:
        ContactError: The ``heading`` of a sole is parallel to the normal.
    """
    x = heading - normal * (normal @ heading)
    if np.linalg.norm(x) < ACROSS:
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
