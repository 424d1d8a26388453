"""Strokes: the run-up to an impact velocity, and the stop after it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin

from impact_posture.dynamics.numeric import Numeric
from impact_posture.path.actuator_limits import ActuatorLimits, Need
from impact_posture.path.path_curve import DEVIATION, PathCurve
from impact_posture.path.path_space import STEP, PathSpace
from impact_posture.path.time_law import TimeLaw, polynomial, whole
from impact_posture.path.timed_curve import moment
from impact_posture.posture.approach.attainable_speed import RUN_UP
from impact_posture.system.arrays import Array

# Lengths of the curve of a stroke, given as the time, s, that the curve would take at the velocity of the impact.  A
# greater length is tried only if smaller lengths do not suffice.
_LENGTHS = (0.1, 0.5, 1.5)
# Tangent length between two knots of a stroke, rad mixed with m.
_KNOTS = STEP / 2
# Largest tangent length of a stroke, rad mixed with m.
_FARTHEST = 1.5
# Least tangent speed with which a curve is computed, rad/s mixed with m/s.
_AT_REST = 1e-9
# Least number of knots of a stroke.
_LEAST = 8
# Maximum number of times that the length of a curve is halved until its knots suffice.
_HALVINGS = 3
# A stroke ends where its velocity exceeds this multiple of ``u``, the velocity at the posture ``q``.
_FASTER = 3.0
# A stroke ends where inequalities or joint limits deflect a step by more than this fraction of its planned length.
_DEFLECTED = 0.01
# Singular values below this share of the largest one are zero.
_RANK = 1e-9
# Shortest duration of a run-up, s, which a controller can follow: without rotors, and with rotors, whose thrust lags.
# A stop also takes at least this time, unless its curve is too short.
SHORTEST = (RUN_UP, 0.2)
# Ratio of successive trial durations of a stroke.
_LONGER = 1.3
# Number of bisections between two trial durations.
_BISECTIONS = 5
# Number of instants at which a stroke is checked.
_INSTANTS = 25
# A stroke uses at most this share of the range of torques and thrusts.  The rest is left to the controller.
SHARE = 0.95
_SINGULAR, _BENT = "a posture that is nearly singular", "a sharp bend of the constraints"
# Progress over τ = t/T, highest power first: the speed rises as 3τ² − 2τ³ to its end value, or falls from it.
_RISING, _FALLING = np.array([-1.0, 2.0, 0.0, 0.0, 0.0]), np.array([1.0, -2.0, 0.0, 2.0, 0.0])


class Stroke:
    """A smooth curve on the constraints that ends or begins at a posture ``q`` with the velocity ``u``.

    The curve follows ``dq/db = u + A⁺(q)(A(q₀)u − A(q)u)`` from ``q₀ = q``.  This velocity is the nearest to ``u``
    with ``A(q) dq/db = A(q₀)u``.  ``b`` is the time, s, for which the curve would take this velocity.

    Args:
        space: Postures that the curve may pass.
        q: Posture with the velocity ``u``, shapes (nq,) and (nv,).
        rows: Function that returns the matrix ``A``, shape (m, nv), for the model at a posture.
        time: Desired length of the curve, given as the largest ``b``, s.
        before: Whether the curve ends at ``q``, instead of beginning there.

    Attributes:
        curve: The curve; ``None`` if it is too short for a spline.
        time: Actual length of the curve, as the largest ``b``, s.
        end: Why the curve is shorter than desired; empty if it is not.
    """

    def __init__(
        self, space: PathSpace, q: Array, u: Array, rows: Callable[[Numeric], Array], time: float, *, before: bool
    ) -> None:
        self._space, self._u, self._before = space, u, before
        self.curve: PathCurve | None = None
        model, numeric = space.model, Numeric(space.model)
        kept = rows(numeric.at(q)) @ u

        def along(at: Array) -> Array:
            A = rows(numeric.at(at))
            return np.asarray(u + np.linalg.pinv(A, rcond=_RANK) @ (kept - A @ u))

        # After a plastic impact, a robot can be at rest.
        size = max(float(np.linalg.norm(u)), _AT_REST)
        self.time = min(time, _FARTHEST / size)
        count = max(_LEAST, int(np.ceil(self.time * size / _KNOTS)))
        shorter = ""
        for _ in range(_HALVINGS + 1):
            h, postures, self.end = (-1 if before else 1) * self.time / count, [q], shorter
            for _ in range(count):
                middle = along(np.array(pin.integrate(model, postures[-1], h / 2 * along(postures[-1]))))
                if np.linalg.norm(middle) > _FASTER * size:
                    self.end = _SINGULAR
                    break
                step = h * middle
                moved = space.pulled(postures[-1], step)
                off = np.inf if moved is None else np.linalg.norm(space.difference(postures[-1], moved) - step)
                if moved is None or off > _DEFLECTED * abs(h) * size or not space.clear(postures[-1], moved):
                    self.end = self._obstacle(postures[-1], step)
                    break
                postures.append(moved)
            self.time = abs(h) * max(1, len(postures) - 1)
            if len(postures) > _LEAST // 2:
                ends = (None, u * self.time) if before else (u * self.time, None)
                curve = PathCurve(space, postures[::-1] if before else postures, ends)
                if curve.deviation() <= DEVIATION:
                    self.curve = curve
                    return
            # A shorter curve has more knots for its length.
            self.time, shorter = self.time / 2, self.end or _BENT

    def _obstacle(self, q: Array, step: Array) -> str:
        """Return the names of the inequalities that a step violates."""
        violations = self._space.violations(np.array(pin.integrate(self._space.model, q, step)))
        held = {c.name for c in self._space.problem.constraints if c.equality}
        violated = [name for name, size, tolerance in violations if size > tolerance and name not in held]
        # ``clear`` can also detect a violation between the two postures.
        return ", ".join(violated) or "a constraint"

    def law(self, duration: float, factor: float = 1.0) -> TimeLaw:
        """Return the progress from rest to ``factor u``, or from ``factor u`` to rest, without a jump of ``s̈``."""
        duration = whole(duration)
        part = factor * duration / 2 / self.time
        coefficients = part * (_RISING if self._before else _FALLING)
        coefficients[-1] = 1 - part if self._before else 0.0
        return polynomial(coefficients, duration)

    def need(self, limits: ActuatorLimits, duration: float, factor: float, stop: bool = False) -> Need:
        """Return the largest share of a limit at instants of a motion; ``stop`` ends at the first share above 1.

        The velocity at ``q`` is treated as permitted, because a velocity jump may exceed the limits.
        """
        assert self.curve is not None  # noqa: S101 (narrows a type)
        law, worst = self.law(duration, factor), Need(0.0, "")
        allowed = np.maximum(self._space.problem.robot.velocity_limits, factor * np.abs(self._u) * (1 + 1e-9))
        for t in np.linspace(0.0, law.duration, _INSTANTS):
            needed = limits.need(moment(self.curve, law, float(t)), allowed, SHARE)
            worst = max(worst, needed, key=lambda need: need.share)
            if stop and worst.share > 1:
                break
        return worst

    def shortest(self, limits: ActuatorLimits, factor: float = 1.0) -> float | None:
        """Return the shortest duration within the limits, s; ``None`` if the curve is too short for any duration."""
        most = self._longest(factor)
        if self._too_short(limits, factor):
            return None

        def works(duration: float) -> bool:
            return self.need(limits, duration, factor, stop=True).share <= 1

        low = high = min(SHORTEST[limits.rotors], most)
        while not works(high):
            if high >= most:
                return None
            low, high = high, min(_LONGER * high, most)
        for _ in range(_BISECTIONS if low < high else 0):
            middle = (low + high) / 2
            low, high = (low, middle) if works(middle) else (middle, high)
        return high

    def _longest(self, factor: float) -> float:
        return 2 * self.time / factor

    def _too_short(self, limits: ActuatorLimits, factor: float) -> bool:
        return self._before and self._longest(factor) < SHORTEST[limits.rotors]

    def hindrance(self, limits: ActuatorLimits, factor: float) -> str:
        """Return what prevents a motion with the velocity ``factor u``: the limit with the least excess, and why."""
        room = f", and the motion cannot be longer because of {self.end}" if self.end else ""
        if self._too_short(limits, factor):
            return f"the shortest run-up of {SHORTEST[limits.rotors]:g} s{room}"
        durations = np.geomspace(min(SHORTEST[0], self.time / factor), self._longest(factor), 12)
        return min((self.need(limits, d, factor) for d in durations), key=lambda need: need.share).of + room


def shortest_stroke(
    space: PathSpace,
    q: Array,
    u: Array,
    rows: Callable[[Numeric], Array],
    limits: ActuatorLimits,
    *,
    before: bool,
    factor: float = 1.0,
) -> tuple[Stroke, float | None]:
    """Return a stroke and its shortest duration within the limits, s; ``None`` if no duration suffices."""
    for time in _LENGTHS:
        stroke = Stroke(space, q, u, rows, time, before=before)
        duration = None if stroke.curve is None else stroke.shortest(limits, factor)
        if duration is not None or stroke.end:
            break
    return stroke, duration
