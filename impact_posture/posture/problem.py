"""The posture problem as data: what is minimized, under which constraints, from where."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from impact_posture.errors import InputError
from impact_posture.impact.objective import ImpactObjective, Objective
from impact_posture.posture.constraint import Constraint
from impact_posture.robot.robot import Robot
from impact_posture.settings import BaseMode, ContactPose, Vector3

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Requirements:
    """What the task asks of the posture.

    Attributes:
        contact_pose: What is held of the contact frame; of several, the leading one.
        other_poses: What is held of each other contact frame.
        target_position: Contact frame's position, world, meters; ``None``: where it is.
        target_quaternion: Contact frame's orientation x y z w; ``None``: as it is.
        box: Half extents of the box of ``contact_pose = box``, meters.
        base: What the floating base may do: ``free``, ``level`` (tilt zero, yaw free), ``fixed``, ``box``.
        base_box: Half extents of the box of ``base = box``, meters.
        keep: Frames whose pose is held.
        hold: Joints kept at their initial value.
        com_over_feet: Keep the center of mass above the support polygon.
        com_asked: Whether that was asked for; else it is a habit of the robot, left where the feet span no area.
        com_margin: Distance from the polygon's edges, meters.
        keep_contacts: The impact must neither lift nor slide a foot.
        friction: Coefficient for that.
        limit_margin: Distance from the joint limits, rad or m.
        regularization: Weight of the squared distance from the initial posture, relative to the initial objective.
    """

    contact_pose: ContactPose = "full"
    other_poses: tuple[ContactPose, ...] = ()
    target_position: Vector3 | None = None
    target_quaternion: tuple[float, float, float, float] | None = None
    box: Vector3 = (0.05, 0.05, 0.05)
    base: BaseMode = "free"
    base_box: Vector3 = (0.2, 0.2, 0.2)
    keep: tuple[str, ...] = ()
    hold: tuple[str, ...] = ()
    com_over_feet: bool = False
    com_asked: bool = True
    com_margin: float = 0.0
    keep_contacts: bool = False
    friction: float = 0.7
    limit_margin: float = 0.0
    regularization: float = 0.0


@dataclass(frozen=True)
class PostureProblem:
    """``min_q objective(q)`` under constraints, from a given posture.

    Attributes:
        robot: The robot.
        objective: What is minimized.
        requirements: As asked for.
        given: Posture that the user started from, shape (nq,).
        constraints: All but bounds.
        lower: Bounds in chart coordinates, margin included, held joints pinned, shape (nx,).
        upper: As ``lower``.
        rows: Rows of each constraint that the program carries; empty: all.
        notes: What was decided for the user, one line each.
    """

    robot: Robot
    objective: Objective
    requirements: Requirements
    given: Vector
    constraints: tuple[Constraint, ...]
    lower: Vector
    upper: Vector
    rows: tuple[tuple[int, ...], ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def impact(self) -> ImpactObjective:
        """The objective, where it is that of an impact.

        Raises:
            InputError: It is another one.
        """
        if not isinstance(self.objective, ImpactObjective):
            raise InputError(
                f"is '{self.objective.name}', which is not that of an impact",
                where="objective",
                hint="use an ImpactObjective for what needs H, G, V and S",
            )
        return self.objective

    def carried(self, index: int) -> list[int]:
        """Rows of constraint ``index`` that the program carries."""
        return list(self.rows[index]) if self.rows else list(range(self.constraints[index].rows))

    def describe(self) -> list[str]:
        """The constraints in words, one line each."""
        lines = [c.describe() for c in self.constraints]
        margin = self.requirements.limit_margin
        lines.append("joint limits" + (f", {margin:g} rad (m) inside" if margin else ""))
        lines += [f"joint '{joint}' held" for joint in self.requirements.hold]
        return lines
