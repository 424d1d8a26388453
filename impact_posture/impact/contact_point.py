"""Compare a contact point with the foremost point of the links around it, which touches a surface first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from impact_posture.collision.contact_front import ContactFront, contact_front
from impact_posture.errors import ContactError
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import Support
from impact_posture.system.arrays import Array

# A link that reaches less than this value (m) beyond its contact point is not reported.
BEYOND = 5e-3


@dataclass(frozen=True)
class EarlyTouch:
    """A link that a flat surface touches before the contact point."""

    contact: ImpactContact
    front: ContactFront

    @property
    def fact(self) -> str:
        """State which link the surface touches first, without a hint."""
        beyond = f"{1e3 * self.front.reach:.0f} mm beyond the contact point at {self.contact.frame}"
        return f"a flat surface touches {self.front.link} first, {beyond}"

    @property
    def offset(self) -> str:
        """The foremost point as numbers of the option ``offset``, to 0.1 mm."""
        return " ".join(f"{round(value, 4) + 0.0:g}" for value in self.front.offset)


def front_of(robot: Robot, contact: ImpactContact, q: Array, held: Sequence[str] = ()) -> ContactFront | None:
    """Return the foremost point, along −n, of the links at the contact; the joints ``held`` do not move.

    ``q`` is the posture, shape (nq,).  Return ``None`` if these links have no shapes.
    """
    in_world = contact.normal_frame == "world"
    return contact_front(robot, q, contact.frame, contact.offset, -np.array(contact.normal), held, in_world=in_world)


def at_front(robot: Robot, contact: ImpactContact, q: Array, held: Sequence[str] = ()) -> ImpactContact:
    """Return a contact whose contact point is the foremost point along −n at the posture ``q``, shape (nq,).

    Raises:
        ContactError: The links at the contact have no shapes.
    """
    front = front_of(robot, contact, q, held)
    if front is None:
        what = f"the links at {contact.frame} have no shapes, so their front is unknown"
        raise ContactError(what, where="contact_point", hint="give the contact point as `offset` X Y Z")
    return replace(contact, offset=front.offset)


def early_touches(
    robot: Robot, contacts: Sequence[ImpactContact], q: Array, held: Sequence[str] = ()
) -> tuple[EarlyTouch, ...]:
    """Return the links that reach more than :data:`BEYOND` beyond a contact point at ``q``, shape (nq,)."""
    fronts = [(contact, front_of(robot, contact, q, held)) for contact in contacts]
    return tuple(EarlyTouch(c, front) for c, front in fronts if front is not None and front.reach > BEYOND)


def sunken_feet(robot: Robot, supports: Sequence[Support], q: Array) -> list[str]:
    """Return a warning for each foot that reaches more than :data:`BEYOND` below its contact point at ``q``."""
    down, warnings = [ImpactContact(s.frame, (0.0, 0.0, 1.0), offset=s.offset) for s in supports], []
    for touch in early_touches(robot, down, q):
        below = f"{1e3 * touch.front.reach:.0f} mm below the contact point of the foot {touch.contact.frame}"
        hint = f"give robot.toml [[supports]] offset = [{touch.offset.replace(' ', ', ')}]"
        warnings.append(f"{touch.front.link} reaches {below}, so it is in the ground: {hint}")
    return warnings
