"""Impact-robust posture task, which adds the term ``−K ∇H(q)`` to the posture task."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Any, Literal

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.config.checked import checked
from impact_posture.config.demand import Demand, NonNegative, OneOrMore, Positive
from impact_posture.errors import InputError, MetricError
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array
from impact_posture.tsid.joint_ranges import JointRanges
from impact_posture.tsid.smooth_step import smooth
from impact_posture.tsid.state import State
from impact_posture.tsid.tasks.activation import Activation, Phase
from impact_posture.tsid.tasks.joint_posture import JointPosture

Gradient = Callable[[Array], tuple[float, Array]]
Spring = Literal["keep", "release", "follow"]

# Step of the central differences of the gradient, rad.
_STEP = 1e-5
# Lower bound on the curvature scale ``λ``, as a fraction of H, per rad².
_FLAT = 1e-3
# Default distances from a position limit between which the term fades out, rad (m).
FADE = (0.05, 0.2)


def gradient_of(export: ImpactGradient, normal: ArrayLike | None = None) -> Gradient:
    """Return the gradient function of a compiled export for the impact-robust term.

    Args:
        export: Export of the robot.  To ignore the robot's supports, load the export with ``free=True``.
        normal: Unit normal for ``H`` (function ``_eval`` of the export).  With ``None``, the result is the gradient
            of the exported objective, for the normal of the export (function ``_objective``).

    Raises:
        InputError: The normal is not a unit vector.
    """
    if normal is None:
        return export.objective
    n = np.array(normal, dtype=float)
    if n.shape != (3,) or not abs(float(np.linalg.norm(n)) - 1) < 1e-6:
        raise InputError("is not a unit vector of three numbers", where="normal", hint="normalize it")
    return lambda q: export.value_and_gradient(q, n)


def fitting_gradient(robot: Robot, gradient: Gradient | ImpactGradient) -> Gradient:
    """Return a gradient function, or the gradient function of a compiled export (:func:`gradient_of`).

    Raises:
        ManifestMismatch: The export belongs to another robot.
    """
    if not isinstance(gradient, ImpactGradient):
        return gradient
    gradient.check_robot(robot)
    return gradient_of(gradient)


_Fade = Annotated[
    tuple[float, float], Demand(lambda fade: 0 <= fade[0] < fade[1], "two distances, zero or more, the lower first")
]


@checked
class ImpactRobustPosture(JointPosture):
    """``ν̇* = K_p (q_des ⊖ q) − K_d ν − α K s(q) ∇H(q)/λ`` (Afifi et al. 2026, impact-robust posture).

    - ``λ`` is the largest curvature of ``H`` along the redundancy at ``reset`` (:meth:`normalize`).  Because of
      ``λ``, ``K`` is a stiffness in 1/s² like ``K_p`` on every robot, although ``H`` scales with 1/armature².  Near
      an optimum with the curvature ``λ*``, the term is a spring with the stiffness ``K λ*/λ``.  This stiffness can be
      several times ``K``, because ``λ`` is the curvature at the start, where ``H`` may even be concave.
    - By default, ``K_d = 2√(K_p + K)``.  If ``λ* = λ``, this damping is critical for the sum ``K_p + K`` of the
      stiffnesses.
    - The length of the term is at most ``K·reach``, as for a spring with the stiffness ``K`` and the length
      ``reach``.  If this bound were below ``K_p|q_des ⊖ q|``, the robot would stop before the optimum.
    - ``s(q)`` fades out the part of the term that pushes a joint into a position limit.  The fade begins
      ``fade[1]`` rad before the limit and ends ``fade[0]`` rad before the limit.  ``fade[1]`` is limited to a quarter
      of the joint's range, and ``fade[0]`` to a sixteenth.  Without ``s(q)``, the robot would move to its mechanical
      stops.
    - ``α`` is the level of :class:`~impact_posture.tsid.tasks.activation.Activation`.

    ``spring`` determines ``K_p`` and ``q_des`` while the term is on.  With ``keep``, the robot comes to rest at
    ``K∇H/λ = K_p(q_des ⊖ q)``, before it reaches the optimum.  With ``release``, ``K_p`` is scaled by ``1 − α``, and
    the robot reaches the optimum.  With ``follow``, ``q_des`` follows ``q`` with the time constant ``follow`` (s), so
    the spring still resists fast motion.

    After :meth:`release`, and after :meth:`contact` if the activation is not ``live``, the reached posture becomes
    ``q_des``.  This target fades in while the term fades out.

    Attributes:
        K: Gain, 1/s².
        scale: Curvature scale ``λ``, in the objective's unit per rad².
        activation: Phase and level ``α`` of the term.
        value: ``H`` (or the objective) at the last evaluation.
        term: Bounded term ``−K s(q) ∇H/λ`` at the last evaluation, for ``α = 1``, shape (nv,).
        failed: Whether the last evaluation raised an exception or was not finite; the previous term is then used.
    """

    def __init__(
        self,
        robot: Robot,
        gradient: Gradient | ImpactGradient,
        target: ArrayLike | None = None,
        *,
        K: NonNegative = 10.0,
        name: str = "impact-robust posture",
        spring: Spring = "keep",
        follow: Positive = 0.5,
        reach: Positive = 2.0,
        fade: _Fade = FADE,
        every: OneOrMore = 5,
        scale: Positive | None = None,
        activation: Activation | None = None,
        **gains: Any,
    ) -> None:
        """Set gains and options.

        Args:
            robot: The robot.
            gradient: Function ``q → (H, ∇H)``, or a compiled export with its exported objective.
            target: Target posture ``q_des``, shape (nq,); by default, the posture at ``reset``.
            K: Gain, 1/s².
            name: Name in reports.
            spring: Mode of ``K_p`` and ``q_des`` while the term is on: ``keep``, ``release`` or ``follow``.
            follow: Time constant of ``spring = "follow"``, s.
            reach: Largest length of the term, divided by ``K``, rad.
            fade: Two distances from a position limit between which the term fades out, rad (m).
            every: Number of ticks from one evaluation of the gradient to the next.
            scale: Curvature scale ``λ``; by default, measured at ``reset``.
            activation: Phase and level of the term; by default, a new :class:`Activation`.
            gains: Arguments of :class:`~impact_posture.tsid.tasks.joint_posture.JointPosture`.

        Raises:
            InputError: A number is out of range.
            ManifestMismatch: The export belongs to another robot.
        """
        super().__init__(robot, target, name=name, **gains)
        self.K, self.scale = float(K), 1.0 if scale is None else float(scale)
        self.activation = activation or Activation()
        self.spring, self.reach, self.every = spring, float(reach), int(every)
        if gains.get("kd") is None:
            self.kd = 2.0 * np.sqrt(self.kp + self.K)
        self._function = fitting_gradient(robot, gradient)
        self._measure, self._follow = scale is None, float(follow)
        ranges = JointRanges(robot)
        width = ranges.upper - ranges.lower
        near, self._farthest = np.minimum(fade[0], width / 16), fade[1]
        # Use lists, because only a few joints are near a limit, and lists give single numbers faster than arrays do.
        self._near, self._band = near.tolist(), (np.minimum(fade[1], width / 4) - near).tolist()
        self._count, self._hold = 0, False
        self.value, self.term, self.failed = 0.0, np.zeros(robot.nv), False
        self._spare = np.zeros(robot.nv)

    def brace(self) -> None:
        """Switch the impact-robust term on, because an impact is coming."""
        self.activation.enter(Phase.BRACE)

    def contact(self) -> None:
        """During the impact, hold the reached posture or, if ``activation.live``, keep the impact-robust term on."""
        self.activation.enter(Phase.CONTACT)
        self._hold = not self.activation.live

    def release(self) -> None:
        """Switch the impact-robust term off after the impact, and make the reached posture the target."""
        was_on = self.activation.goal > 0
        self.activation.enter(Phase.RELEASE)
        self._hold = self._hold or was_on

    @property
    def level(self) -> float:
        """Level ``α`` of the activation, 0 to 1."""
        return self.activation.level

    def reset(self, state: State) -> None:
        """Set the phase to FREE and the target to the constructor's posture, and evaluate the objective."""
        super().reset(state)
        self.activation.reset()
        self._count, self._hold, self.failed = 0, False, False
        self.value = self._function(state.q)[0]

    def normalize(self, state: State, redundancy: Array) -> None:
        """Measure ``λ`` at ``state`` (:func:`curvature_scale`), unless the constructor was called with a ``scale``.

        Raises:
            MetricError: At this state, the gradient does not exist, or ``H`` and its curvature are zero.
        """
        if self._measure:
            self.scale = curvature_scale(self._function, self._model, state.q, redundancy, self.name)

    def advance(self, state: State, dt: float) -> None:
        """Advance ramps, fades and ``q_des`` by ``dt`` seconds; every ``every`` ticks, evaluate the gradient."""
        if self._hold:
            self._hold = False
            # With "release", the spring comes back at the reached posture.  With "keep", the target moves to the
            # reached posture as slowly as the term fades.
            self._fade_to(state.q, self.activation.ramp)
        super().advance(state, dt)
        level = self.activation.advance(dt)
        if level <= 0:
            return
        if self.spring == "follow" and self._blend >= 1:
            share = level * (1 - math.exp(-dt / self._follow))
            away = pin.difference(self._model, self._target, state.q)
            self._target[:] = pin.integrate(self._model, self._target, share * away)
        self._count -= 1
        if self._count <= 0:
            self._count = self.every
            self._evaluate(state)

    def pull(self, state: State) -> Array:
        """Return ``K_p (q_des ⊖ q)``, shape (nv,); the spring mode ``release`` scales the result by ``1 − α``."""
        pull = super().pull(state)
        if self.spring == "release" and self.activation.level > 0:
            pull *= 1.0 - self.activation.level
        return pull

    def feedforward(self, state: State) -> Array | None:
        level = self.activation.level
        if level <= 0:
            return None
        return self.term if level == 1 else level * self.term

    def _evaluate(self, state: State) -> None:
        """Evaluate the term at ``state``; keep the previous term if the gradient does not exist."""
        term, bound = self._spare, self.K * self.reach
        try:
            value, gradient = self._function(state.q)
            np.multiply(gradient, -self.K / self.scale, out=term)
        except Exception:
            # A user's function may raise any exception, but the tick must not fail.  `failed` reports the problem.
            self.failed = True
            return
        square = term.dot(term)
        if not square <= bound * bound:
            if not math.isfinite(square):
                self.failed = True
                return
            term *= bound / math.sqrt(square)
        if state.least_room < self._farthest:
            self._fade(term, state.rooms)
        self.value, self.failed = value, False
        self.term, self._spare = term, self.term

    def _fade(self, term: Array, rooms: Array) -> None:
        size = term.size
        for at in (rooms < self._farthest).nonzero()[0].tolist():
            # The first half of ``rooms`` contains the distances from upper limits, the second half from lower limits.
            below, k = divmod(at, size)
            push = term.item(k)
            if (push < 0) if below else (push > 0):
                distance, band = rooms.item(at) - self._near[k], self._band[k]
                if distance < band:
                    term[k] = push * smooth(distance / band) if distance > 0 else 0.0


def curvature(gradient: Gradient, model: pin.Model, q: Array, directions: Array) -> Array:
    """Return ``∇²H Z`` at ``q`` by central differences of the gradient, for directions ``Z`` of shape (nv, r)."""
    # Copy each result, because a gradient function may return the same buffer at each call.
    ahead, behind = (
        np.column_stack([np.array(gradient(pin.integrate(model, q, step * z))[1]) for z in directions.T])
        for step in (_STEP, -_STEP)
    )
    return np.asarray((ahead - behind) / (2 * _STEP))


def curvature_scale(gradient: Gradient, model: pin.Model, q: Array, redundancy: Array, name: str) -> float:
    """Return ``λ`` at ``q``: the spectral norm of ``Zᵀ∇²H Z`` with ``Z`` = ``redundancy``, shape (nv, r).

    ``λ`` is at least a thousandth of ``H`` per rad², so that a flat ``H`` does not lead to a large term.  If there is
    no redundancy, ``Z`` is the identity.

    Raises:
        MetricError: At ``q``, the gradient does not exist, or ``H`` and its curvature are zero.
    """
    Z = redundancy if redundancy.shape[1] else np.eye(model.nv)
    # Take differences along the coordinate axes of ν.  Differences along a basis of the redundancy would have errors
    # that depend on the basis.
    change = curvature(gradient, model, q, np.eye(model.nv))
    scale = max(float(np.linalg.norm(Z.T @ change @ Z, 2)), _FLAT * abs(gradient(q)[0]))
    if not (np.isfinite(scale) and scale > 0):
        what = "the objective and its curvature are zero or do not exist"
        raise MetricError(what, where=name, hint="start at another posture, or give `scale`")
    return scale
