"""Actuation by rotors and motors: allocation, hover, and lateral force.

The velocity is ``ν = [base linear, base angular, joint rates]`` with the base twist in the base frame.  The equation
of motion of an aerial robot with an arm is ``M(q) ν̇ + h(q, ν) = G u`` with ``u = [rotor thrusts (N), joint torques
(N·m)]``.  ``G`` is constant, because ``ν`` has the base twist in the base frame.  The rotor columns of ``G`` are
wrenches on the base, in the base frame about its origin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from impact_posture.errors import FrameNotFound, PostureError, SpecError
from impact_posture.robot.model_joints import effort_unit, finite_armature, is_free_flyer, joint_range
from impact_posture.robot.robot_spec import PropulsionSpec
from impact_posture.system.arrays import Array

_RESIDUAL = 1e-6
"""Largest unbalanced force or moment on the base (N, N·m) that is treated as equilibrium."""


@dataclass(frozen=True)
class Allocation:
    """Map from rotor thrusts to the wrench on the base."""

    matrix: Array
    """Base wrench ``[force (N); moment (N·m)]`` per unit thrust (N), in the base frame, shape (6, rotors)."""
    rank: int
    """Rank of the matrix; 6 for a fully actuated robot."""
    condition: float
    """Condition number of the matrix, whose units N and N·m are mixed; infinite if the rank is below 6."""


@dataclass(frozen=True)
class Hover:
    """Static equilibrium ``h(q, 0) = G u`` at one posture."""

    thrusts: Array
    """Rotor thrusts, N."""
    speeds: Array
    """Rotor speeds in the unit of ``speed_max``; zero for a negative thrust."""
    joint_torques: Array
    """Torques of all joints behind the base, N·m (N for a prismatic joint)."""
    thrust_margin: float
    """Smallest distance of a thrust from a limit, divided by the thrust range; negative outside the limits."""
    torque_margin: float
    """Smallest ``1 - |τ|/τ_max`` of all joints; 1 without joints."""
    residual: float
    """Largest entry of the base wrench (N, N·m) that the rotors do not balance."""
    violations: tuple[str, ...]
    """Reasons why the robot cannot hover in this posture; empty if it can."""

    @property
    def feasible(self) -> bool:
        """Whether the robot can hover in this posture."""
        return not self.violations


@dataclass(frozen=True)
class LateralForce:
    """Largest net horizontal force in each of four directions, without tilt, N; NaN if the robot cannot hover.

    The force acts through the center of mass, and the arm does not move.  Forward and left are the x and y axes of
    the base, projected on the horizontal plane.
    """

    forward: float
    backward: float
    left: float
    right: float


def thrust_limits(propulsion: PropulsionSpec) -> tuple[float, float]:
    """Return the smallest and the largest thrust of a rotor, ``c_f ω²`` at the speed limits, N."""
    if propulsion.speed_min >= propulsion.speed_max:
        fault = f"speed_min {propulsion.speed_min:g} is not below speed_max {propulsion.speed_max:g}"
        raise SpecError(fault, where="propulsion", hint="correct the rotor speed limits")
    c = propulsion.thrust_coefficient
    return c * propulsion.speed_min**2, c * propulsion.speed_max**2


def torque_limits(model: pin.Model) -> Array:
    """Return the largest torque of each velocity entry, N·m or N, shape (nv,).

    The torque is infinite for a floating base and for a locked joint (infinite armature).  The torque is also
    infinite for a joint whose limit is zero, because zero means that the file states no limit.
    """
    limits = np.array(model.effortLimit, dtype=float)
    unknown = ~(np.isfinite(limits) & (limits > 0)) | finite_armature(model)[1]
    unknown[: 6 if is_free_flyer(model) else 0] = True
    return np.where(unknown, np.inf, limits)


def allocation_matrix(model: pin.Model, propulsion: PropulsionSpec) -> Array:
    """Return the map from rotor thrusts (N) to the base wrench ``[force; moment]``, shape (6, rotors).

    In the propulsion frame, the wrench per unit thrust of a rotor is ``[d; p × d - s κ d]``, with position ``p``,
    unit thrust direction ``d``, spin ``s`` and drag ratio ``κ``.  The returned wrenches are in the axes of the base
    frame (the root joint), about the origin of this frame.  The model must be free-flying, with the propulsion frame
    on the base body.
    """
    if not is_free_flyer(model):
        raise SpecError("has rotors, but the base is fixed", where="propulsion", hint='set root = "free-flyer"')
    if not model.existFrame(propulsion.frame):
        raise FrameNotFound(propulsion.frame, (f.name for f in model.frames), where="propulsion.frame")
    frame = model.frames[model.getFrameId(propulsion.frame)]
    if frame.parentJoint != 1:
        fault = f"frame '{propulsion.frame}' is not on the base body"
        raise SpecError(fault, where="propulsion.frame", hint="name a frame that is fixed to the floating base")
    if not propulsion.rotors:
        raise SpecError("has no rotors", where="propulsion.rotors", hint="list the rotors, or leave propulsion out")
    columns = []
    for rotor in propulsion.rotors:
        direction = np.asarray(rotor.direction, dtype=float)
        length = float(np.linalg.norm(direction))
        if not np.isfinite(length) or abs(length - 1.0) > 1e-3:
            fault = f"direction of length {length:.4g}"
            raise SpecError(fault, where=f"propulsion.rotors '{rotor.name}'", hint="give a unit vector")
        force = direction / length
        moment = np.cross(rotor.position, force) - rotor.spin * propulsion.drag_ratio * force
        columns.append(frame.placement.act(pin.Force(force, moment)).vector)
    return np.column_stack(columns)


def allocation(model: pin.Model, propulsion: PropulsionSpec) -> Allocation:
    """Return the allocation matrix with its rank and condition number."""
    matrix = allocation_matrix(model, propulsion)
    values = np.linalg.svd(matrix, compute_uv=False)
    rank = int(np.count_nonzero(values > 1e-9 * values[0]))
    condition = float(values[0] / values[-1]) if rank == 6 else float("inf")
    return Allocation(matrix, rank, condition)


def actuation_matrix(model: pin.Model, propulsion: PropulsionSpec | None = None) -> Array:
    """Return the constant ``G`` of ``M ν̇ + h = G u``, ``u = [thrusts (N); joint torques (N·m)]``.

    The shape is (nv, rotors + joints), with joints in the order of ``ν``.  Without ``propulsion``, the base of a
    free-flying robot is not actuated.  A fixed-base robot has ``G = I``.
    """
    base = 6 if is_free_flyer(model) else 0
    rotors = np.zeros((base, 0)) if propulsion is None else allocation_matrix(model, propulsion)
    joints = model.nv - base
    matrix = np.zeros((model.nv, rotors.shape[1] + joints))
    matrix[:base, : rotors.shape[1]] = rotors
    matrix[base:, rotors.shape[1] :] = np.eye(joints)
    return matrix


def hover(model: pin.Model, propulsion: PropulsionSpec, q: ArrayLike) -> Hover:
    """Return the thrusts and torques that hold posture ``q`` at rest: ``h(q, 0) = G u``.

    The six base rows of the equation determine the thrusts.  With more than six rotors, the thrusts farthest from
    their limits are chosen.  If the rotors cannot balance the weight, the thrusts within their limits with the
    smallest residual are chosen.  The joint rows determine the torques, which must be within the effort limits.
    """
    matrix = allocation_matrix(model, propulsion)
    low, high = thrust_limits(propulsion)
    q = _configuration(model, q)
    load = np.asarray(pin.computeGeneralizedGravity(model, model.createData(), q))
    thrusts = _centred_thrusts(matrix, load[:6], low, high)
    residual = float(np.max(np.abs(matrix @ thrusts - load[:6])))
    torques = load[6:].copy()
    limits = torque_limits(model)[6:]
    width = high - low
    thrust_margin = float(np.min(np.minimum(thrusts - low, high - thrusts)) / width)
    used = np.abs(torques) / limits
    joints = [(model.names[i], effort_unit(model, i)) for i in joint_range(model) for _ in range(model.nvs[i])]
    violations = []
    if residual > _RESIDUAL:
        violations.append(f"the rotors leave {residual:.3g} (N or N·m) of the weight unbalanced")
    for rotor, thrust in zip(propulsion.rotors, thrusts, strict=True):
        if not low - 1e-9 * width <= thrust <= high + 1e-9 * width:
            violations.append(f"{rotor.name} would need {thrust:.3g} N, outside {low:.3g} to {high:.3g} N")
    for (name, unit), torque, limit in zip(joints, torques, limits, strict=True):
        if abs(torque) > limit:
            violations.append(f"{name} would need {torque:.3g} {unit}, above its limit {limit:.3g} {unit}")
    speeds = np.sqrt(np.maximum(thrusts, 0.0) / propulsion.thrust_coefficient)
    torque_margin = float(1.0 - np.max(used, initial=0.0))
    return Hover(thrusts, speeds, torques, thrust_margin, torque_margin, residual, tuple(violations))


def lateral_force_range(model: pin.Model, propulsion: PropulsionSpec, q: ArrayLike) -> LateralForce:
    """Return the largest net horizontal force that keeps attitude and height, in each of four directions.

    For each direction, a linear program maximizes ``F = m a`` over thrusts ``f`` and acceleration ``a >= 0``.  The
    generalized velocity ``e`` translates the whole robot in this direction.  The constraint ``A f = h_b + M_b e a``
    (base rows) balances the weight without rotation.  The other constraints are the thrust limits and the torque
    limits ``|h_j + M_j e a| <= τ_max`` (joint rows).
    """
    matrix = allocation_matrix(model, propulsion)
    low, high = thrust_limits(propulsion)
    q = _configuration(model, q)
    data = model.createData()
    load = np.asarray(pin.computeGeneralizedGravity(model, data, q))
    mass_matrix = np.asarray(pin.crba(model, data, q, pin.Convention.WORLD))
    rotation = pin.Quaternion(np.asarray(q[3:7])).toRotationMatrix()
    mass = float(pin.computeTotalMass(model))
    forward = rotation[:, 0] * np.array([1.0, 1.0, 0.0])
    if np.linalg.norm(forward) < 1e-6:
        raise PostureError("the base's x axis is vertical", where="lateral force", hint="give a level posture")
    forward /= np.linalg.norm(forward)
    left = np.array([-forward[1], forward[0], 0.0])
    limits = torque_limits(model)[6:]

    def largest(direction: Array) -> float:
        push = mass_matrix[:, :3] @ (rotation.T @ direction)
        count = matrix.shape[1]
        held = np.isfinite(limits)
        zeros = np.zeros((int(held.sum()), count))
        solution = _maximize_last(
            np.column_stack([matrix, -push[:6]]),
            load[:6],
            np.block([[zeros, push[6:][held, None]], [zeros, -push[6:][held, None]]]),
            np.r_[(limits - load[6:])[held], (limits + load[6:])[held]],
            [(low, high)] * count + [(0.0, None)],
        )
        return float("nan") if solution is None else max(0.0, mass * float(solution[-1]))  # no -0

    return LateralForce(largest(forward), largest(-forward), largest(left), largest(-left))


def _centred_thrusts(matrix: Array, wrench: Array, low: float, high: float) -> Array:
    """Solve ``A f = w`` for the thrusts farthest from their limits; if impossible, by bounded least squares."""
    count = matrix.shape[1]
    if count == 6 and np.linalg.matrix_rank(matrix) == 6:
        return np.asarray(np.linalg.solve(matrix, wrench))
    # Maximize s over f and s with low + s (high - low) <= f <= high - s (high - low).
    width = np.full((count, 1), high - low)
    solution = _maximize_last(
        np.column_stack([matrix, np.zeros(6)]),
        wrench,
        np.block([[-np.eye(count), width], [np.eye(count), width]]),
        np.r_[np.full(count, -low), np.full(count, high)],
        [(None, None)] * (count + 1),
    )
    if solution is not None:
        return solution[:-1]
    from scipy.optimize import lsq_linear

    return np.asarray(lsq_linear(matrix, wrench, bounds=(low, high)).x)


def _maximize_last(
    A: Array, b: Array, A_upper: Array, b_upper: Array, bounds: list[tuple[float | None, float | None]]
) -> Array | None:
    """Return the ``x`` with the largest last entry subject to ``A x = b``, ``A_upper x ≤ b_upper`` and the bounds."""
    # SciPy is slow to import, and online controllers do not need this function.
    from scipy.optimize import linprog

    cost = np.r_[np.zeros(A.shape[1] - 1), -1.0]
    result = linprog(cost, A_ub=A_upper, b_ub=b_upper, A_eq=A, b_eq=b, bounds=bounds, method="highs")
    return np.asarray(result.x) if result.status == 0 else None


def _configuration(model: pin.Model, q: ArrayLike) -> Array:
    values = np.asarray(q, dtype=float)
    if values.shape != (model.nq,):
        raise PostureError(f"{values.size} numbers where the model has nq = {model.nq}", where="posture")
    if not np.all(np.isfinite(values)):
        raise PostureError("a value is not finite", where="posture", hint="correct it")
    return values
