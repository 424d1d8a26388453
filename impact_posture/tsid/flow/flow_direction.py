"""Direction of the reference flow: a saddle-free Newton step on the constraints, solved as a QP with limits."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from impact_posture.config.checked import checked
from impact_posture.config.demand import Demand, NonNegative, Positive
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array
from impact_posture.tsid.flow.redundancy import Redundancy
from impact_posture.tsid.joint_ranges import JointRanges
from impact_posture.tsid.qp.daqp_solver import DaqpSolver
from impact_posture.tsid.qp.quadratic_program import QP
from impact_posture.tsid.state import State

# Least value of ``H/H₀`` in ``√(H/H₀)``.
LEAST_VALUE = 1e-8
# Below this sine of the tilt angle, the tilt axis is undefined, and the slope of the tilt is set to zero.
LEVEL = 1e-6
# Largest violation of a limit during braking, rad (m) for joints, and a fraction of the range for static controls.
NEAR = 1e-3
# The flow may move along a limit that it violates by less than this, in the same units as ``NEAR``.  If this value
# equaled ``NEAR``, the flow would slowly cross the limit.
SPENT = 9.9e-4
# Distance that the flow keeps from the joint limits, rad (m).
AIM = 2e-3
# Distance that the flow keeps from the limits of the static controls, as a fraction of the range.  This distance is
# larger than ``AIM``, because the slope of the static controls is only estimated.
RESERVE = 8e-3
# A limit is ignored if the squared norm of its row, projected onto the redundancy, is smaller than this.
FLAT = 1e-6
_PositiveShare = Annotated[float, Demand(lambda value: 0 < value <= 1, "a number above zero, up to 1")]


@checked
@dataclass(frozen=True)
class FlowOptions:
    """Parameters of the reference flow, whose defaults suit every robot.

    Attributes:
        speed: Largest speed ``v`` of an entry of ``q_r``, rad/s (m/s).
        acceleration: Largest acceleration ``a`` of an entry of ``q_r``, rad/s² (m/s²).  The flow moves so slowly that
            the deceleration ``2a/5`` stops it at the end of its step.
        rho: Weight ρ in ``Φ`` (:class:`FlowDirection`) of the squared distance from the start, 1/rad².
        mu: Smallest absolute curvature μ, per rad², relative to ``H₀``.  Smaller absolute curvatures are raised to μ.
        epsilon: Threshold ε, relative to ``H₀``.  The flow rests if the predicted decrease of ``H`` is below ε.  The
            flow resumes if this decrease is above 4 ε.
        duration: Longest time that the flow moves after each start, s.  Time on a path or at rest is not included.
        joint_margin: Distance from the joint limits, rad (m); at most an eighth of the range of a joint.
        com_margin: Distance of the center of mass from the edges of the support polygon, m.
        tilt: Largest angle between the vertical and :attr:`~impact_posture.robot.robot.Robot.upright`, rad.
        share: Share of the actuators' limits that the static controls at ``q_r`` may use.
        haste: Fraction of the control ranges left by the static controls that accelerations may use.  Braking before
            a limit may use the fraction ``(1 + haste)/2``.
        tracking: If the joints of the robot lag behind ``q_r`` by this error, rad (m), the flow stops and waits.
    """

    speed: Positive = 1.0
    acceleration: Positive = 4.0
    rho: NonNegative = 0.001
    mu: Positive = 0.05
    epsilon: Positive = 3e-6
    duration: Positive = 7.9
    joint_margin: NonNegative = 0.1
    com_margin: NonNegative = 0.05
    tilt: Positive = 0.8
    share: _PositiveShare = 0.8
    haste: _PositiveShare = 0.5
    tracking: Positive = 0.3


class FlowDirection:
    """Newton step ``δ = Z y`` of ``Φ = 2√(H/H₀) + ρ/2 ‖q_r ⊖ q₀‖²`` on the constraints.

    ``Φ`` contains the square root of ``H``, because the velocity jump is proportional to ``√H``.  ``y`` minimizes
    ``½ yᵀ|B_Z| y + (Zᵀ∇Φ)ᵀ y``.  ``B_Z`` is the curvature of ``H/H₀`` times ``√(H₀/H)`` plus the curvature of the
    second term of ``Φ``.  ``|B_Z|`` has the same eigenvectors as ``B_Z`` and the eigenvalues ``max(|λᵢ|, μ)``
    (saddle-free Newton, Dauphin et al. 2014), so that the step leaves saddle points.

    The curvature ``B`` is estimated from gradient differences by the Powell symmetric Broyden update.  The slope
    ``T`` of the static controls is estimated by the Broyden update.  Rows of the QP keep joints, center of mass, tilt
    of the base and static controls within their limits.  If ``q_r`` already violates a limit, the step does not
    increase the violation.

    Attributes:
        B: Estimated curvature of ``H/H₀`` on the constraints, shape (nv, nv).
        T: Estimated slope of the static controls (:class:`StaticControls`), shape (controls, nv).
        gain: Predicted decrease of ``H/H₀`` by the last step; at most the decrease in a first-order prediction.
        failures: Number of steps for which the solver failed; each of these steps is zero.
    """

    def __init__(self, robot: Robot, edges: Array, controls: int, options: FlowOptions) -> None:
        """Size the buffers.

        ``edges`` are the normals of the support polygon, shape (k, 2).  ``controls`` is the number of controls with
        limits.
        """
        nv, ranges = robot.nv, JointRanges(robot)
        self._joints = np.flatnonzero(np.isfinite(ranges.lower) & np.isfinite(ranges.upper))
        width = (ranges.upper - ranges.lower)[self._joints]
        self._margin = np.minimum(options.joint_margin, width / 8)
        self._edges, self._mu, self._tilt = edges, options.mu, options.tilt
        self._up = robot.upright
        # Index of the row of the tilt, the tilt angle, and the vertical in base axes.
        self._tilting, self._angle, self._vertical = self._joints.size + edges.shape[0], 0.0, np.zeros(3)
        # The distance from the start includes joints, but not the base.
        self._pull = np.full(nv, options.rho)
        self._pull[: robot.first_joint] = 0.0
        self.B, self.gain, self.failures = np.zeros((nv, nv)), 0.0, 0
        # The QP always has nv variables.  The columns beyond the dimension of the redundancy are zero.
        self._qp = QP.empty(nv, self._joints.size + edges.shape[0] + (1 if robot.floating else 0) + controls)
        self._solver = DaqpSolver(nv, self._qp.m)
        self._rows, self._room = np.zeros((self._qp.m, nv)), np.zeros((2, self._qp.m))
        self._rows[np.arange(self._joints.size), self._joints] = 1.0
        self.T = self._rows[self._qp.m - controls :]

    def learn(self, z: Array, curvature: Array, slope: Array) -> None:
        """Update the estimates ``B`` and ``T`` by differences along the unit vector ``z``, shape (nv,).

        ``curvature`` is the change of the gradient of ``H/H₀`` per rad along ``z``, shape (nv,).  ``slope`` is the
        change of the static controls per rad along ``z``, shape (controls,).
        """
        missing = curvature - self.B @ z
        missing -= z @ missing / 2 * z
        outer = np.multiply.outer(missing, z)
        self.B += outer
        self.B += outer.T
        self.T += np.multiply.outer(slope - self.T @ z, z)

    def limit(self, state: State, rooms: Array, shares: Array, coasting: Array) -> None:
        """Set the rows of the limits at a state with ``ν = 0``.

        ``rooms`` are the distances from the center of mass to the edges of the polygon, minus the margin, m, shape
        (k,).  ``shares`` are the static controls, shape (controls,).  ``coasting`` is the displacement of the flow
        while it brakes, shape (nv,).  The limits are tightened by ``coasting``.
        """
        upper, lower = self._qp.upper[self._qp.n :], self._qp.lower[self._qp.n :]
        count, k = self._joints.size, self._edges.shape[0]
        room = state.room[:, self._joints] - self._margin
        upper[:count], lower[:count] = room[0], -room[1]
        if k:
            np.matmul(self._edges, state.center_of_mass()[1][:2], out=self._rows[count : count + k])
            upper[count : count + k] = rooms
        count += k
        if self._up is not None:
            vertical = state.base_rotation[2]
            axis = np.cross(vertical, self._up)
            sine = math.sqrt(float(axis @ axis))
            self._rows[count, 3:6] = axis / sine if sine > LEVEL else 0.0
            self._angle, self._vertical[:] = math.atan2(sine, float(vertical @ self._up)), vertical
            upper[count] = self._tilt - self._angle
            count += 1
        upper[count:] = 1.0 - shares
        lower[count:] = -1.0 - shares
        for rows, aim in ((slice(0, self._joints.size), AIM), (slice(count, None), RESERVE)):
            upper[rows] -= aim
            lower[rows] += aim
        ahead = self._rows @ coasting
        np.maximum(upper, -SPENT, out=self._room[0])
        np.minimum(lower, SPENT, out=self._room[1])
        np.maximum(upper - np.maximum(ahead, 0.0), 0.0, out=upper)
        np.minimum(lower - np.minimum(ahead, 0.0), 0.0, out=lower)

    def newton(self, space: Redundancy, gradient: Array, value: float, offset: Array, error: Array) -> Array:
        """Return the Newton step δ, shape (nv,).

        ``gradient`` is ``∇H/H₀``, shape (nv,), ``value`` is ``H/H₀``, and ``offset`` is ``q_r ⊖ q₀``, shape (nv,).
        ``error`` is the error of the constraints, shape (rows,).
        """
        Z, root = space.basis, math.sqrt(max(abs(value), LEAST_VALUE))
        slope = Z.T @ (gradient / root + self._pull * offset)
        curvature = Z.T @ (self.B / root) @ Z + (Z.T * self._pull) @ Z
        if space.springs is not None:
            slope -= space.springs.T @ error
            curvature.flat[:: slope.size + 1] += space.stiffness
        values, vectors = np.linalg.eigh(curvature)
        axes = Z @ (vectors / np.sqrt(np.maximum(np.abs(values), self._mu)))
        step = self._solve(axes, axes.T @ (Z @ slope))
        # The step also decreases the distance term and the energy of the springs, but ``gain`` contains only ``H``.
        self.gain = min(self.gain * root, -float(gradient @ step))
        return step

    def towards(self, Z: Array, displacement: Array) -> Array:
        """Return the step nearest to ``displacement`` that respects constraints and limits, shape (nv,)."""
        return self._solve(Z, -Z.T @ displacement)

    def downhill(self, Z: Array, gradient: Array, flow: Array, stop: Array, step: Array) -> Array:
        """Return ``step`` without the part that increases ``H`` at the present ``q_r`` or where the flow stops.

        ``step`` is a change of the velocity ``flow``, shape (nv,).  ``Z`` is the basis of the redundancy, shape
        (nv, r), and ``gradient`` is ``∇H/H₀``.  ``stop`` is the displacement within which the flow stops.
        """
        for slope in (gradient + self.B @ stop, gradient):
            uphill = Z @ (Z.T @ slope)
            climb = float(uphill @ (flow + step))
            if climb > 0:
                step = step - uphill * (climb / float(uphill @ uphill))
        return step

    def stops(self, flow: Array, time: float) -> bool:
        """Return whether a motion with the velocity ``flow``, shape (nv,), respects limits for ``time`` seconds."""
        displacement = flow * time
        ahead = self._rows @ displacement
        if self._up is not None:
            ahead[self._tilting] = self._tilt_change(displacement, float(ahead[self._tilting]))
        return not float(np.maximum(ahead - self._room[0], self._room[1] - ahead).max(initial=0.0)) > NEAR

    def _tilt_change(self, displacement: Array, along: float) -> float:
        """Return the change of the tilt angle caused by a displacement, shape (nv,).

        ``along`` is the part of the base rotation about the tilt axis, rad.  A horizontal rotation perpendicular to
        the tilt axis increases the tilt only to second order.
        """
        turn = float(self._vertical @ displacement[3:6])
        aside = float(displacement[3:6] @ displacement[3:6]) - turn**2 - along**2
        return math.hypot(self._angle + along, math.sqrt(max(aside, 0.0))) - self._angle

    def along(self, Z: Array, flow: Array, time: float, step: Array) -> Array:
        """Remove from ``step`` the parts that cross limits, one limit after the other, and return the rest.

        ``step`` is a change of the velocity ``flow``, shape (nv,).  The robot moves with ``flow + step`` for ``time``
        seconds.  ``Z`` is the basis of the redundancy, shape (nv, r).
        """
        for k, (row, high, low) in enumerate(zip(self._rows, *self._room, strict=True)):
            displacement = time * (flow + step)
            ahead = float(row @ displacement)
            if self._up is not None and k == self._tilting:
                ahead = self._tilt_change(displacement, ahead)
            if low <= ahead <= high:
                continue
            across = Z @ (Z.T @ row)
            square = float(across @ across)
            if square > FLAT:
                step = step - across * ((ahead - min(max(ahead, low), high)) / time / square)
        return step

    def _solve(self, axes: Array, slope: Array) -> Array:
        """Return ``δ = axes·y``, where ``y`` minimizes ``½‖y‖² + slope·y``; return zero if the solver fails."""
        qp, r = self._qp, axes.shape[1]
        qp.A[:, :r] = self._rows @ axes
        qp.A[:, r:] = 0.0
        qp.g[:r], qp.g[r:] = slope, 0.0
        # Clear the active set.  With a warm start, a row that was zero in the last step would stay inactive.
        self._solver.reset()
        solved = self._solver.solve(qp)
        if solved is None:
            self.gain, self.failures = 0.0, self.failures + 1
            return np.zeros(axes.shape[0])
        y = solved.z[:r]
        self.gain = -float(slope @ y + y @ y / 2)
        return np.asarray(axes @ y)
