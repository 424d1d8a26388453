"""Fit the unpublished parameters of the arm, and summarize the measured jumps of a group of hits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pinocchio as pin
from scipy.optimize import least_squares

from docs.studies.core import Vector
from docs.studies.hits.arm import MASSES, MODELS, Arm, Model, with_box, with_duration
from docs.studies.hits.recordings import AVERAGED, JOINTS, PERIOD, Group, Hit

# Initial guess of the contact point in the fit, m.
_START = (0.01, -0.03)
# Unit in which the optimizer varies the contact point, m.
_SCALE = 0.05


@dataclass(frozen=True, eq=False)
class Summary:
    """Medians over the hits of a group.

    Attributes:
        q: Posture at the contact, rad, shape (7,).
        before: Joint velocities in the last row before the contact, rad/s, shape (7,).
        jump: Joint jumps relative to the trend, without the effect of the controller, rad/s, shape (7,).
        relative: Joint jumps relative to the trend.
        recorded: Joint jumps as recorded.
        torque: Impulse of the measured joint torques, N·m·s, shape (7,).
    """

    group: Group
    q: Vector
    before: Vector
    jump: Vector
    relative: Vector
    recorded: Vector
    torque: Vector


def summary(hits: Sequence[Hit], arm: Arm) -> Summary:
    """Summarize a group of hits.

    The controller changes its torque after the contact.  With the inertia of links and rotors, this change moves the
    joints by ``(M + B)⁻¹ ∫Δτ dt``, which is subtracted from the jump.
    """
    values = []
    for hit in hits:
        q, before, relative = hit.q[hit.contact], hit.trend()[0], hit.mean_after(hit.deviation()[1])
        controller = np.linalg.solve(arm.inertia(q), hit.impulse(hit.command))
        recorded = hit.mean_after(hit.velocity) - before
        values.append((q, before, relative - controller, relative, recorded, hit.impulse(hit.torque)))
    return Summary(hits[0].group, *np.median(values, axis=0))


def fit_last_link(hits: Sequence[Hit]) -> tuple[float, float]:
    """Return the mass (kg) that link 7 must gain, and its moment along the axis (kg·m).

    Before the contact, the measured torques are the inverse dynamics of the links.  Both numbers enter linearly.
    """
    model = Arm().robot(1.0).model
    data, rows, rest = model.createData(), list[Vector](), list[Vector]()
    first = 10 * (JOINTS - 1)  # a body has ten inertial parameters: mass, three moments, six moments of inertia
    for hit in hits:
        value, slope = hit.trend()
        for k in range(hit.last_before + 1):
            rate = value + slope * PERIOD * (k - hit.last_before)
            motion = with_box(hit.q[k]), with_box(rate), with_box(slope)
            columns = pin.computeJointTorqueRegressor(model, data, *motion)[:JOINTS, [first, first + 3]]
            rows.append(columns)
            rest.append(hit.torque[k] - pin.rnea(model, data, *motion)[:JOINTS])
    mass, moment = np.linalg.lstsq(np.vstack(rows), np.concatenate(rest), rcond=None)[0]
    return float(mass), float(moment)


def rotor_columns(hit: Hit) -> tuple[Vector, Vector, Vector]:
    """Return ``∬Δ(τ − u) dt²``, ``Δτ`` and ``Δq`` in the rows from the contact to the end of the jump, shapes (k, 7).

    ``τ`` is the measured torque, ``u`` the command, and ``Δ`` the change relative to the trend before the contact.  A
    rotor that moves with its link obeys ``B Δq = −∬Δ(τ − u) dt²``.
    """
    value, slope = hit.trend()
    rows = np.arange(hit.last_before, hit.contact + AVERAGED[hit.group.box][1])
    t = (rows - hit.last_before)[:, None] * PERIOD
    moved = hit.q[rows] - hit.q[hit.last_before] - value * t - slope * t**2 / 2
    before = slice(0, hit.last_before + 1)
    lost, torque = ((values - values[before].mean(axis=0))[rows] for values in (hit.torque - hit.command, hit.torque))
    return _integral(_integral(lost))[1:], torque[1:], moved[1:]


def _integral(values: Vector) -> Vector:
    steps = PERIOD * (values[1:] + values[:-1]) / 2
    return np.vstack([np.zeros((1, values.shape[1])), np.cumsum(steps, axis=0)])


def fit_rotors(hits: Sequence[Hit]) -> Vector:
    """Return the inertia of the rotors, kg·m², shape (7,), from positions and measured torques by least squares."""
    lost, _, moved = (np.vstack(values) for values in zip(*(rotor_columns(hit) for hit in hits), strict=True))
    return np.asarray(-np.sum(lost**2, axis=0) / np.sum(lost * moved, axis=0))


def spring_deflection(hits: Sequence[Hit]) -> Vector:
    """Return the deflection per torque ``1/K``, rad/(N·m), shape (7,), that the positions show in addition to the
    rotors.

    The fit is ``Δq = −∬Δ(τ − u)/B dt² − Δτ/K``.
    """
    lost, torque, moved = (np.vstack(values) for values in zip(*(rotor_columns(hit) for hit in hits), strict=True))
    fits = [np.linalg.lstsq(np.column_stack([-lost[:, k], -torque[:, k]]), moved[:, k])[0] for k in range(JOINTS)]
    return np.array([fit[1] for fit in fits])


@dataclass(frozen=True, eq=False)
class Fitted:
    """A joint model with the contact point and the restitution that fit a group best.

    Attributes:
        gain: Factor ``1 + e`` on the plastic jump.
    """

    model: Model
    arm: Arm
    gain: float

    def jump(self, measured: Summary) -> Vector:
        """Predict the joint jumps of a group, rad/s, shape (7,), from its posture and velocity before the contact."""
        speed = float(self.arm.approach(measured.q) @ measured.before)
        return self.gain * speed * self.model.jump(self.arm, MASSES[measured.group.box], measured.q)


def fit_contact(model: Model, arm: Arm, measured: Summary, *, at_tip: bool = False) -> Fitted:
    """Fit contact point and restitution to the jumps of a group, with the smallest kinetic energy of the error."""
    root = np.linalg.cholesky(arm.inertia(measured.q)).T

    def fitted(offset: Vector) -> tuple[Fitted, Vector]:
        plain = Fitted(model, replace(arm, offset=(float(offset[0]), float(offset[1]))), 1.0)
        predicted, jump = root @ plain.jump(measured), root @ measured.jump
        gain = float(predicted @ jump / (predicted @ predicted))
        return replace(plain, gain=gain), gain * predicted - jump

    if at_tip:
        return fitted(np.zeros(2))[0]
    result = least_squares(lambda x: fitted(_SCALE * x)[1], np.array(_START) / _SCALE, diff_step=1e-4)
    return fitted(_SCALE * result.x)[0]


@dataclass(frozen=True, eq=False)
class Fit:
    """All fits to one group of hits.  By default, the jumps do not contain the effects of trend and controller."""

    hits: Sequence[Hit]
    recorded: bool = False

    @cached_property
    def arm(self) -> Arm:
        """Mass of the last link, rotors and contact stiffness; the contact point is the tip."""
        arm = Arm(*fit_last_link(self.hits), rotors=fit_rotors(self.hits))
        measured = summary(self.hits, arm)
        return with_duration(arm, MASSES[measured.group.box], measured.q)

    @cached_property
    def measured(self) -> Summary:
        """Medians of the group."""
        return self.summary(self.hits)

    def summary(self, hits: Sequence[Hit]) -> Summary:
        measured = summary(hits, self.arm)
        return replace(measured, jump=measured.recorded) if self.recorded else measured

    @cached_property
    def models(self) -> dict[str, Fitted]:
        """Each joint model with its contact point and restitution."""
        return {name: fit_contact(model, self.arm, self.measured) for name, model in MODELS.items()}
