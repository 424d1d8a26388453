"""The requirements of a task on the posture, from which the constraints are built."""

from __future__ import annotations

from dataclasses import dataclass

from impact_posture.config.checked import checked
from impact_posture.config.demand import Lengths, NonNegative, Position, TiltAndShift, UnitQuaternion
from impact_posture.config.obstacle import Obstacle
from impact_posture.config.problem_settings import BASE_BOX, BOX, CLEARANCE, FRICTION, SURFACE_SPREAD


@checked
@dataclass(frozen=True)
class Requirements:
    """Requirements of the task on the posture.

    Attributes:
        contact_pose: Constrained part of the pose of the first contact frame; same values as the setting
            ``contact_pose``.
        other_poses: As ``contact_pose``, for each further contact frame.
        target_position: Target position of the contact frame, world axes, m; ``None`` for its initial position.
        target_quaternion: Target orientation of the contact frame, x y z w; ``None`` for its initial orientation.
        box: Half extents of the box in which the contact frame must stay if ``contact_pose`` is ``box``, m.
        base: How the floating base may move: ``free``, ``level`` (tilt zero, yaw free), ``level:DEG`` (tilt from the
            upright orientation at most DEG degrees, yaw free), ``fixed`` or ``box``.
        base_box: Half extents of the box in which the base must stay if ``base`` is ``box``, m.
        keep: Frames whose pose must not change.
        hold: Joints whose position must not change.
        com_over_feet: Whether the center of mass must stay above the support polygon.
        com_asked: Whether the user set ``com_over_feet``.  If false, the requirement is dropped for feet that span no
            area.
        com_margin: Least horizontal distance of the center of mass from the edges of the support polygon, m.
        keep_contacts: Whether the feet must neither lift off nor slide during the impact.
        holdable: Whether thrusts, torques and foot forces within their limits must be able to hold the posture.
        limit_share: Fraction of each torque and thrust range, around its middle, that may be used to hold the
            posture.
        hold_force: Force of the surface on each contact after the impact, N; the robot must also be able to hold its
            posture under this force.
        largest_mass: Largest allowed effective mass of each contact with friction, kg, from the bound on the peak
            force; infinite for no bound.
        largest_jump: Largest allowed velocity jump of a joint per approach speed; infinite for no bound.
        approach_speed: Speed that the joints must be able to give the contact towards the surface, m/s; 0 for no
            requirement.
        approach_asked: Whether the user gave the setting ``approach``.  If false, the required speed is dropped
            without a note when the attainable speed cannot be computed.
        strike: Whether the contact point arrives at the approach speed after a run-up.  If no posture allows this
            speed, the greatest possible speed is required instead.
        collision: Whether the links must not touch each other, the surface, the ground or the obstacles.
        clearance: Least distance between links, surface, ground and obstacles if ``collision`` is set, m.
        surface: Shape of the surface: ``plane``, ``none``, or the edge length of a square patch, m; if ``None``, the
            plane or a patch is chosen for the robot.
        surface_spread: Tilt, degrees, and shift, m, of the surface at which only the struck links may touch it, if
            ``strike`` is set.  If no posture allows this tilt and shift, the requirement is relaxed or dropped.
        limit_margin: Least distance of the joint positions from their limits, rad or m.
        regularization: Weight of the squared distance from the initial posture, relative to the initial objective.
    """

    contact_pose: str = "full"
    other_poses: tuple[str, ...] = ()
    target_position: Position | None = None
    target_quaternion: UnitQuaternion | None = None
    box: Lengths = BOX
    base: str = "free"
    base_box: Lengths = BASE_BOX
    keep: tuple[str, ...] = ()
    hold: tuple[str, ...] = ()
    com_over_feet: bool = False
    com_asked: bool = True
    com_margin: NonNegative = 0.0
    keep_contacts: bool = False
    friction: NonNegative = FRICTION
    holdable: bool = False
    limit_share: float = 1.0
    hold_force: float = 0.0
    largest_mass: float = float("inf")
    largest_jump: float = float("inf")
    approach_speed: float = 0.0
    approach_asked: bool = True
    strike: bool = False
    collision: bool = False
    clearance: float = CLEARANCE
    surface: str | float | None = None
    surface_spread: TiltAndShift = SURFACE_SPREAD
    obstacles: tuple[Obstacle, ...] = ()
    limit_margin: NonNegative = 0.0
    regularization: NonNegative = 0.0
