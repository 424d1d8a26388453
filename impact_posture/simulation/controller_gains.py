"""Gains of a scenario, which all controllers share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from impact_posture.config.checked import checked
from impact_posture.config.demand import Demand, NonNegative, Positive, between
from impact_posture.config.table_validation import StrictTable

EndEffectorPose = Literal["full", "position", "aligned"]
OneOrEach = Positive | Annotated[tuple[Positive, ...], Demand(lambda values: len(values) > 0, "numbers above zero")]


@checked
@dataclass(frozen=True)
class Gains(StrictTable):
    """Gains of one task.

    Attributes:
        kp: Stiffness, 1/s², one number or a number for each row of the task.
        kd: Damping, 1/s.  ``None`` is critical, ``2√kp``.
        weight: Weight in the cost, if the task is not a strict level.
    """

    kp: OneOrEach
    kd: OneOrEach | None = None
    weight: Positive = 1.0


@checked
@dataclass(frozen=True)
class EndEffectorGains(Gains):
    """Gains of the end effector task.

    Attributes:
        pose: What the task controls: the pose of the frame (``full``), its position (``position``), or its position
            and the direction of the surface normal, with free spin about it (``aligned``).
    """

    pose: EndEffectorPose = "full"


@checked
@dataclass(frozen=True)
class RobustTerm(StrictTable):
    """Impact-robust term of the posture task.

    Attributes:
        gain: K of the term, scaled by the curvature of the objective, 1/s².  It compares to ``kp`` of the posture.
        ramp: Time from off to on, s.
        fade: The term fades out between these distances from a position limit, rad (m).
    """

    gain: Positive
    ramp: Positive = 0.3
    fade: tuple[NonNegative, Positive] = (0.05, 0.2)


@checked
@dataclass(frozen=True)
class StanceGains(StrictTable):
    """Contact constraints of the controller of a standing robot.

    Attributes:
        friction: Coulomb coefficient that the controller assumes.
        least: Least normal force of a contact point or of a whole sole, N.
        force_weight: Weight of contact forces in the cost, 1/N².
        lifted: Frames of supports that are in the air, for example the foot that hits the ground.
    """

    friction: Positive = 0.5
    least: Positive = 1.0
    force_weight: Positive = 1e-5
    lifted: tuple[str, ...] = ()


@checked
@dataclass(frozen=True)
class Control(StrictTable):
    """Gains that all controllers of a scenario share.  A task without gains does not exist.

    Attributes:
        posture: Gains of the posture task.
        robust: The impact-robust term.
        period: Time from tick to tick, s, up to an hour.
        tilt: Gains of the level base, which has the first priority.
        end_effector: Gains of the end effector, which has the second priority; linear rows first.
        apparent_mass: M_d of ``F̂/M_d`` in the law of the end effector, kg.  ``None`` ignores the force.
        center_of_mass: Gains of the center of mass.
        base: Gains of the base orientation.
        footing: Contact constraints of a standing robot.
    """

    posture: Gains
    robust: RobustTerm
    period: Annotated[float, between(1e-12, 3600, "s")] = 1e-3
    tilt: Gains | None = None
    end_effector: EndEffectorGains | None = None
    apparent_mass: Positive | None = None
    center_of_mass: Gains | None = None
    base: Gains | None = None
    footing: StanceGains | None = None
