"""A small simulation of one impact, independent of the predictions: forward dynamics, springs and Coulomb friction.

The robot is at rest, and its motors hold it against gravity.  A surface then moves along its normal n into the
contact point at the approach speed.  A spring of stiffness k along n pushes the point, and friction acts across n.
Motor torques and thrusts stay constant.  Posture and velocities follow ``M(q) ν̇ + h(q, ν) = τ + Jᵀf``.  The
simulation ends at the greatest compression: surface and point then have the same normal velocity.  The robot was at
rest, so its velocity is the velocity jump of a plastic impact.

The ground only pushes the feet, with exact friction, by damped springs that are much stiffer than the surface.  At
rest, equal springs under all points of the feet carry the weight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
import scipy.optimize

from docs.studies.core import Vector
from docs.studies.verdict.coulomb_step import CoulombStep

# Number of time steps in the shortest possible compression time.
_STEPS = 150
# Longest time step, s.
_LONGEST = 5e-5
# The simulation ends without a result after this multiple of the shortest possible compression time.
_PATIENCE = 60
# Stiffness of the ground divided by the stiffness of the surface.
_STIFFER = 1e3
# Time constant of the damping of the ground, in time steps.
_DAMPED = 2.0
# A robot stands if springs under its feet balance all but this share of its weight.
_STANDS = 1e-3


@dataclass(frozen=True, eq=False)
class Point:
    """A point on a link: index of the joint, and position in the axes of the joint, m, shape (3,)."""

    joint: int
    position: Vector


@dataclass(frozen=True, eq=False)
class Surface:
    """The surface that hits the robot.

    Attributes:
        normal: Unit normal towards the robot, world axes, shape (3,).
        speed: Speed along the normal, m/s.
        stiffness: Stiffness of the spring between surface and robot, N/m^power.
        friction: Coulomb coefficient of the surface and of the ground.
        power: Exponent of the spring force, ``stiffness · depth^power``; 1 if the robot has feet.
    """

    normal: Vector
    speed: float
    stiffness: float
    friction: float
    power: float = 1.0


@dataclass(frozen=True, eq=False)
class SimulatedImpact:
    """Result of a simulated impact, up to the greatest compression.

    Attributes:
        jump: Velocity jump Δν, shape (nv,).
        impulse: Impulse of the surface on the robot, world axes, N·s, shape (3,).
        force: Normal force at the greatest compression, which is the largest one, N.
        slip: Speed of the contact point across the normal, m/s.
        time: Time from touch to the greatest compression, s.
        feet: Largest speed of each point of the feet during the contact, m/s, shape (feet,).
        up: Upward velocity of each point of the feet at the end, m/s, shape (feet,).
        unsolved: Number of time steps whose conditions were not fulfilled.
        q: Posture, shape (nq,).
        work: Work of the surface, J.
        stored: Energy of the spring between surface and robot, J.
        lost: Energy that the friction of the surface dissipated, J.
    """

    jump: Vector
    impulse: Vector
    force: float
    slip: float
    time: float
    feet: Vector
    up: Vector
    unsolved: int
    q: Vector
    work: float
    stored: float
    lost: float


class ImpactSimulation:
    """Simulates impacts of one robot in one posture.

    Attributes:
        held: Whether the feet cannot move, as if they were glued to the ground.
        still: Whether mass matrix and Jacobians stay as in the first posture.
        carried: Vertical forces that carry the weight at rest, N, shape (feet,).
        stands: Whether the forces ``carried`` balance the weight.
    """

    def __init__(
        self,
        model: pin.Model,
        q: Vector,
        hit: Point,
        feet: Sequence[Point] = (),
        *,
        held: bool = False,
        still: bool = False,
    ) -> None:
        self.model, self.q, self.points = model, q, (hit, *feet)
        self.held, self.still = held and bool(feet), still
        self._data = model.createData()
        self._weight = np.array(pin.computeGeneralizedGravity(model, self._data, q))
        self._torques = self._weight.copy()
        self.carried, self.stands = np.zeros(len(feet)), True
        if feet and not held:
            upward = self._dynamics(q)[1][5::3].T
            # No motor moves the base.
            base = 6 if model.joints[1].shortname() == "JointModelFreeFlyer" else 0
            self.carried, self.stands = _carried(upward[:base], self._weight[:base])
            self._torques = self._weight - upward @ self.carried
            self._torques[:base] = 0.0

    def run(self, surface: Surface) -> SimulatedImpact:
        """Simulate the impact of a surface."""
        n = surface.normal
        axes = np.vstack([np.linalg.svd(n[None, :])[2][1:], n])
        count = 1 if self.held else len(self.points)
        k = np.full(count, _STIFFER * surface.stiffness)
        friction, moving = np.full(count, surface.friction), np.zeros(3 * count)
        moving[2] = surface.speed
        q, v, p, depth = self.q, np.zeros(self.model.nv), np.zeros(3 * count), np.zeros(count)
        depth[1:] = self.carried[: count - 1] / k[1:]
        impulse, work, lost, unsolved, time = np.zeros(3), 0.0, 0.0, 0, 0.0
        fastest = np.zeros(count - 1)
        M, J, feet = self._contacts(q, axes, count)
        X = _respond(M, feet, J.T)
        power = surface.power
        deepest = (surface.speed**2 * (power + 1) / 2 / (surface.stiffness * (J[2] @ X[:, 2]))) ** (1 / (power + 1))
        dt = min(_LONGEST, np.pi / 2 * float(deepest) / surface.speed / _STEPS)
        # The ground force follows the depth at the end of the step and damping; the surface force follows the mean
        # depth.
        s = 1 / ((1 + _DAMPED) * dt**2 * k)
        for step in range(_PATIENCE * _STEPS):
            if step and not self.still:
                M, J, feet = self._contacts(q, axes, count)
                X = _respond(M, feet, J.T)
            h = self._weight if self.still else pin.nonLinearEffects(self.model, self._data, q, v)
            free = v + dt * _respond(M, feet, self._torques - h)
            before = J @ v - moving
            k[0] = surface.stiffness * (depth[0] - before[2] * dt / 2) ** (power - 1)
            s[0] = 4 / (dt**2 * k[0])
            d = dt * k * s * depth
            d[0] = 4 / dt * depth[0] - before[2]
            p, solved = CoulombStep(J @ X, J @ free - moving, s, d, friction).solve(p)
            unsolved += not solved
            after = J @ (free + X @ p) - moving
            # The last step ends when the normal velocity of the surface relative to the point is zero.
            share = 1.0 if after[2] < 0 else float(before[2] / (before[2] - after[2]))
            end = before + share * (after - before)
            impulse += share * p[:3]
            work += share * surface.speed * float(p[2])
            lost -= share * float(p[:2] @ (before + end)[:2]) / 2
            depth[0] -= share * dt * (before[2] + end[2]) / 2
            depth[1:] -= share * dt * after[5::3]
            last, v = v, v + share * (free + X @ p - v)
            q = q if self.still else pin.integrate(self.model, q, share * dt * (last + v) / 2)
            time += share * dt
            fastest = np.maximum(fastest, np.linalg.norm(end[3:].reshape(-1, 3), axis=1))
            if after[2] >= 0:
                break
        else:
            raise RuntimeError("the contact does not reach its greatest compression")
        return SimulatedImpact(
            jump=v,
            impulse=axes.T @ impulse,
            force=float(surface.stiffness * depth[0] ** power),
            slip=float(np.linalg.norm(end[:2])),
            time=time,
            feet=fastest,
            up=end[5::3],
            unsolved=unsolved,
            q=q,
            work=work,
            stored=float(surface.stiffness * depth[0] ** (power + 1) / (power + 1)),
            lost=lost,
        )

    def _contacts(self, q: Vector, axes: Vector, count: int) -> tuple[Vector, Vector, Vector | None]:
        """Return M, the Jacobian of the contacts in their axes, and the Jacobian of feet that are held."""
        M, J = self._dynamics(q)
        J[:3] = axes @ J[:3]
        return M, J[: 3 * count], J[3:] if self.held else None

    def _dynamics(self, q: Vector) -> tuple[Vector, Vector]:
        """Return the mass matrix, and the linear Jacobian of all points in world axes."""
        M = np.array(pin.crba(self.model, self._data, q))
        pin.computeJointJacobians(self.model, self._data, q)
        placed = [(point.joint, pin.SE3(np.eye(3), point.position)) for point in self.points]
        world = pin.LOCAL_WORLD_ALIGNED
        J = [pin.getFrameJacobian(self.model, self._data, *point, world)[:3] for point in placed]
        return np.triu(M) + np.triu(M, 1).T, np.vstack(J)


def _respond(M: Vector, feet: Vector | None, tau: Vector) -> Vector:
    """Return ``M⁻¹τ``, without the motion of feet that are held."""
    a = np.linalg.solve(M, tau)
    if feet is None:
        return a
    Y = np.linalg.solve(M, feet.T)
    return a - Y @ (np.linalg.pinv(feet @ Y, rcond=1e-9, hermitian=True) @ (feet @ a))


def _carried(upward: Vector, weight: Vector) -> tuple[Vector, bool]:
    """Return the forces of equal springs under a rigid robot, and whether they balance its weight.

    The forces of equal springs have the least sum of squares.  Springs only push, so the force at a point can be
    zero.
    """
    if not len(weight):
        return np.zeros(upward.shape[1]), True
    forces = np.linalg.lstsq(upward, weight, rcond=1e-9)[0]
    if forces.min() < 0:
        # A small weight on the forces selects the solution with the least sum of squares.
        least = 1e-5 * np.eye(upward.shape[1])
        forces = scipy.optimize.nnls(np.vstack([upward, least]), np.append(weight, np.zeros(len(least))))[0]
    return forces, bool(np.linalg.norm(upward @ forces - weight) <= _STANDS * np.linalg.norm(weight))
