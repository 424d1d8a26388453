"""The demands of a task on the posture, which become constraints."""

from __future__ import annotations

from dataclasses import dataclass

from impact_posture.config.checked import checked
from impact_posture.config.demand import Lengths, NonNegative, Position, UnitQuaternion
from impact_posture.config.obstacle import Obstacle
from impact_posture.config.problem_settings import CLEARANCE


@checked
@dataclass(frozen=True)
class Requirements:
    """Demands of the task on the posture.

    Attributes:
        contact_pose: Held part of the pose of the leading contact frame, as in the setting ``contact_pose``.
        other_poses: Held part of the pose of each other contact frame.
        target_position: Position of the contact frame, world, meters; ``None`` for its initial position.
        target_quaternion: Orientation of the contact frame, x y z w; ``None`` for its initial orientation.
        box: Half extents of the box of ``contact_pose = box``, meters.
        base: Freedom of the floating base: ``free``, ``level`` (tilt zero, yaw free), ``level:DEG`` (tilt from its
            default posture at most DEG degrees, yaw free), ``fixed`` or ``box``.
        base_box: Half extents of the box of ``base = box``, meters.
        keep: Frames whose pose is held.
        hold: Joints held at their initial value.
        com_over_feet: Keep the center of mass above the support polygon.
        com_asked: Whether the user set ``com_over_feet``.  If not, it is dropped where the feet span no area.
        com_margin: Least distance of the center of mass from the edges of the polygon, meters.
        keep_contacts: The impact must neither lift nor slide a foot.
        holdable: Thrusts, torques and forces of the feet that hold the posture stay within their limits.
        limit_share: Share of the limits of torques and thrusts that holding may take, about the middle of a range.
        hold_force: Force with which each contact pushes back after the impact, N, which has to be held as well.
        least_mobility: Least G of each contact, 1/kg, for the bound on the peak force; 0 for none.
        largest_jump: Largest jump of a joint per approach speed; infinite for no bound.
        approach_speed: Speed at which the joints have to bring the contact to the surface, m/s; 0 for no demand.
        collision: Keep the links clear of each other, the surface, the ground and the obstacles.
        clearance: Least distance between any two of these, m.
        surface: ``plane``, ``none``, or the edge length of a square patch in m; ``None`` to choose by the robot.
        limit_margin: Distance from the joint limits, rad or m.
        regularization: Weight of the squared distance from the initial posture, relative to the initial objective.
    """

    contact_pose: str = "full"
    other_poses: tuple[str, ...] = ()
    target_position: Position | None = None
    target_quaternion: UnitQuaternion | None = None
    box: Lengths = (0.05, 0.05, 0.05)
    base: str = "free"
    base_box: Lengths = (0.2, 0.2, 0.2)
    keep: tuple[str, ...] = ()
    hold: tuple[str, ...] = ()
    com_over_feet: bool = False
    com_asked: bool = True
    com_margin: NonNegative = 0.0
    keep_contacts: bool = False
    friction: NonNegative = 0.7
    holdable: bool = False
    limit_share: float = 1.0
    hold_force: float = 0.0
    least_mobility: float = 0.0
    largest_jump: float = float("inf")
    approach_speed: float = 0.0
    collision: bool = False
    clearance: float = CLEARANCE
    surface: str | float | None = None
    obstacles: tuple[Obstacle, ...] = ()
    limit_margin: NonNegative = 0.0
    regularization: NonNegative = 0.0
