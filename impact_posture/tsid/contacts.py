"""Contacts that stay: what they ask of the accelerations, and the cones that their forces stay in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.errors import ContactError
from impact_posture.robot.robot import Robot
from impact_posture.settings import SupportKind
from impact_posture.tsid.friction import point_cone, surface_cone, to_world
from impact_posture.tsid.points import Point
from impact_posture.tsid.state import State

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SupportContact:
    """A foot (or hand) on the ground.

    Attributes:
        point: Where it touches.
        kind: ``point`` (3 forces) or ``surface`` (force and moment).
        half: Half extents (x, y) of a surface around the point, in the frame, meters.
        normal: Unit, out of the ground, world.
        friction: Coulomb coefficient.
        least: Least normal force, N.
        kp: Stiffness of the pull back to where the contact was at ``reset``, 1/s².
        kd: Its damping, 1/s.
        weight: Of the contact's acceleration in the cost; ``None``: a hard constraint.  Several points on one body
            can have dependent rows, whose rank changes with posture (the four feet of solo8 have rank 9 to 11 of 12);
            as constraints they would then ask for unbounded accelerations.
    """

    point: Point
    kind: SupportKind = "point"
    half: tuple[float, float] = (0.0, 0.0)
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    friction: float = 0.7
    least: float = 1.0
    kp: float = 100.0
    kd: float = 20.0
    weight: float | None = None

    def __post_init__(self) -> None:
        """Refuse what makes no contact."""
        where = f"contact at {self.point.frame}"
        if not self.friction > 0:
            raise ContactError("friction is not positive", where=where, hint="give a coefficient above zero")
        if self.kind == "surface" and not min(self.half) > 0:
            raise ContactError("a surface without extent", where=where, hint="give half extents or kind 'point'")
        if not abs(float(np.linalg.norm(self.normal)) - 1) < 1e-9:
            raise ContactError("the normal is no unit vector", where=where, hint="normalize it")
        if self.weight is not None and not self.weight > 0:
            raise ContactError("the weight is not positive", where=where, hint="give a positive weight or none")

    @property
    def size(self) -> int:
        """Numbers in its force: 3, or 6 with the moment."""
        return 3 if self.kind == "point" else 6


def support_contacts(robot: Robot, *, friction: float = 0.7) -> tuple[SupportContact, ...]:
    """The supports of ``robot.toml`` as contacts on level ground: soles as hard constraints, points with a weight.

    Args:
        robot: The robot.
        friction: Coulomb coefficient.
    """
    return tuple(
        SupportContact(
            Point(s.frame, s.offset),
            s.kind,
            s.size,
            friction=friction,
            weight=None if s.kind == "surface" else 1e4,
        )
        for s in robot.spec.supports
    )


@dataclass
class _ContactAnchor:
    """Where a contact was at reset."""

    position: Array = field(default_factory=lambda: np.zeros(3))
    rotation: Array = field(default_factory=lambda: np.eye(3))


class ContactStack:
    """Contacts one below the other: ``J ν̇ = a`` and ``lower ≤ cone · f``, with forces ``f`` in world axes.

    Attributes:
        contacts: From the top.
        rows: Where each stands, in ``J`` and in ``f``.
        size: Rows altogether.
        J: Shape (size, nv).
        a: What the contact's acceleration less drift is to be, shape (size,): ``−K_d Jν + K_p e − J̇ν``.
        cone: Shape (cone rows, size), constant after ``reset``.
        least: Lower bounds of the cone's rows.
        weight: Shape (size,), zero for hard rows.
    """

    def __init__(self, robot: Robot, contacts: Sequence[SupportContact]) -> None:
        ends = np.cumsum([0, *(c.size for c in contacts)])
        self.contacts = tuple(contacts)
        self.rows = tuple(slice(int(b), int(e)) for b, e in pairwise(ends))
        self.size = int(ends[-1])
        self.J, self.a = np.zeros((self.size, robot.nv)), np.zeros(self.size)
        self._drift, self._e, self._v = np.zeros(self.size), np.zeros(self.size), np.zeros(self.size)
        self._home = [_ContactAnchor() for _ in contacts]
        self._kp = np.concatenate([np.zeros(0), *(np.full(c.size, c.kp) for c in contacts)])
        self._kd = np.concatenate([np.zeros(0), *(np.full(c.size, c.kd) for c in contacts)])
        self.weight = np.concatenate([np.zeros(0), *(np.full(c.size, c.weight or 0.0) for c in contacts)])
        self.hard = np.concatenate([np.zeros(0, bool), *(np.full(c.size, c.weight is None) for c in contacts)])
        blocks = [self._cone(k) for k in range(len(contacts))]
        self.cone = np.zeros((sum(block.shape[0] for block in blocks), self.size))
        self.least = np.zeros(self.cone.shape[0])

    def reset(self, state: State) -> None:
        """Take the present places as those that are held."""
        row = 0
        for k, (contact, rows) in enumerate(zip(self.contacts, self.rows, strict=True)):
            here = state.at(contact.point)
            self._home[k] = _ContactAnchor(here.position.copy(), here.rotation.copy())
            block = self._cone(k)
            self.cone[row : row + block.shape[0], rows] = block
            # The first row of a cone is the normal force.
            self.least[row] = contact.least
            row += block.shape[0]

    def update(self, state: State) -> None:
        """Move to the present state."""
        if not self.size:
            return
        for contact, rows, home in zip(self.contacts, self.rows, self._home, strict=True):
            here, size = state.at(contact.point), contact.size
            self.J[rows] = here.jacobian[:size]
            self._drift[rows] = here.drift[:size]
            self._v[rows] = here.velocity[:size]
            e = self._e[rows]
            np.subtract(home.position, here.position, out=e[:3])
            if size == 6:
                e[3:] = here.rotation @ pin.log3(here.rotation.T @ home.rotation)
        np.multiply(self._kp, self._e, out=self.a)
        self._v *= self._kd
        self.a -= self._v
        self.a -= self._drift

    def _cone(self, k: int) -> Array:
        contact, rotation = self.contacts[k], self._home[k].rotation
        if contact.kind == "point":
            return to_world(point_cone(contact.friction), np.array(contact.normal), np.eye(3)[0])
        cone = surface_cone(contact.friction, *contact.half)
        return to_world(cone, np.array(contact.normal), rotation[:, 0])
