"""Surroundings of a simulated robot: surfaces, the shapes that touch them, physics, sensors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from impact_posture.config.checked import checked
from impact_posture.config.demand import Demand, Finite, FiniteVector, NonNegative, Positive, Vector3, between
from impact_posture.config.table_validation import StrictTable
from impact_posture.errors import InputError
from impact_posture.impact.impact_contact import LARGEST
from impact_posture.simulation.world.contact_law import ContactLaw

ShapeKind = Literal["sphere", "box", "link"]
_Normal = Annotated[
    Vector3,
    Demand(
        lambda normal: 1e-9 < max(abs(value) for value in normal) <= LARGEST,
        f"three numbers, not all zero, up to {LARGEST:g}",
    ),
]


@checked
@dataclass(frozen=True)
class Surface(ContactLaw):
    """Infinite plane with its contact law.

    Attributes:
        name: Name of the surface.
        normal: Direction out of the surface towards the robot, in world axes, of any length.
        point: Point on the surface, world, m.  With ``None``, ``gap`` determines the position of the surface.
        gap: Distance of the surface from the nearest shape of the robot in the start posture, m.
    """

    name: str
    normal: _Normal
    point: FiniteVector | None = None
    gap: Finite = 0.0


@checked
@dataclass(frozen=True)
class Shape(StrictTable):
    """Massless shape on the robot that can touch surfaces.

    Attributes:
        frame: Frame to which the shape is fixed, and name of the shape.
        size: Radius of a sphere, or three half extents of a box, m.
        kind: ``sphere``; ``box`` with its edges along the axes of the frame; or ``link``, the solid geoms that the
            MJCF of the robot has at the link of the frame.
        offset: Contact point in the coordinates of the frame, m.
        center: Center of a sphere or box in the coordinates of the frame, m.  By default, the center follows from
            ``offset``.  In this case, ``offset`` is the point of the sphere, or the middle of the face of the box,
            that is nearest to the surface :meth:`Scene.faced` in the start posture.
    """

    frame: str
    size: tuple[Positive, ...] = ()
    kind: ShapeKind = "sphere"
    offset: FiniteVector = (0.0, 0.0, 0.0)
    center: FiniteVector | None = None

    def __post_init__(self) -> None:
        """Check that ``size`` has one number for a sphere and three for a box, and that a link has neither."""
        count, words = {"sphere": (1, "a radius"), "box": (3, "three half extents"), "link": (0, "empty")}[self.kind]
        where = f"{self.kind} at '{self.frame}'"
        if len(self.size) != count:
            hint = f"give {words} above zero (m)" if count else "leave it out, because the geoms have their own sizes"
            raise InputError(f"size {list(self.size)} is not {words}", where=where, hint=hint)
        if self.kind == "link" and self.center is not None:
            raise InputError("has a center", where=where, hint="leave it out, because the MJCF places the geoms")


@checked
@dataclass(frozen=True)
class Physics(StrictTable):
    """Time step, gravity, and the contact law of the joint stops.

    Attributes:
        timestep: Time step of the physics, s, at least a picosecond.
        gravity: Gravity, world, m/s²; ``None`` for the gravity of the robot model.
        stop_solref: ``solref`` of the joint stops, with the meaning in :class:`ContactLaw`.
        stop_solimp: ``solimp`` of the joint stops, with the meaning in :class:`ContactLaw`.
    """

    timestep: Annotated[float, between(1e-12, 1e100, "s")] = 2.5e-4
    gravity: FiniteVector | None = None
    stop_solref: tuple[Finite, Finite] = (0.005, 1.0)
    stop_solimp: FiniteVector = (0.95, 0.99, 0.001)

    def __post_init__(self) -> None:
        """Check that MuJoCo would not change the contact law of the joint stops."""
        ContactLaw(solref=self.stop_solref, solimp=self.stop_solimp)


@checked
@dataclass(frozen=True)
class Sensors(StrictTable):
    """Errors of the measured state.  By default, all sensors are perfect.

    The noise is white and normally distributed.  Units in parentheses are for prismatic joints.

    Attributes:
        base_position: Standard deviation of the base position, m, the same for each axis.
        base_angle: Standard deviation of the base orientation, rad, the same for each axis.
        base_velocity: Standard deviation of the linear base velocity, m/s, the same for each axis.
        base_rate: Standard deviation of the angular base velocity (gyroscope), rad/s, the same for each axis.
        joint_angle: Standard deviation of the joint positions, rad (m).
        joint_resolution: Resolution of the joint encoders, rad (m); 0 for encoders without rounding.
        joint_rate: Standard deviation of the joint velocities, rad/s (m/s).
        unbalance: Mass times eccentricity of each propeller, kg·m.  The measured twist of the base vibrates at the
            frequency of each propeller.  Rotor speeds must be in Hz.
        force_frame: Shape whose contact force is measured; ``None`` if the robot has no force sensor.
        force: Standard deviation of the measured force, N, the same for each axis.
        force_cutoff: Cutoff frequency of the low-pass filter of the force, Hz.
        delay: Age of a reading, s, at most an hour, rounded to a whole number of physics steps.
    """

    base_position: NonNegative = 0.0
    base_angle: NonNegative = 0.0
    base_velocity: NonNegative = 0.0
    base_rate: NonNegative = 0.0
    joint_angle: NonNegative = 0.0
    joint_resolution: NonNegative = 0.0
    joint_rate: NonNegative = 0.0
    unbalance: NonNegative = 0.0
    force_frame: str | None = None
    force: NonNegative = 0.0
    force_cutoff: Positive = 100.0
    delay: Annotated[float, between(0, 3600, "s")] = 0.0


@checked
@dataclass(frozen=True)
class Scene(StrictTable):
    """Surroundings of a robot.

    Every shape can touch every surface.  A thrown ball, the link with the rotors, and the links of an MJCF can also
    have contacts.
    """

    surfaces: tuple[Surface, ...] = ()
    shapes: tuple[Shape, ...] = ()
    physics: Physics = Physics()
    sensors: Sensors = Sensors()

    @property
    def laws(self) -> tuple[tuple[str, tuple[float, float]], ...]:
        """Pairs (name, ``solref``) of the contact laws of the joint stops and of all surfaces."""
        return (("stops", self.physics.stop_solref), *((s.name, s.solref) for s in self.surfaces))

    def faced(self, shape: Shape) -> Surface | None:
        """Return the surface that the point ``offset`` of a shape faces, which is the first surface."""
        return next(iter(self.surfaces), None)

    def __post_init__(self) -> None:
        """Check that names are unique, contact laws suit the time step, and the force sensor has a shape."""
        for words, names in (
            ("surfaces are called", [s.name for s in self.surfaces]),
            ("shapes are at", [s.frame for s in self.shapes]),
        ):
            twice = sorted({name for name in names if names.count(name) > 1})
            if twice:
                raise InputError(f"two {words} '{twice[0]}'", where="scene", hint="rename or remove one of them")
        step = self.physics.timestep
        for name, (a, b) in self.laws:
            # MuJoCo silently enforces the first two of these limits (refsafe).  A spring with 1/√k below the time
            # step returns more energy than it stores (measured, docs/generated/restitution.md).
            slow = (("the time constant", a, 2), ("its product with the damping ratio", a * b, 1))
            for words, value, least in slow if a > 0 else (("1/√k", (-a) ** -0.5, 1),):
                if value < least * step * (1 - 1e-9):
                    what = f"solref {[a, b]}: {words} is {value:.3g} s, below {least} × the time step of {step:g} s"
                    raise InputError(what, where=name, hint="increase it, or reduce the time step")
        frame, frames = self.sensors.force_frame, [s.frame for s in self.shapes]
        if frame is not None and frame not in frames:
            hint = f"one of: {', '.join(frames)}" if frames else "add a shape"
            raise InputError(f"there is no shape at force_frame '{frame}'", where="sensors", hint=hint)
