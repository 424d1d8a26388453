"""Velocity jump of a robot whose rotors drive the links through springs, in a contact of known stiffness.

In a short contact only the links respond; in a long contact the rotors move with the links.  For any duration, links
``x``, rotors ``y`` and contact form a linear system about the configuration ``q``.  All variables are changes
relative to the motion without contact:

    M ẍ = jᵀf − Eᵀτ,   B ÿ = τ,   s = Ex − y,   τ = K s + D ṡ,
    δ̇ = v − jẋ,   f = k δ,   j = nᵀJ,

where ``E`` (m×nv) selects the elastic joints, and ``B`` (m×m, diagonal) contains the inertias of their rotors.  ``M``
(nv×nv) contains the inertia of the links, and of the rotors of all joints without a spring of known stiffness.  With
supports, ``M + J_sᵀJ_s/ε`` replaces ``M``.  Locked joints do not move.  The compression ends at the first time ``T``
with ``δ̇ = 0`` (plastic impact, e = 0).

The deflections of springs and contact, ``c = (s, δ)``, obey a separate equation.  With ``C = [E; −j]``, ``κ = (K,
k)``, ``d = (D, 0)``,

    c̈ = −A (κc + dċ),   A = C M⁻¹ Cᵀ + diag(B⁻¹, 0),   c(0) = 0,   ċ(0) = (0, v),

and the impulses ``I = ∫(τ, f)dt = A⁻¹(ċ(0) − ċ)`` change the velocity of the links by ``ẋ = −M⁻¹CᵀI``.  The squared
norm of the state ``(κ^½c, L⁻¹ċ)``, with ``A = LLᵀ``, is twice the total energy.  Only the dampers change the energy.
Therefore the generator (the matrix of the linear system for the state) is skew-symmetric except for the terms of the
dampers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy

from impact_posture.config.json_block import JsonBlock
from impact_posture.errors import ContactError, InputError
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.impact_contact import LARGEST
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.impact.quantities.sticking_point import ImpulseResponse
from impact_posture.robot.joint_model import transmissions, with_joint_model
from impact_posture.system.arrays import Array

# Range of contact stiffness, N/m: from softer than foam to stiffer than steel on steel.
_SOFTEST, _STIFFEST = 1.0, 1e12
# Largest phase of the fastest oscillation during a contact, rad.  At this phase the result has seven correct digits.
_LONGEST = 1e8
# Stiffness that replaces rigid feet in the compliance, relative to the stiffest spring.
_HELD = 1e8
# Step between the samples from which the peaks are computed, rad of the fastest oscillation.
_SAMPLE = 0.1
# Smallest and largest number of samples from which the peaks are computed.
_FEWEST, _MOST = 100, 20_000


@dataclass(frozen=True, eq=False)
class ElasticResponse(JsonBlock):
    """Response of links, rotors and springs to a contact, from touch to the greatest compression at the time ``T``.

    All quantities are proportional to ``speed``, except ``stiffness``, ``duration``, ``compliance_ratio`` and
    ``value``.  ``W`` is the weight matrix of the metric.

    Attributes:
        stiffness: Stiffness ``k`` of the contact, N/m.
        speed: Approach speed ``v``, m/s.
        duration: Time ``T`` from touch to the greatest compression, s.
        compliance_ratio: Ratio ``T√(G/C)`` with ``G = jM⁻¹jᵀ`` and the compliance ``C = jK⁻¹jᵀ`` of the springs at
            the contact point.  If the ratio is small, only the links respond; if it is large, links and rotors
            respond.  Infinite if a force at the contact deflects no spring.
        force: Largest contact force ``kδ(T)``, N.
        impulse: Impulse ``∫f dt`` from touch to ``T``, N·s.
        jump: Velocity jump ``ẋ(T)`` of base and links, shape (nv,).
        jump_norm: Norm ``‖ẋ(T)‖_W`` of the jump.
        value: Squared jump per squared approach speed, ``‖ẋ(T)‖²_W/v²``.  For rigid joints, this is V, the objective
            ``speed``.
        peak_jump_norm: Largest ``‖ẋ(t)‖_W`` from touch to ``T``.
        rotor_jump: Velocity jump ``ẏ(T)`` of the rotors, shape (nv,); equal to ``jump`` for joints without a spring.
        torque: Torque ``τ(T)`` of springs and dampers, shape (nv,), N·m (N for prismatic joints).  Zero for joints
            without a spring.
        peak_torque: Largest ``|τ(t)|`` of each joint from touch to ``T``, shape (nv,).
    """

    stiffness: float
    speed: float
    duration: float
    compliance_ratio: float
    force: float
    impulse: float
    jump: Array
    jump_norm: float
    value: float
    peak_jump_norm: float
    rotor_jump: Array
    torque: Array
    peak_torque: Array


class ElasticImpact:
    """Compute the response to a contact of known stiffness, and its tangent gradient, with the matrix exponential.

    The rotor inertias are the armature of the robot, for every joint model.  The springs are read from
    ``[transmission]`` in robot.toml.  The metric W = M includes the links, and the rotors of joints without a spring.

    Raises:
        InputError: No joint has a rotor on a spring of known stiffness.
        InertiaError: Without the rotors that have springs, the mass matrix is singular.
    """

    def __init__(self, case: ImpactCase) -> None:
        robot, table = with_joint_model(case.robot, "elastic"), transmissions(case.robot)
        self.joints = np.flatnonzero(table.elastic & (robot.armature > 0))
        self.rotors = robot.armature[self.joints]
        self.kappa, self.d = table.stiffness[self.joints], table.damping[self.joints]
        self.oracle = ImpactOracle(replace(case, robot=robot))

    def response(self, q: Array, stiffness: float, speed: float = 1.0) -> ElasticResponse:
        """Return the response at ``q``, shape (nq,), to a contact of ``stiffness`` in N/m at ``speed`` in m/s.

        Raises:
            InputError: The stiffness (1 to 1e12 N/m) or the speed is out of range, or the joint springs are too stiff
                for a contact this soft.
            ContactError: The contact cannot move along its normal.
        """
        if not 0 < speed <= LARGEST:
            hint = f"give m/s above zero, up to {LARGEST:g}"
            raise InputError(f"is {speed:g}", where="approach speed", hint=hint)
        c = self._compression(q, stiffness)
        oracle, m, nv = self.oracle, len(self.joints), len(c.columns.a)
        force, impulse = c.force(c.state), c.impulse(c.state)
        x, torque, peak = c.columns.a @ impulse, np.zeros(nv), np.zeros(nv)
        rotor = x.copy()
        rotor[self.joints], torque[self.joints] = impulse[:m] / self.rotors, force[:m]
        peak_square, peak[self.joints] = c.peaks()
        square, softness = float(x @ oracle.weigh(x)), self.compliance(q)
        return ElasticResponse(
            stiffness=float(stiffness),
            speed=float(speed),
            duration=c.duration,
            compliance_ratio=c.duration * math.sqrt(c.mobility[-1, -1] / softness) if softness else math.inf,
            force=float(force[-1]) * speed,
            impulse=float(impulse[-1]) * speed,
            jump=x * speed,
            jump_norm=math.sqrt(square) * speed,
            value=square,
            peak_jump_norm=math.sqrt(peak_square) * speed,
            rotor_jump=rotor * speed,
            torque=torque * speed,
            peak_torque=peak * speed,
        )

    def value(self, q: Array, stiffness: float) -> float:
        """Return ``‖ẋ(T)‖²_W/v²`` at ``q``, shape (nq,), for a contact of ``stiffness`` in N/m."""
        c = self._compression(q, stiffness)
        x = c.columns.a @ c.impulse(c.state)
        return float(x @ self.oracle.weigh(x))

    def gradient(self, q: Array, stiffness: float) -> Array:
        """Return the tangent gradient of :meth:`value`, shape (nv,).

        ``T`` depends on ``q`` through ``δ̇(T) = 0``.  If ``δ̇`` touches zero without changing sign, ``T`` is
        discontinuous and the gradient does not exist.  With the adjoint ``X`` of ``A``, the gradient of the value
        equals the gradient of ``⟨X, A⟩ + 2 bᵀ(jᵀI_f − Mẋ)`` with ``b = M⁻¹Wẋ``, in which only ``M`` and ``j`` are
        differentiated.
        """
        c = self._compression(q, stiffness)
        oracle, P, impulse = self.oracle, c.columns, c.impulse(c.state)
        x = ImpulseResponse(P.a @ impulse, P.f @ impulse)
        weighed = oracle.weigh(x.a)
        b = oracle.respond(weighed)
        X = c.adjoint(P.a.T @ (2 * weighed))
        normal, pushed = np.array(oracle.contact.normal), 2 * (P.a @ X[:, -1] + impulse[-1] * b.a)
        gradient = oracle.coupling(normal, pushed, oracle.case.in_contact_frame) - 2 * oracle.inertial(b, x)
        weights, axes = np.linalg.eigh(X)
        for weight, axis in zip(weights, axes.T, strict=True):
            mode = ImpulseResponse(P.a @ axis, P.f @ axis)
            gradient = gradient - weight * oracle.inertial(mode, mode)
        return np.asarray(gradient + oracle.metric_gradient(x.a))

    def _compression(self, q: Array, stiffness: float) -> _Compression:
        """Check the contact stiffness, then compute the compression at an approach speed of 1 m/s."""
        if not _SOFTEST <= stiffness <= _STIFFEST:
            hint = f"give {_SOFTEST:g} to {_STIFFEST:g} N/m"
            raise InputError(f"is {stiffness:g} N/m", where="contact_stiffness", hint=hint)
        oracle = self.oracle.at(q)
        rows = np.vstack([np.eye(oracle.robot.nv)[self.joints], -oracle.n @ oracle.J])
        if oracle.quantities(q).blocked:
            where, hint = f"frame {oracle.contact.frame}", "choose another frame, normal or posture"
            raise ContactError("the contact cannot move along its normal", where=where, hint=hint)
        columns = oracle.respond(-rows.T)
        A = np.diag(np.append(1 / self.rotors, 0.0)) - rows @ columns.a
        kappa, d = np.append(self.kappa, float(stiffness)), np.append(self.d, 0.0)
        return _Compression((A + A.T) / 2, columns, kappa, d, oracle)

    def compliance(self, q: Array) -> float:
        """Return the compliance ``C`` of the springs at the contact point at ``q``, m/N.

        Rotors and feet are treated as fixed.  If the robot has no supports, the base is also treated as fixed.
        """
        oracle = self.oracle.at(q)
        feet = oracle.Js
        moving = np.append(np.arange(6 if len(feet) else 0), self.joints)
        j, held = (oracle.n @ oracle.J)[moving], feet[:, moving]
        K = np.append(np.zeros(len(moving) - len(self.joints)), self.kappa)
        stiffness = np.diag(K) + _HELD * self.kappa.max() * held.T @ held
        return float(j @ np.linalg.lstsq(stiffness, j, rcond=None)[0])


class _Compression:
    """Motion of springs and contact from touch to greatest compression, at an approach speed of 1 m/s.

    ``mobility`` is the matrix ``A``.  ``columns`` contains ``P = −M⁻¹Cᵀ``, shape (nv, m+1), and the support impulses;
    the docstring of this module defines ``A`` and ``C``.
    """

    def __init__(
        self, mobility: Array, columns: ImpulseResponse, kappa: Array, d: Array, oracle: ImpactOracle
    ) -> None:
        self.mobility, self.columns, self.kappa, self.d, self._oracle = mobility, columns, kappa, d, oracle
        try:
            self._L = np.linalg.cholesky(mobility)
        except np.linalg.LinAlgError:
            hint = "correct [armature] of robot.toml"
            raise InputError("rotors are too heavy for their links", where="elastic joints", hint=hint) from None
        R = np.sqrt(kappa)[:, None] * self._L
        self._generator = np.block([[np.zeros_like(R), R], [-R.T, -(self._L.T * d) @ self._L]])
        self._fastest = float(np.linalg.norm(self._generator, 2))
        # At touch, only the compression δ changes.  δ̇ is the last row of L times the velocity part of the state.
        self._row, self._start = np.append(np.zeros(len(R)), self._L[-1]), np.zeros(2 * len(R))
        self._start[-1] = 1 / self._L[-1, -1]
        self.duration, self.state = self._greatest_compression()

    def impulse(self, states: Array) -> Array:
        """Return the impulses ``I``, springs first, shape (m+1, …), for one state or for states as columns."""
        moved = (self._start - states.T).T[len(self.kappa) :]
        return np.asarray(scipy.linalg.solve_triangular(self._L, moved, trans=1, lower=True))

    def force(self, states: Array) -> Array:
        """Return the forces ``κc + dċ``, springs first; ``states`` is one state, or one state per column."""
        r = len(self.kappa)
        return np.asarray((np.sqrt(self.kappa) * states[:r].T + self.d * (self._L @ states[r:]).T).T)

    def _greatest_compression(self) -> tuple[float, Array]:
        """Return the first root ``T`` of ``p = δ̇/v``, and the state at ``T``.

        The energy of the second derivative of ``c`` is ``k²v²G/2`` at touch and never increases, so ``|p̈| ≤ kG`` and
        ``p(t+h) ≥ p + ṗh − kGh²/2``.  Each step goes to the root of the lower bound.  The steps cannot overshoot the
        first root of ``p``, and converge quadratically.
        """
        bound = float(self.kappa[-1] * self.mobility[-1, -1])
        row, t, state = self._row, 0.0, self._start
        while (p := float(row @ state)) > 0:
            rate = float(row @ self._generator @ state)
            root = math.sqrt(rate**2 + 2 * bound * p)
            step = 2 * p / (root - rate) if rate < 0 else (root + rate) / bound
            if step <= 1e-15 * t:
                break
            t += step
            if t * self._fastest > _LONGEST:
                what = "joints are too stiff or too damped for a contact as soft as this one"
                hint = "give a larger contact stiffness, or state a rigid transmission"
                raise InputError(what, where="contact_stiffness", hint=hint)
            state = scipy.linalg.expm(step * self._generator) @ state
        return t, state

    def peaks(self) -> tuple[float, Array]:
        """Return the largest ``‖ẋ‖²_W`` and the largest ``|τ|`` of each spring.

        Values and slopes are exact at the samples; cubic polynomials interpolate between them.
        """
        count = int(np.clip(self.duration * self._fastest / _SAMPLE, _FEWEST, _MOST))
        step, states = scipy.linalg.expm(self.duration / count * self._generator), [self._start]
        for _ in range(count - 1):
            states.append(step @ states[-1])
        Y, times = np.array([*states, self.state]).T, np.linspace(0.0, self.duration, count + 1)
        x, torques, rates = self.columns.a @ self.impulse(Y), self.force(Y), self.force(self._generator @ Y)
        weighed = self._oracle.weigh(x)
        slope = 2 * np.sum(weighed * (self.columns.a @ torques), axis=0)
        largest = [_peak(times, *curve) for curve in zip(torques[:-1], rates[:-1], strict=True)]
        return _peak(times, np.sum(x * weighed, axis=0), slope), np.array(largest)

    def adjoint(self, g: Array) -> Array:
        """Return the symmetric ``X`` with ``⟨X, dA⟩ = gᵀdI(T)``, shape (m+1, m+1), including the change of ``T``."""
        r, L, T = len(self.kappa), self._L, self.duration
        weighed, rate = scipy.linalg.cho_solve((L, True), g), self._generator @ self.state
        seed = np.append(np.zeros(r), -L.T @ weighed)
        seed = seed - self._row * (seed @ rate) / (self._row @ rate)
        moved = T * scipy.linalg.expm_frechet(T * self._generator.T, np.outer(seed, self._start), compute_expm=False)
        # The lower rows of the generator equal −L⁻¹A [κ^½, d L].  For fixed L, A appears nowhere else in the
        # generator.
        inner = moved[r:, :r] * np.sqrt(self.kappa) + (moved[r:, r:] @ L.T) * self.d
        X = scipy.linalg.solve_triangular(L, inner, trans=1, lower=True) + np.outer(weighed, self.impulse(self.state))
        return np.asarray(-(X + X.T) / 2)


def _peak(times: Array, values: Array, slopes: Array) -> float:
    """Return the largest absolute value of the piecewise cubic with these values and slopes at ``times``."""
    # Importing SciPy here and not at the top saves a quarter of a second for all robots without elastic joints.
    from scipy.interpolate import CubicHermiteSpline

    cubic = CubicHermiteSpline(times, values, slopes)
    return float(np.nanmax(np.abs([*values, *cubic(cubic.derivative().roots(extrapolate=False))])))
