"""MuJoCo model of an arm with elastic joints.  Springs connect links and rotors, and the contact is a spring."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from docs.studies.core import Vector
from impact_posture.dynamics.mjcf import build_mjcf, pose
from impact_posture.impact.elasticity.elastic_impact import ElasticImpact
from impact_posture.system.optional_package import import_mujoco

# Mass (kg) and moments of inertia (kg m²) of the body of a rotor.  These values are negligible, because the armature
# of the rotor joint contains the inertia of the rotor.
_TINY = 1e-9
# Number of simulation steps from touch to greatest compression.
STEPS = 4000


@dataclass(frozen=True, eq=False)
class Measured:
    """Measurements of one compression."""

    duration: float  # time from touch to greatest compression, s
    force: float  # largest force, N
    jump: Vector  # change of the links' velocity from touch to the end, shape (nv,)
    peak: float  # largest norm of the links' velocity change during the compression
    torque: Vector  # largest torque of each spring, N m, shape (nv,)


class ElasticWorld:
    """Arm on a fixed base.  Each joint turns about one axis.

    Each joint has a rotor, whose body has the same parent as the link of the joint, and turns about the same axis.  A
    fixed tendon acts as spring and damper between rotor and link.  The rotor has inertia only about its axis, like an
    armature.  Gravity and
    joint limits are off.  The contact pushes with ``f = kδ`` along the normal at the contact point.  Depth and
    direction of the contact are updated while the arm moves.
    """

    def __init__(self, impact: ElasticImpact) -> None:
        self._mujoco, oracle = import_mujoco(), impact.oracle
        robot, self._impact = oracle.robot, impact
        written = build_mjcf(robot.model)
        self._joints = [written.joints[robot.joint_id(name)][0] for name in robot.joint_names]
        self._rotors = {}
        for k, inertia in zip(impact.joints, impact.rotors, strict=True):
            name, index = self._joints[k], robot.joint_id(robot.joint_names[k])
            link = written.spec.joint(name)
            rotor = written.body(int(robot.model.parents[index])).add_body(
                name=f"{name} rotor", mass=_TINY, inertia=[_TINY] * 3, explicitinertial=True,
                **pose(robot.model.jointPlacements[index]),
            )  # fmt: skip
            self._rotors[k] = f"{name} rotor"
            rotor.add_joint(name=self._rotors[k], type=link.type, axis=link.axis, armature=inertia)
            spring = written.spec.add_tendon(name=f"{name} spring")
            spring.wrap_joint(name, 1.0)
            spring.wrap_joint(self._rotors[k], -1.0)
        self._model = written.compile()
        flags = self._mujoco.mjtDisableBit
        self._model.opt.disableflags |= int(flags.mjDSBL_CONSTRAINT) | int(flags.mjDSBL_GRAVITY)
        self._model.tendon_stiffness[:], self._model.tendon_lengthspring[:] = impact.kappa, 0.0
        self._model.tendon_damping[:] = impact.d
        self._body = self._model.body(written.bodies[oracle.point.joint]).id
        self._point = oracle.point.position

    def compress(self, q: Vector, stiffness: float, speed: float, duration: float) -> Measured:
        """Approach with the smallest joint velocity that gives ``speed`` along the normal, and compress until δ̇ = 0.

        Rotors begin at the velocity of their links.

        Args:
            q: Configuration, shape (nq,).
            stiffness: Stiffness of the contact, N/m.
            speed: Approach speed, m/s.
            duration: Expected duration of the compression, s, which determines the time step.
        """
        mujoco, model, data = self._mujoco, self._model, self._mujoco.MjData(self._model)
        oracle = self._impact.oracle.at(q)
        n, j = oracle.n, oracle.n @ oracle.J
        before = -speed * j / (j @ j)
        links = np.array([model.joint(name).dofadr[0] for name in self._joints])
        for k, name in enumerate(self._joints):
            for joint in (name, self._rotors.get(k)):
                if joint is not None:
                    data.qpos[model.joint(joint).qposadr[0]] = q[k]
                    data.qvel[model.joint(joint).dofadr[0]] = before[k]
        model.opt.timestep = duration / STEPS
        J, norms, force, torques, start = np.zeros((3, model.nv)), [0.0], 0.0, np.zeros(model.ntendon), None
        for _ in range(4 * STEPS):
            mujoco.mj_step1(model, data)
            point = data.xpos[self._body] + data.xmat[self._body].reshape(3, 3) @ self._point
            mujoco.mj_jac(model, data, J, None, point, self._body)
            start = point if start is None else start
            f = stiffness * max(0.0, float(n @ (start - point)))
            if n @ J @ data.qvel >= 0:
                break
            torque = self._impact.kappa * data.ten_length + self._impact.d * data.ten_velocity
            force, torques = max(force, f), np.maximum(torques, np.abs(torque))
            data.qfrc_applied[:] = f * (n @ J)
            mujoco.mj_step2(model, data)
            norms.append(float(np.linalg.norm(data.qvel[links] - before)))
        peak = np.zeros(len(before))
        peak[self._impact.joints] = torques
        return Measured(float(data.time), force, data.qvel[links] - before, max(norms), peak)
