"""Direction of the reference flow: a saddle-free Newton step on the constraints, as a QP with limits."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np

from impact_posture.config.argument_types import checked_class
from impact_posture.errors import InputError
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array
from impact_posture.tsid.flow.redundancy import Redundancy
from impact_posture.tsid.joint_ranges import JointRanges
from impact_posture.tsid.qp.daqp_solver import DaqpSolver
from impact_posture.tsid.qp.quadratic_program import QP
from impact_posture.tsid.state import State

# Least ``H/H₀`` whose root counts.
_LEAST = 1e-8
# Sine of an angle of the base below which the tilt has no slope.
_LEVEL = 1e-6
# What a limit may be missed by where the flow brakes, rad (m), or as a share.
_NEAR = 1e-3
# What of that the flow takes where a limit is missed by so much already: along it, the flow would creep across.
_SPENT = 9.9e-4
# Distance from the limits of joints to which the flow aims, rad (m).
_AIM = 2e-3
# Distance from those of static controls, whose slope it learns, as a share.
_RESERVE = 8e-3
# Square of the length below which a row has no direction on the constraints.
_FLAT = 1e-6


@checked_class
@dataclass(frozen=True)
class FlowOptions:
    """Parameters of the reference flow; the same for every robot.

    Attributes:
        speed: Largest speed ``v`` of an entry of ``q_r``, rad/s (m/s).
        acceleration: Largest acceleration ``a``, rad/s² (m/s²); two fifths of it stop the flow on its step.
        rho: ρ, pull of the joints towards the start per rad², relative to ``H₀``.
        mu: μ, least curvature per rad², relative to ``H₀``.
        epsilon: ε, predicted decrease relative to ``H₀`` below which the flow rests; it resumes above 4 ε.
        duration: Longest time that the flow moves after it is told to, without that on a path and at rest, s.
        joint_margin: Distance from the joint limits, rad (m); at most an eighth of the range of a joint.
        com_margin: Distance of the center of mass from the edges of the support polygon, m.
        tilt: Largest angle between the vertical and :attr:`~impact_posture.robot.robot.Robot.upright`, rad.
        share: Share of the actuators' limits that holding ``q_r`` may take.
        haste: Share that accelerating may take of what is then left of the actuators' limits.  Braking before a limit
            may take half of the rest as well.
        tracking: Error of the joints at which the flow waits for the robot, rad (m).
    """

    speed: float = 1.0
    acceleration: float = 4.0
    rho: float = 0.001
    mu: float = 0.05
    epsilon: float = 3e-6
    duration: float = 7.9
    joint_margin: float = 0.1
    com_margin: float = 0.05
    tilt: float = 0.8
    share: float = 0.8
    haste: float = 0.5
    tracking: float = 0.3

    def __post_init__(self) -> None:
        """Refuse numbers out of range."""
        may_vanish = ("rho", "joint_margin", "com_margin")
        # Comparisons one by one refuse what is not a number, too.
        good = all(x > 0 or (x == 0 and name in may_vanish) for name, x in asdict(self).items())
        if not (good and max(self.share, self.haste) <= 1):
            raise InputError("a number is out of range", where="flow options", hint="see the docstring")


class FlowDirection:
    """Newton step ``δ = Z y`` of ``Φ = 2√(H/H₀) + ρ/2 ‖q_r ⊖ q₀‖²`` on the constraints.

    The root counts, because the velocity jump grows with it: low in a valley, the pull towards the start is weak.
    ``y`` minimizes ``½ yᵀ|B_Z| y + (Zᵀ∇Φ)ᵀ y``, where ``B_Z`` is the curvature of ``H/H₀`` times ``√(H₀/H)``, and
    that of the pull.  ``|B_Z|`` has its eigenvectors and ``max(|λᵢ|, μ)`` for its eigenvalues (saddle-free Newton,
    Dauphin et al. 2014), so that the step leaves saddles.  The curvature ``B`` is learned from secants by Powell's
    symmetric Broyden update, the slope ``T`` of the static controls by Broyden's.  Rows keep joints, center of mass,
    tilt of the base and static controls within their limits.  A limit that does not hold at ``q_r`` is not crossed
    further.

    Attributes:
        B: Curvature of ``H/H₀`` on the constraints, shape (nv, nv).
        T: Slope of the static controls (:class:`StaticControls`), shape (controls, nv).
        gain: Decrease of ``H/H₀`` that the last step predicts, at most that to first order.
        failures: Number of steps that the solver did not find.  They are zero.
    """

    def __init__(self, robot: Robot, edges: Array, controls: int, options: FlowOptions) -> None:
        """Size the buffers.

        Args:
            robot: The robot.
            edges: Normals of the support polygon, shape (k, 2).
            controls: Number of static controls with limits.
            options: Parameters of the flow.
        """
        nv, ranges = robot.nv, JointRanges(robot)
        self._joints = np.flatnonzero(np.isfinite(ranges.lower) & np.isfinite(ranges.upper))
        width = (ranges.upper - ranges.lower)[self._joints]
        self._margin = np.minimum(options.joint_margin, width / 8)
        self._edges, self._mu, self._tilt = edges, options.mu, options.tilt
        self._up = robot.upright
        # The row of the tilt, the tilt and the vertical in the base.
        self._tilting, self._angle, self._vertical = self._joints.size + edges.shape[0], 0.0, np.zeros(3)
        # The pull towards the start acts on joints.  Others lead the base.
        self._pull = np.full(nv, options.rho)
        self._pull[: 6 if robot.floating else 0] = 0.0
        self.B, self.gain, self.failures = np.zeros((nv, nv)), 0.0, 0
        # The sizes never change.  Directions that the constraints take keep columns of zeros.
        self._qp = QP.empty(nv, self._joints.size + edges.shape[0] + (1 if robot.floating else 0) + controls)
        self._solver = DaqpSolver(nv, self._qp.m)
        self._rows, self._room = np.zeros((self._qp.m, nv)), np.zeros((2, self._qp.m))
        self._rows[np.arange(self._joints.size), self._joints] = 1.0
        self.T = self._rows[self._qp.m - controls :]

    def learn(self, z: Array, curvature: Array, slope: Array) -> None:
        """Learn the curvature of ``H/H₀`` and the slope of the static controls along a unit vector, shape (nv,)."""
        missing = curvature - self.B @ z
        missing -= z @ missing / 2 * z
        outer = np.multiply.outer(missing, z)
        self.B += outer
        self.B += outer.T
        self.T += np.multiply.outer(slope - self.T @ z, z)

    def limit(self, state: State, rooms: Array, shares: Array, coasting: Array) -> None:
        """Set the rows for a state at ``ν = 0``, less what the flow needs to brake.

        Args:
            state: The state.
            rooms: Distance of the center of mass to each edge of the polygon, less its margin, m, shape (k,).
            shares: Static controls, shape (controls,).
            coasting: Way on which the present flow brakes, shape (nv,).
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
            self._rows[count, 3:6] = axis / sine if sine > _LEVEL else 0.0
            self._angle, self._vertical[:] = math.atan2(sine, float(vertical @ self._up)), vertical
            upper[count] = self._tilt - self._angle
            count += 1
        upper[count:] = 1.0 - shares
        lower[count:] = -1.0 - shares
        for rows, aim in ((slice(0, self._joints.size), _AIM), (slice(count, None), _RESERVE)):
            upper[rows] -= aim
            lower[rows] += aim
        ahead = self._rows @ coasting
        np.maximum(upper, -_SPENT, out=self._room[0])
        np.minimum(lower, _SPENT, out=self._room[1])
        np.maximum(upper - np.maximum(ahead, 0.0), 0.0, out=upper)
        np.minimum(lower - np.minimum(ahead, 0.0), 0.0, out=lower)

    def newton(self, space: Redundancy, gradient: Array, value: float, offset: Array, error: Array) -> Array:
        """Return the step δ, shape (nv,).

        Args:
            space: The redundancy.
            gradient: ``∇H/H₀``, shape (nv,).
            value: ``H/H₀``.
            offset: ``q_r ⊖ q₀``, shape (nv,).
            error: Error of the constraints, shape (rows,).
        """
        Z, root = space.basis, math.sqrt(max(abs(value), _LEAST))
        slope = Z.T @ (gradient / root + self._pull * offset)
        curvature = Z.T @ (self.B / root) @ Z + (Z.T * self._pull) @ Z
        if space.springs is not None:
            slope -= space.springs.T @ error
            curvature.flat[:: slope.size + 1] += space.stiffness
        values, vectors = np.linalg.eigh(curvature)
        way = Z @ (vectors / np.sqrt(np.maximum(np.abs(values), self._mu)))
        step = self._solve(way, way.T @ (Z @ slope))
        # The flow does not climb for what the pull or the springs win.
        self.gain = min(self.gain * root, -float(gradient @ step))
        return step

    def towards(self, Z: Array, way: Array) -> Array:
        """Return the step nearest to ``way``, shape (nv,), on the constraints and within the limits."""
        return self._solve(Z, -Z.T @ way)

    def downhill(self, Z: Array, gradient: Array, flow: Array, stop: Array, step: Array) -> Array:
        """Return a step of the flow without the part of it by which ``H`` would rise now, or where the flow stops.

        Args:
            Z: Basis of the redundancy, shape (nv, r).
            gradient: ``∇H/H₀``, shape (nv,).
            flow: ``u``, shape (nv,).
            stop: Way on which it stops, shape (nv,).
            step: Change of ``u``, shape (nv,).
        """
        for slope in (gradient + self.B @ stop, gradient):
            uphill = Z @ (Z.T @ slope)
            climb = float(uphill @ (flow + step))
            if climb > 0:
                step = step - uphill * (climb / float(uphill @ uphill))
        return step

    def stops(self, flow: Array, time: float) -> bool:
        """Return whether ``flow``, shape (nv,), stays within the limits for so many seconds."""
        way = flow * time
        ahead = self._rows @ way
        if self._up is not None:
            ahead[self._tilting] = self._tilted(way, float(ahead[self._tilting]))
        return not float(np.maximum(ahead - self._room[0], self._room[1] - ahead).max(initial=0.0)) > _NEAR

    def _tilted(self, way: Array, along: float) -> float:
        """Return how much the tilt changes along a way, shape (nv,), which also turns it aside."""
        turn = float(self._vertical @ way[3:6])
        aside = float(way[3:6] @ way[3:6]) - turn**2 - along**2
        return math.hypot(self._angle + along, math.sqrt(max(aside, 0.0))) - self._angle

    def along(self, Z: Array, flow: Array, time: float, step: Array) -> Array:
        """Return a step of the flow without the part of it by which limits would be crossed, one after the other.

        Args:
            Z: Basis of the redundancy, shape (nv, r).
            flow: ``u``, shape (nv,).
            time: Time for which ``flow + step`` goes on, s.
            step: Change of ``u``, shape (nv,).
        """
        for k, (row, high, low) in enumerate(zip(self._rows, *self._room, strict=True)):
            way = time * (flow + step)
            ahead = float(row @ way)
            if self._up is not None and k == self._tilting:
                ahead = self._tilted(way, ahead)
            if low <= ahead <= high:
                continue
            across = Z @ (Z.T @ row)
            square = float(across @ across)
            if square > _FLAT:
                step = step - across * ((ahead - min(max(ahead, low), high)) / time / square)
        return step

    def _solve(self, way: Array, slope: Array) -> Array:
        """Return ``δ = way·y`` for the least ``½‖y‖² + slope·y``; zero if the solver fails."""
        qp, r = self._qp, way.shape[1]
        qp.A[:, :r] = self._rows @ way
        qp.A[:, r:] = 0.0
        qp.g[:r], qp.g[r:] = slope, 0.0
        # Without what the last step left: a row that was zero then would stay out.
        self._solver.reset()
        solved = self._solver.solve(qp)
        if solved is None:
            self.gain, self.failures = 0.0, self.failures + 1
            return np.zeros(way.shape[0])
        y = solved.z[:r]
        self.gain = -float(slope @ y + y @ y / 2)
        return np.asarray(way @ y)
