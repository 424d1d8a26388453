"""Gains of a scenario, which are the same for all its controllers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from impact_posture.config.checked import checked
from impact_posture.config.demand import Demand, NonNegative, Positive, between
from impact_posture.config.table_validation import StrictTable
from impact_posture.tsid.state import PERIOD
from impact_posture.tsid.tasks.activation import RAMP
from impact_posture.tsid.tasks.impact_robust import FADE

EndEffectorPose = Literal["full", "position", "aligned"]
OneOrEach = Positive | Annotated[tuple[Positive, ...], Demand(lambda values: len(values) > 0, "numbers above zero")]


@checked
@dataclass(frozen=True)
class Gains(StrictTable):
    """Gains of one task.

    Attributes:
        kp: Stiffness, 1/s², one number for all rows of the task or one number per row.
        kd: Damping, 1/s; ``None`` for critical damping, ``2√kp``.
        weight: Weight of the task in the cost; unused for a strict level.
    """

    kp: OneOrEach
    kd: OneOrEach | None = None
    weight: Positive = 1.0


@checked
@dataclass(frozen=True)
class EndEffectorGains(Gains):
    """Gains of the end effector task.

    Attributes:
        pose: Controlled part of the pose.  ``full``: position and orientation of the frame.  ``position``: position
            only.  ``aligned``: position and alignment with the surface normal; rotation about the normal is free.
    """

    pose: EndEffectorPose = "full"


@checked
@dataclass(frozen=True)
class RobustTerm(StrictTable):
    """Impact-robust term of the posture task.

    Attributes:
        gain: K of the term, 1/s².  The curvature of the objective scales the term, so K is a stiffness like ``kp``.
        ramp: Time in which the term is switched on gradually, s.
        fade: Two distances from a position limit, rad (m).  The term has its full size at the larger distance, and
            falls to zero at the smaller distance.
    """

    gain: Positive
    ramp: Positive = RAMP
    fade: tuple[NonNegative, Positive] = FADE


@checked
@dataclass(frozen=True)
class StanceGains(StrictTable):
    """Contact constraints in the controller of a standing robot.

    Attributes:
        friction: Coulomb coefficient that the controller assumes.
        least: Minimum normal force of each contact point or sole, N.
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
    """Gains of a scenario, the same for all controllers.  A task whose gains are ``None`` does not exist.

    Attributes:
        posture: Gains of the posture task.
        robust: Gain and activation of the impact-robust term.
        period: Duration of a tick, s, at most an hour.
        tilt: Gains of the task that keeps the base level (first priority).
        end_effector: Gains of the end effector task (second priority); its first rows belong to the position.
        apparent_mass: Mass M_d, kg.  A measured force F̂ adds ``F̂/M_d`` to the acceleration of the end effector
            task; with ``None``, the task ignores the force.
        center_of_mass: Gains of the center of mass task.
        base: Gains of the base orientation task.
        footing: Contact constraints of a standing robot; ``None`` for a robot that does not stand.
    """

    posture: Gains
    robust: RobustTerm
    period: Annotated[float, between(1e-12, 3600, "s")] = PERIOD
    tilt: Gains | None = None
    end_effector: EndEffectorGains | None = None
    apparent_mass: Positive | None = None
    center_of_mass: Gains | None = None
    base: Gains | None = None
    footing: StanceGains | None = None
