"""Impact-robust posture task, which adds ``−K ∇H(q)`` to the posture task."""

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
# Least curvature that counts, per rad², as a share of H.
_FLAT = 1e-3


def gradient_of(export: ImpactGradient, normal: ArrayLike | None = None) -> Gradient:
    """Return the gradient of a compiled export for the impact-robust term.

    Args:
        export: Export of the robot.  Load it with ``free=True`` for the robot without its supports.
        normal: Normal at which ``H`` is evaluated (function ``_eval`` of the export).  ``None`` evaluates the
            objective of the exported problem at its normal (``_objective``): ``impulse``, ``speed``, ``sticking``,
            ``energy``, ….

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
    """Return the gradient as a function; raise :class:`ManifestMismatch` for an export of another robot."""
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

    - ``λ`` is the largest curvature of ``H`` along the redundancy at ``reset`` (:meth:`normalize`).  ``K`` is then a
      stiffness like ``K_p``, in 1/s², on every robot, although ``H`` scales like 1/armature².  Near an optimum with
      the curvature ``λ*``, the term is a spring ``K λ*/λ``.  This can be several times as stiff as ``K``, because
      ``λ`` is the curvature at the start, where ``H`` may even be concave.
    - ``K_d = 2√(K_p + K)`` by default, critical for both springs together where ``λ* = λ``.
    - The length of the term is at most ``K·reach``, like a spring ``K`` stretched by ``reach``.  A bound below
      ``K_p|q_des ⊖ q|`` would stop the robot short of the optimum.
    - ``s(q)`` fades out the part of each joint that pushes into a position limit, from ``fade[1]`` rad before the
      limit to ``fade[0]`` (at most a quarter and a sixteenth of the joint's range).  Without it, the robot would
      brace on its stops.
    - ``α`` is the level of :class:`~impact_posture.tsid.tasks.activation.Activation`.

    ``spring`` says what happens to ``K_p`` while the term is on.  ``keep``: the robot rests where
    ``K∇H/λ = K_p(q_des ⊖ q)``, short of the optimum.  ``release``: ``K_p`` is scaled by ``1 − α``, and the robot
    reaches the optimum.  ``follow``: ``q_des`` follows ``q`` with the time constant ``follow`` (s), so that the
    spring still resists fast motion.

    :meth:`contact` (unless the activation is ``live``) and :meth:`release` make the reached posture ``q_des``.  It
    fades in while the term fades out.

    Attributes:
        K: Gain, 1/s².
        scale: ``λ``, in the objective's unit per rad².
        activation: The state machine.
        value: ``H`` (or the objective) at the last evaluation.
        term: ``−K s(q) ∇H/λ`` there, bounded, at full level, shape (nv,).
        failed: Whether the last evaluation raised or was not finite.  The previous term then stays.
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
        fade: _Fade = (0.05, 0.20),
        every: OneOrMore = 5,
        scale: Positive | None = None,
        activation: Activation | None = None,
        **gains: Any,
    ) -> None:
        """Set gains and options; see the class.

        Args:
            robot: The robot.
            gradient: ``q → (H, ∇H)``, or a compiled export, whose exported objective is then used.
            target: ``q_des``, shape (nq,); the posture at ``reset`` by default.
            K: Gain, 1/s².
            name: Name in reports.
            spring: ``keep``, ``release`` or ``follow``.
            follow: Time constant of ``spring = "follow"``, s.
            reach: Bound of the term divided by ``K``, rad.
            fade: Distances from a position limit between which the term fades out, rad (m).
            every: Ticks between evaluations of the gradient.
            scale: ``λ``; measured at ``reset`` by default.
            activation: The state machine.
            gains: Arguments of :class:`~impact_posture.tsid.tasks.joint_posture.JointPosture`.

        Raises:
            InputError: A number is out of range.
            ManifestMismatch: The export is of another robot.
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
        # Lists, because few joints are near a limit, and access to one number is faster in a list than in an array.
        self._near, self._band = near.tolist(), (np.minimum(fade[1], width / 4) - near).tolist()
        self._count, self._hold = 0, False
        self.value, self.term, self.failed = 0.0, np.zeros(robot.nv), False
        self._spare = np.zeros(robot.nv)

    # ---- phases of an impact ------------------------------------------------------------------------------------

    def brace(self) -> None:
        """Switch the term on, because an impact is coming."""
        self.activation.enter(Phase.BRACE)

    def contact(self) -> None:
        """Hold the reached posture during the impact, or keep the term on if the activation is live."""
        self.activation.enter(Phase.CONTACT)
        self._hold = not self.activation.live

    def release(self) -> None:
        """Switch the term off after the impact and hold the reached posture."""
        was_on = self.activation.goal > 0
        self.activation.enter(Phase.RELEASE)
        self._hold = self._hold or was_on

    @property
    def level(self) -> float:
        """Level ``α`` of the activation, 0 to 1."""
        return self.activation.level

    # ---- the task -------------------------------------------------------------------------------------------------

    def reset(self, state: State) -> None:
        """Return to FREE with the posture of the constructor, and evaluate the gradient."""
        super().reset(state)
        self.activation.reset()
        self._count, self._hold, self.failed = 0, False, False
        self.value = self._function(state.q)[0]

    def normalize(self, state: State, redundancy: Array) -> None:
        """Measure ``λ`` at ``state`` (:func:`curvature_scale`), unless the constructor got a ``scale``.

        Raises:
            MetricError: The gradient does not exist there, or ``H`` and its curvature vanish.
        """
        if self._measure:
            self.scale = curvature_scale(self._function, self._model, state.q, redundancy, self.name)

    def advance(self, state: State, dt: float) -> None:
        """Advance ramps, fades and a following ``q_des``; evaluate the gradient when it is due."""
        if self._hold:
            self._hold = False
            # A released spring returns at the reached posture.  A kept spring moves there as slowly as the term
            # fades.
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
        """Return ``K_p (q_des ⊖ q)``, with the option ``release`` scaled by ``1 − α``."""
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
        """Evaluate the term at ``state``; keep the previous one where the gradient does not exist."""
        term, bound = self._spare, self.K * self.reach
        try:
            value, gradient = self._function(state.q)
            np.multiply(gradient, -self.K / self.scale, out=term)
        except Exception:
            # A user's function may raise anything, but the tick must go on.  `failed` reports it.
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
            # The first half of the rooms belongs to the upper limits.
            below, k = divmod(at, size)
            push = term.item(k)
            if (push < 0) if below else (push > 0):
                distance, band = rooms.item(at) - self._near[k], self._band[k]
                if distance < band:
                    term[k] = push * smooth(distance / band) if distance > 0 else 0.0


def curvature(gradient: Gradient, model: pin.Model, q: Array, directions: Array) -> Array:
    """Return ``∇²H Z`` at ``q`` by central differences of the gradient, for directions ``Z`` of shape (nv, r)."""
    # Copies, because a gradient may return the same buffer at each call.
    ahead, behind = (
        np.column_stack([np.array(gradient(pin.integrate(model, q, step * z))[1]) for z in directions.T])
        for step in (_STEP, -_STEP)
    )
    return np.asarray((ahead - behind) / (2 * _STEP))


def curvature_scale(gradient: Gradient, model: pin.Model, q: Array, redundancy: Array, name: str) -> float:
    """Return ``λ`` at ``q``: the spectral norm of ``Zᵀ∇²H Z`` with ``Z`` = ``redundancy``, shape (nv, r).

    It is at least a thousandth of ``H`` per rad², because a flat ``H`` cannot be improved.  Without redundancy, ``Z``
    is the identity.

    Raises:
        MetricError: The gradient does not exist there, or ``H`` and its curvature vanish.
    """
    Z = redundancy if redundancy.shape[1] else np.eye(model.nv)
    # Along the axes, because the error of differences along a basis would depend on the choice of the basis.
    change = curvature(gradient, model, q, np.eye(model.nv))
    scale = max(float(np.linalg.norm(Z.T @ change @ Z, 2)), _FLAT * abs(gradient(q)[0]))
    if not (np.isfinite(scale) and scale > 0):
        what = "the objective vanishes with its curvature"
        raise MetricError(what, where=name, hint="start elsewhere, or give `scale`")
    return scale
