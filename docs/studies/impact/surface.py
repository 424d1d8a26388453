"""Measure the velocity jump of a robot that hits a plane in MuJoCo in one posture."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pinocchio as pin

from docs.studies.core import Vector
from impact_posture.dynamics.mjcf import Mjcf, build_mjcf, pose
from impact_posture.dynamics.numeric import Numeric
from impact_posture.impact.friction.coulomb_impact import coulomb_impact
from impact_posture.impact.impact_contact import point_on
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.system.optional_package import import_mujoco

# Number of simulation steps in one time constant of the contact.
_FINE = 50
# Number of time constants after which the study stops waiting for the end of the contact.
_PATIENCE = 40
# Rate at which friction and supports stop a velocity, divided by the rate of the contact.
_GRIP = 10.0
# Friction coefficient that prevents sliding.
_STICKY = 10.0
# Friction coefficient that replaces an infinite coefficient in a prediction.
_STICKS = 1e6
# Number of iterations for Coulomb's law within one step.
_INNER = 20
# Number of steps without a force after which the contact has ended.
_QUIET = 5
# Radius of the ball that touches at the contact point, m.  The value is arbitrary.
_BALL = 0.01
# Initial height of the contact point above the plane, m.  With this height, all postures touch after the same
# fraction of a time step.
_GAP = 1e-6
# Parameters of the stiffest constraint that MuJoCo accepts, independent of the depth.
_SOLIMP = (0.9999, 0.9999, 0.001, 0.5, 2.0)


@dataclass(frozen=True)
class Surface:
    """Surface that the robot hits, and approach speed.

    The contact is the spring and damper of MuJoCo, scaled by the effective mass: ``r'' = −2ζ r'/T − r/T²`` while the
    contact pushes.  The friction of MuJoCo is convex, and lifts a sliding contact off the surface like a rebound.
    So this study implements Coulomb's law unless ``convex`` is true.  A sticking point has the friction of MuJoCo
    with coefficient 10.
    """

    friction: float = 0.0  # Coulomb coefficient; infinite for a contact point that sticks
    speed: float = 1.0  # approach speed v_n, m/s
    damping: float = 2.0  # ζ; 2 gives the restitution e = 0.05, 0.3 gives 0.4, 0.1 gives 0.7
    time: float = 1e-4  # time constant T, s; the contact lasts 1.5 T to 3 T
    convex: bool = False


@dataclass(frozen=True, eq=False)
class Measured:
    """Measurements of one impact."""

    jump: Vector  # velocity jump Δν in the coordinates of Pinocchio, shape (nv,)
    size: float  # norm of the jump, without joints that follow others
    restitution: float  # normal speed after the impact divided by the speed before
    slip: float  # tangential speed of the contact point after the impact, divided by v_n
    impulse: float  # impulse of the surface along n, N s
    loss: float  # kinetic energy lost, J
    duration: float  # time from touch to the last force, s
    feet: float  # largest speed of a support after the impact, divided by v_n


class NoImpact(Exception):
    """The contact did not begin or did not end; the message states the reason."""


class Scene:
    """MuJoCo model of a robot in one posture, with the contact point slightly above the plane.

    Gravity, motors and joint limits are off; armature is on.  Each support is an equality constraint that fixes a
    foot to the world: ``connect`` for a point, ``weld`` for a surface.

    Raises:
        NoImpact: The contact point cannot move along the normal alone.
    """

    def __init__(self, objective: WorstCaseObjective, q: Vector) -> None:
        self._mujoco = import_mujoco()
        self._robot, self._q, self._objective = objective.robot, q, objective
        # Copy the values of the oracle at this posture, because the oracle is reused for other postures.
        oracle = objective.oracle.at(q)
        self._J, self._Js, self._n = (np.array(x) for x in (oracle.J, oracle.Js, oracle.n))
        self._M = Numeric(self._robot.model).at(q).mass_matrix()
        self._mobility = self._J @ oracle.solve(self._J.T)
        self._point, self._feet = oracle.point, oracle.feet
        written = build_mjcf(self._robot.model)
        written.couple_joints(self._robot)
        self._layout = written.layout
        self._model = _with_surface(written, objective, q).compile()
        self._ball_body = int(self._model.geom("ball").bodyid[0])
        self.approach = self._approach()

    def _approach(self) -> Vector:
        """Return ``ν⁻`` per unit approach speed, with ``Jν = −n`` and ``J_sν = 0``.

        A flying robot moves as one body along ``−n``.  Other robots move with the smallest velocity of base and
        joints.
        """
        if self._robot.floating and not self._feet:
            velocity = np.zeros(self._robot.nv)
            velocity[:3] = -pin.Quaternion(np.array(self._q[3:7])).matrix().T @ self._n
            return velocity
        J = np.vstack([self._J, self._Js])
        wanted = np.concatenate([-self._n, np.zeros(len(self._Js))])
        velocity = np.linalg.pinv(J, rcond=1e-9) @ wanted
        if np.abs(J @ velocity - wanted).max() > 1e-6:
            raise NoImpact("cannot move along the normal alone")
        return np.asarray(self._robot.coupling_matrix @ velocity)

    def with_friction(self, friction: float) -> Vector:
        """Return the predicted jump per unit approach speed with friction, without rebound, shape (nv,)."""
        contact = replace(self._objective.contact, friction=min(friction, _STICKS))
        return coulomb_impact(replace(self._objective, contact=contact).oracle, self._q).jump

    def hit(self, surface: Surface) -> Measured:
        """Simulate the impact on the surface until the contact ends.

        Raises:
            NoImpact: The contact does not begin or does not end.
        """
        mujoco, model = self._mujoco, self._model
        self._set(surface)
        data = mujoco.MjData(model)
        before = surface.speed * self.approach
        data.qpos[:], data.qvel[:] = self._layout.qpos(self._q), self._layout.qvel(self._q, before)
        coulomb = 0 < surface.friction < np.inf and not surface.convex
        impulse, touched, last, rubbing = 0.0, 0, 0, np.zeros(3)
        for step in range(1, _PATIENCE * _FINE):
            if coulomb:
                rubbing = self._rub(data, rubbing, surface.friction)
            mujoco.mj_step(model, data)
            pushed = self._normal_force(data)
            impulse += pushed * model.opt.timestep
            if pushed > 0:
                touched, last = touched or step, step
            elif touched and step - last >= _QUIET:
                return self._measure(data, surface.speed, before, impulse, (last - touched + 1) * model.opt.timestep)
        raise NoImpact(f"in contact for longer than {_PATIENCE} T" if touched else "does not touch")

    def _normal_force(self, data: Any) -> float:
        force, total = np.zeros(6), 0.0
        for k in range(data.ncon):
            self._mujoco.mj_contactForce(self._model, data, k, force)
            total += float(force[0])
        return total

    def _rub(self, data: Any, rubbing: Vector, friction: float) -> Vector:
        """Apply Coulomb friction for the next step, at most ``μ f_n`` against the sliding, and return its force.

        Iterate ``f ← P(f − r v)``, where P projects onto the disc of radius ``μ f_n`` and v is the sliding velocity
        at the end of the step.  At rest, f keeps the point in place.  In motion, f points against v.  While f
        changes, the spring and damper of the contact keep the normal acceleration constant.
        """
        self._mujoco.mj_forward(self._model, data)
        step, center, n = self._model.opt.timestep, data.geom("ball").xpos, self._n
        J = np.zeros((3, self._model.nv))
        self._mujoco.mj_jac(self._model, data, J, None, center - _BALL * n, self._ball_body)
        sliding, pushed = J @ (data.qvel + step * data.qacc), self._normal_force(data)
        sliding -= (n @ sliding) * n
        across = self._mobility @ n
        along = (self._mobility - np.outer(across, across) / (n @ across)) * step
        rate, rubbed = 1 / float(np.linalg.eigvalsh(along)[-1]), rubbing
        for _ in range(_INNER):
            change = rubbed - rubbing
            wanted = rubbed - rate * (sliding + along @ change)
            size, most = float(np.linalg.norm(wanted)), friction * (pushed - across @ change / (n @ across))
            rubbed = wanted * (min(1.0, max(most, 0.0) / size) if size > 0 else 0.0)
        data.qfrc_applied[:] = J.T @ rubbed
        return np.asarray(rubbed)

    def _set(self, surface: Surface) -> None:
        model, T = self._model, surface.time
        model.opt.timestep = T / _FINE
        # MuJoCo reads negative numbers as stiffness and damping, not as a time constant and a damping ratio.
        model.pair_solref[:] = -1 / T**2, -2 * surface.damping / T
        model.pair_solreffriction[:] = -1 / T**2, -_GRIP / T
        model.eq_solref[:] = -((_GRIP / 2 / T) ** 2), -_GRIP / T
        model.pair_dim[:] = 3 if np.isinf(surface.friction) or surface.convex else 1
        model.pair_friction[:, :2] = min(surface.friction, _STICKY)

    def _measure(self, data: Any, speed: float, before: Vector, impulse: float, duration: float) -> Measured:
        after = self._layout.state(data.qpos, data.qvel)[1]
        numeric = Numeric(self._robot.model).at(self._layout.q(data.qpos))
        moved = numeric.jacobian(self._point)[:3] @ after
        normal = float(self._n @ moved)
        feet = [np.abs(numeric.jacobian(foot.point)[: foot.rows] @ after).max() for foot in self._feet]
        return Measured(
            jump=after - before,
            size=float(np.linalg.norm((after - before)[~self._robot.followers])),
            restitution=normal / speed,
            slip=float(np.linalg.norm(moved - normal * self._n)) / speed,
            impulse=impulse,
            loss=float(before @ self._M @ before - after @ numeric.mass_matrix() @ after) / 2,
            duration=duration,
            feet=float(max(feet, default=0.0)) / speed,
        )


def _with_surface(written: Mjcf, objective: WorstCaseObjective, q: Vector) -> Mjcf:
    """Add, at ``q``, a ball at the contact point, a plane below the ball, and a constraint for each support."""
    robot, oracle = objective.robot, objective.oracle.at(q)
    numeric, n = Numeric(robot.model).at(q), oracle.n.copy()
    mujoco, spec = import_mujoco(), written.spec
    option = spec.option
    option.gravity, option.integrator = np.zeros(3), mujoco.mjtIntegrator.mjINT_EULER
    option.cone, option.solver = mujoco.mjtCone.mjCONE_ELLIPTIC, mujoco.mjtSolver.mjSOL_NEWTON
    option.tolerance, option.iterations = 0.0, 200
    option.ls_tolerance, option.ls_iterations = 1e-6, 100
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT

    contact = point_on(robot, objective.contact.frame, objective.contact.offset)
    position = numeric.placement(contact).translation
    # The lowest point of the ball is the contact point.
    center = numeric.data.oMi[contact.joint].actInv(position + _BALL * n)
    written.add_geom(contact.joint, "ball", "sphere", (_BALL,), pin.SE3(np.eye(3), center))
    written.add_plane("surface", position - _GAP * n, n)
    spec.add_pair(geomname1="surface", geomname2="ball", solimp=_SOLIMP, condim=1)

    for k, support in enumerate(objective.supports):
        foot = point_on(robot, support.frame, support.offset)
        written.body(foot.joint).add_site(name=f"tie_{k}", **pose(pin.SE3(foot.rotation, foot.position)))
        spec.worldbody.add_site(name=f"ground_{k}", **pose(numeric.placement(foot)))
        kind = mujoco.mjtEq.mjEQ_CONNECT if support.kind == "point" else mujoco.mjtEq.mjEQ_WELD
        spec.add_equality(
            type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, name1=f"tie_{k}", name2=f"ground_{k}", solimp=_SOLIMP
        )
    return written
