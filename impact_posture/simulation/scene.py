"""What stands around a robot in a simulation: surfaces, the shapes that touch them, physics, sensors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from impact_posture.errors import InputError
from impact_posture.settings import Vector3

ShapeKind = Literal["sphere", "box"]


@dataclass(frozen=True)
class ContactLaw:
    """How a surface pushes: MuJoCo's spring and damper, scaled by the mass that the contact feels.

    At distance r (negative: depth) the contact's own acceleration is ``r* = −b r' − k r`` with ``b = 2/(d₁T)`` and
    ``k = d/(d₁Tζ)²`` of ``solref = (T, ζ)``; both negative, they are ``(−k, −b)``.  It gets the share ``d`` of what
    happens, ``r'' = d r* + (1 − d) r''₀`` with the acceleration without contact ``r''₀``.  Of
    ``solimp = (d₀, d₁, width)`` the share goes from ``d₀`` at depth 0 to ``d₁`` at ``width`` (m).  The page on the
    simulated world has the measured restitution of many laws (``make calibration``).

    Attributes:
        solref: T in seconds and damping ratio ζ.
        solimp: See above.
        friction: Coulomb coefficient; 0 for none at all.
    """

    solref: tuple[float, float] = (0.002, 1.0)
    solimp: Vector3 = (0.95, 0.99, 0.001)
    friction: float = 0.7

    def __post_init__(self) -> None:
        """Refuse what MuJoCo would quietly change."""
        a, b = self.solref
        if not (np.isfinite(self.solref).all() and ((a > 0 and b > 0) or (a < 0 and b <= 0))):
            raise _wrong("solref", self.solref, "give a time and a damping ratio above zero, or both numbers below")
        low, high, width = self.solimp
        if not (0.0001 <= low <= high <= 0.9999 and width > 0 and np.isfinite(width)):
            raise _wrong("solimp", self.solimp, "give 0.0001 ≤ d₀ ≤ d₁ ≤ 0.9999 and a width above zero (m)")
        if not (np.isfinite(self.friction) and self.friction >= 0):
            raise _wrong("friction", self.friction, "give a coefficient of at least zero")


@dataclass(frozen=True)
class Surface:
    """An endless plane.

    Attributes:
        name: What it is called.
        normal: Out of it, towards the robot, world; any length.
        point: A point on it, world, meters; else ``gap`` says where it is.
        gap: Its distance from the nearest shape of the robot in the start posture, meters.
        law: How it pushes.
    """

    name: str
    normal: Vector3
    point: Vector3 | None = None
    gap: float = 0.0
    law: ContactLaw = ContactLaw()

    def __post_init__(self) -> None:
        """Refuse a normal without direction, a place that is none."""
        n = np.array(self.normal, dtype=float)
        where = f"surface '{self.name}'"
        if not (np.isfinite(n).all() and np.abs(n).max() > 1e-9):
            raise InputError("the normal has no direction", where=where, hint="give three numbers, not all zero")
        if self.point is not None and not np.isfinite(self.point).all():
            raise InputError("the point is not finite", where=where, hint="give three numbers (m)")
        if not np.isfinite(self.gap):
            raise InputError("the gap is not finite", where=where, hint="give meters")


@dataclass(frozen=True)
class Shape:
    """A massless shape on the robot that surfaces push.

    Attributes:
        frame: The frame that carries it; also what it is called.
        kind: ``sphere`` or ``box`` (axes of the frame).
        size: Radius (m), or three half extents (m).
        offset: The point that is to touch, from the frame's origin, in the frame, meters.
        center: Of the shape, in the frame, meters.  By default where the shape's lowest point (of a box: the middle
            of its lowest face) against the first surface is ``offset``, in the start posture.
    """

    frame: str
    kind: ShapeKind = "sphere"
    size: tuple[float, ...] = (0.01,)
    offset: Vector3 = (0.0, 0.0, 0.0)
    center: Vector3 | None = None

    def __post_init__(self) -> None:
        """Refuse sizes that make no shape."""
        count, words = (1, "a radius") if self.kind == "sphere" else (3, "three half extents")
        if not (len(self.size) == count and np.isfinite(self.size).all() and min(self.size) > 0):
            raise InputError(
                f"size {list(self.size)} is not {words}",
                where=f"{self.kind} at '{self.frame}'",
                hint=f"give {words} above zero (m)",
            )


@dataclass(frozen=True)
class Physics:
    """How time passes.

    Attributes:
        timestep: Seconds.
        gravity: m/s², world; ``None``: the model's.
        stop_solref: Of the joints' stops, as :class:`ContactLaw`'s.
        stop_solimp: Of the joints' stops.
    """

    timestep: float = 2.5e-4
    gravity: Vector3 | None = None
    stop_solref: tuple[float, float] = (0.005, 1.0)
    stop_solimp: Vector3 = (0.95, 0.99, 0.001)

    def __post_init__(self) -> None:
        """Refuse a step that is none."""
        if not (np.isfinite(self.timestep) and self.timestep > 0):
            raise _wrong("timestep", self.timestep, "give seconds above zero")
        ContactLaw(self.stop_solref, self.stop_solimp)


@dataclass(frozen=True)
class Sensors:
    """What is between the truth and what a controller is told; every number defaults to a perfect sensor.

    Noise is white, normal, drawn anew at each reading; numbers are standard deviations.

    Attributes:
        base_position: m, each axis.
        base_angle: rad, each axis.
        base_velocity: m/s, each axis.
        base_rate: rad/s, each axis (gyroscope).
        joint_angle: rad (m).
        joint_resolution: Step of the encoders, rad (m); 0: none.
        joint_rate: rad/s (m/s).
        unbalance: Of each propeller, mass times eccentricity, kg·m: makes the base's measured twist vibrate at each
            propeller's own frequency.  Rotor speeds must be in Hz.
        force_frame: Shape whose contact force is measured; ``None``: none is.
        force: N, each axis.
        force_cutoff: Of the force's low-pass, Hz.
        delay: Age of what is read, seconds; rounded to physics steps.
    """

    base_position: float = 0.0
    base_angle: float = 0.0
    base_velocity: float = 0.0
    base_rate: float = 0.0
    joint_angle: float = 0.0
    joint_resolution: float = 0.0
    joint_rate: float = 0.0
    unbalance: float = 0.0
    force_frame: str | None = None
    force: float = 0.0
    force_cutoff: float = 100.0
    delay: float = 0.0

    def __post_init__(self) -> None:
        """Refuse negative noise."""
        for name, value in vars(self).items():
            if name != "force_frame" and not (np.isfinite(value) and value >= 0):
                raise InputError(f"{name} is {value:g}", where="sensors", hint="give a number of at least zero")
        if self.force_cutoff == 0:
            raise InputError("force_cutoff is 0", where="sensors", hint="give Hz above zero")


@dataclass(frozen=True)
class Scene:
    """A robot's surroundings.

    Every shape meets every surface; nothing else touches anything.

    Attributes:
        surfaces: What can be touched.
        shapes: What touches.
        physics: How time passes.
        sensors: What is read.
    """

    surfaces: tuple[Surface, ...] = ()
    shapes: tuple[Shape, ...] = ()
    physics: Physics = Physics()
    sensors: Sensors = Sensors()

    def __post_init__(self) -> None:
        """Refuse names that stand for two things, laws that are too fast for the time step, an unknown sensor."""
        for words, names in (
            ("surfaces are called", [s.name for s in self.surfaces]),
            ("shapes are at", [s.frame for s in self.shapes]),
        ):
            twice = sorted({name for name in names if names.count(name) > 1})
            if twice:
                raise InputError(f"two {words} '{twice[0]}'", where="scene", hint="have one of each")
        step = self.physics.timestep
        laws = [("stops", self.physics.stop_solref), *((s.name, s.law.solref) for s in self.surfaces)]
        for name, (a, b) in laws:
            # MuJoCo's own rule (refsafe), which it applies without a word; and a spring that turns faster than the
            # time steps gives more energy than it took (measured: docs/generated/restitution.md).
            slow = (("the time constant", a, 2), ("its product with the damping ratio", a * b, 1))
            for words, value, least in slow if a > 0 else (("1/√k", (-a) ** -0.5, 1),):
                if value < least * step * (1 - 1e-9):
                    raise InputError(
                        f"solref {[a, b]}: {words} is {value:.3g} s, below {least} × the time step of {step:g} s",
                        where=name,
                        hint="raise it, or lower the time step",
                    )
        frame, frames = self.sensors.force_frame, [s.frame for s in self.shapes]
        if frame is not None and frame not in frames:
            raise InputError(
                f"force_frame '{frame}' carries no shape",
                where="sensors",
                hint=f"one of: {', '.join(frames)}" if frames else "add a shape",
            )


def _wrong(key: str, value: object, hint: str) -> InputError:
    return InputError(f"{key} is {value}", where="scene", hint=hint)
