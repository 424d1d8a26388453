"""One impact on one robot: contact, metric and supports."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

from impact_posture.dynamics.tree import PointOnLink
from impact_posture.impact.impact_contact import ImpactContact, point_on
from impact_posture.impact.metric import Metric
from impact_posture.impact.support_compliance import default_compliance
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import Support


@dataclass(frozen=True)
class ImpactCase:
    """Data that determine the velocity jump of a single impact, except the posture.

    Attributes:
        contact: Point and normal of the impact.
        metric: Weight matrix ``W`` in the squared norm ``ΔνᵀWΔν`` of the velocity jump.
        supports: Feet that stay on the ground; empty for a robot that flies or is bolted down.
        compliance: Compliance ε of the supports, 1/kg.  Zero selects the
            :func:`~impact_posture.impact.support_compliance.default_compliance`.
    """

    robot: Robot
    contact: ImpactContact
    metric: Metric = field(default_factory=Metric)
    supports: tuple[Support, ...] = ()
    compliance: float = 0.0

    def __post_init__(self) -> None:
        if self.compliance <= 0:
            object.__setattr__(self, "compliance", default_compliance(self.robot))

    @cached_property
    def point(self) -> PointOnLink:
        """The contact point on its link."""
        return point_on(self.robot, self.contact.frame, self.contact.offset)

    @property
    def in_contact_frame(self) -> bool:
        """Whether the normal is fixed in the contact frame, so that it turns with the robot."""
        return self.contact.normal_frame == "contact"
