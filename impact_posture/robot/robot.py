"""Class Robot: a ``pin.Model`` with names, postures, and the data of ``robot.toml``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.config.checked import checked
from impact_posture.config.problem_settings import ContactPose, JointModel, RobotSettings, Root
from impact_posture.errors import (
    FrameNotFound,
    JointLocked,
    JointNotFound,
    NotWithinLimits,
    PostureError,
    PostureNotFound,
)
from impact_posture.robot.joint_coupling import JointCoupling, coupled, coupled_entries, with_partners
from impact_posture.robot.model_hash import dynamics_hash, hash_of, kinematics_hash, rounded
from impact_posture.robot.model_joints import (
    ENDLESS,
    JOINT_ENTRIES,
    immovable_joints,
    joint_family,
    joint_range,
    q_slice,
    v_slice,
)
from impact_posture.robot.robot_spec import RobotSpec
from impact_posture.system.arrays import Array

CONVENTION = (
    "q = [x, y, z, qx, qy, qz, qw, joints]; v = [base linear, base angular, joint rates], base twist in the base "
    "frame (Pinocchio LOCAL); SI units, radians"
)
FIXED_CONVENTION = "q = [joints]; v = [joint rates]; SI units, radians"

# A joint that exceeds a position limit by less than this value (rad, m) is treated as if it were at the limit.
_ON_LIMIT = 1e-6
# In a posture, the position of a follower may differ by this value (rad, m) from the position that its leader
# requires.  For example, the numbers of the posture may be rounded.
_COUPLED = 1e-3


@dataclass(frozen=True)
class RobotFiles:
    """Files from which a robot was loaded.

    Attributes:
        urdf: The URDF or MJCF; for a xacro file, the URDF in the cache.
        srdf: The SRDF; ``None`` without an SRDF.
        folders: Folders in which ``package://`` paths are searched.
    """

    urdf: Path
    srdf: Path | None
    folders: tuple[Path, ...]


@dataclass(frozen=True, eq=False)
class CompiledMjcf:
    """The MJCF from which a robot was loaded.

    Attributes:
        model: The ``mujoco.MjModel`` with all joints; treat it as read-only.
        joints: The ``pin.Model`` with all joints, in the order of ``model``.
        start: Default posture of all joints, shape (nq,); joints that the robot locks keep these positions.
    """

    model: Any
    joints: pin.Model
    start: Array

    @cached_property
    def passive(self) -> tuple[Array, ...]:
        """Arrays of the model that determine damping, friction loss and springs of the joints."""
        m = self.model
        springs = m.jnt_stiffness, m.jnt_stiffnesspoly, m.qpos_spring
        return tuple(map(np.array, (m.dof_damping, m.dof_dampingpoly, m.dof_frictionloss, *springs)))


@dataclass(frozen=True, eq=False)
class Robot:
    """A loaded robot.

    Attributes:
        name: Name in outputs.
        source: Path or ``example-robot-data:`` URI of the URDF or MJCF.
        model: Model with the final armature, limits and locked joints; treat it as read-only.
        root: ``free-flyer`` or ``fixed``.
        postures: Named configurations, shape (nq,).
        default_posture: Name of the posture to start from.
        spec: The resolved ``robot.toml``.
        locked: Names of the locked joints.
        armature_source: Description of the source of the armature.
        warnings: Warnings about this model, one line each.
        joint_model: Model of the inertia at the joints (:func:`~impact_posture.robot.joint_model.with_joint_model`).
        stated_armature: Original armature, shape (nv,), if ``joint_model`` has changed ``model.armature``.
        couplings: Couplings of joints.  In each coupling, a follower moves with its leader.
        settings: Settings of :func:`~impact_posture.robot.robot_loader.load_robot`; ``None`` for a robot that was
            built otherwise.
        files: Files from which the robot was loaded; ``None`` for a robot that was built otherwise.
        mjcf: The compiled MJCF; ``None`` for a URDF.
    """

    name: str
    source: str
    model: pin.Model
    root: Root
    postures: Mapping[str, Array]
    default_posture: str
    spec: RobotSpec
    locked: tuple[str, ...] = ()
    armature_source: str = "none"
    warnings: tuple[str, ...] = ()
    joint_model: JointModel = "reflected"
    stated_armature: Array | None = None
    couplings: tuple[JointCoupling, ...] = ()
    settings: RobotSettings | None = None
    files: RobotFiles | None = None
    mjcf: CompiledMjcf | None = None

    def __repr__(self) -> str:
        return f"Robot({self.name!r}, root={self.root!r}, nq={self.nq}, nv={self.nv}, source={self.source!r})"

    @property
    def nq(self) -> int:
        """Dimension of the configuration vector."""
        return int(self.model.nq)

    @property
    def nv(self) -> int:
        """Dimension of the tangent space."""
        return int(self.model.nv)

    @property
    def floating(self) -> bool:
        """Whether the robot has a floating base."""
        return self.root == "free-flyer"

    @property
    def convention(self) -> str:
        """Order and meaning of ``q`` and ``v`` in one line."""
        return CONVENTION if self.floating else FIXED_CONVENTION

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints in the order of the model, without the free-flyer."""
        return tuple(self.model.names[i] for i in joint_range(self.model))

    @cached_property
    def q_names(self) -> tuple[str, ...]:
        """Names of the nq entries of ``q`` with their units; a continuous joint has a cosine and a sine."""
        named = [(self.model.names[k], joint_family(self.model.joints[k])) for k in range(1, self.model.njoints)]
        return tuple(f"{name} {part}" for name, family in named for part in JOINT_ENTRIES.get(family, ()))

    @cached_property
    def tangent_names(self) -> tuple[str, ...]:
        """Names of the nv velocity entries: ``base vx`` … ``base wz``, then joints."""
        names = [f"base {s}" for s in ("vx", "vy", "vz", "wx", "wy", "wz")] if self.floating else []
        for joint in self.joint_names:
            width = self.model.nvs[self.model.getJointId(joint)]
            names += [joint] if width == 1 else [f"{joint}[{k}]" for k in range(width)]
        return tuple(names)

    @property
    def first_joint(self) -> int:
        """Index of the first joint in ν: 6 with a floating base, otherwise 0."""
        return 6 if self.floating else 0

    @cached_property
    def armature(self) -> Array:
        """Armature before changes by the joint model, shape (nv,), kg·m² (kg for prismatic joints)."""
        return np.array(self.model.armature if self.stated_armature is None else self.stated_armature, dtype=float)

    @cached_property
    def coupling_matrix(self) -> Array:
        """Projector ``C`` onto the velocities that the couplings of joints allow, ``ν = C ν``, shape (nv, nv)."""
        C = np.eye(self.nv)
        for follower, leader, ratio in coupled_entries(self.model, self.couplings):
            C[follower, follower], C[follower, leader] = 0.0, ratio
        return C

    @cached_property
    def coupled_entries(self) -> list[tuple[int, int, float]]:
        """Entry of the follower in ν, entry of the leader, and ratio, for each coupling of joints that can move."""
        entries = coupled_entries(self.model, self.couplings)
        return [entry for entry in entries if np.isfinite(self.model.armature[entry[0]])]

    @cached_property
    def coupled_joints(self) -> frozenset[str]:
        """Names of all leaders and followers."""
        return frozenset(joint for c in self.couplings for joint in (c.leader, c.follower))

    @cached_property
    def projector(self) -> Array:
        """Projector onto the velocities that couplings and locked joints allow in an impact, shape (nv, nv)."""
        return np.asarray(self.coupling_matrix * np.isfinite(self.model.armature))

    @cached_property
    def followers(self) -> NDArray[np.bool_]:
        """Whether each velocity entry belongs to a joint that follows another joint, shape (nv,)."""
        return np.asarray(np.diag(self.coupling_matrix) == 0)

    @property
    def held(self) -> tuple[str, ...]:
        """Joints that robot.toml holds at constant positions, except locked joints."""
        return tuple(joint for joint in self.spec.constraints.hold if joint not in self.locked)

    @property
    def held_entries(self) -> list[int]:
        """Entries of the joints :attr:`held` in ν."""
        return self.entries(self.held)

    def entries(self, joints: Sequence[str]) -> list[int]:
        """Return the entries of joints in ν; raise the errors of :meth:`joint_id`."""
        return [k for joint in joints for k in range(self.nv)[v_slice(self.model, self.joint_id(joint))]]

    def fixed_with(self, hold: Sequence[str]) -> tuple[str, ...]:
        """Return ``hold``, the joints with equal position limits, and all joints that are coupled to any of these."""
        return with_partners(self.couplings, (*hold, *immovable_joints(self.model)))

    @property
    def velocity_limits(self) -> Array:
        """Velocity limits, rad/s or m/s, shape (nv,); infinite for entries without a limit."""
        limits = np.array(self.model.velocityLimit)
        limits[: self.first_joint] = np.inf
        return np.where((limits > 0) & (limits < ENDLESS), limits, np.inf)

    @cached_property
    def mass(self) -> float:
        """Total moving mass, kg."""
        return float(pin.computeTotalMass(self.model))

    @cached_property
    def frame_names(self) -> tuple[str, ...]:
        """Names of all frames, except the universe."""
        return tuple(f.name for f in self.model.frames if f.name != "universe")

    @cached_property
    def model_sha256(self) -> str:
        """Hash of the data of the dynamics: joints, placements, inertias and :attr:`armature`."""
        return dynamics_hash(self.model, self.armature, self.couplings)

    @cached_property
    def impact_sha256(self) -> str:
        """Like :attr:`model_sha256`, but with ``model.armature``, which depends on the joint model."""
        return dynamics_hash(self.model, np.asarray(self.model.armature), self.couplings)

    @cached_property
    def kinematics_sha256(self) -> str:
        """Hash of joints, frames, position limits, and postures."""
        return kinematics_hash(self.model, self.postures, self.default_posture, self.couplings)

    @cached_property
    def data_sha256(self) -> str:
        """Hash of all data except shapes: dynamics, kinematics, limits, passive forces, and ``robot.toml``."""
        efforts, rates = rounded(self.model.effortLimit), rounded(self.model.velocityLimit)
        passive = [rounded(values) for values in self.mjcf.passive] if self.mjcf is not None else []
        return hash_of((self.model_sha256, self.kinematics_sha256, efforts, rates, repr(self.spec), *passive))

    @checked
    def frame_id(self, name: str) -> int:
        """Return the index of a frame.  If a link and a joint have the same name, return the link.

        Raises:
            FrameNotFound: The robot lacks this frame.
        """
        if name not in self._frames:
            raise FrameNotFound(name, self.frame_names, where=self.name)
        return self._frames[name]

    @cached_property
    def _frames(self) -> dict[str, int]:
        frames = list(enumerate(self.model.frames))
        links = [(i, frame.name) for i, frame in frames if frame.type == pin.FrameType.BODY]
        others = [(i, frame.name) for i, frame in frames if frame.name != "universe"]
        # Of several frames with the same name, use the first link.  Without a link, use the first frame.
        return {name: i for i, name in reversed([*links, *others])}

    @checked
    def joint_id(self, name: str) -> int:
        """Return the index of the joint ``name`` in the model.

        Raises:
            JointNotFound: The robot lacks this joint.
            JointLocked: The joint is locked.
        """
        if name in self.locked:
            raise JointLocked(name, where=self.name)
        if name not in self.joint_names:
            raise JointNotFound(name, self.joint_names, where=self.name)
        return int(self.model.getJointId(name))

    @checked
    def contact_pose(self, frame: str) -> ContactPose:
        """Return the default setting ``contact_pose`` for a contact frame."""
        points = [foot.frame for foot in self.spec.supports if foot.kind == "point"]
        return self.spec.contact.frames.get(frame, "position" if frame in points else self.spec.contact.pose)

    @checked
    def posture(self, name: str | None = None) -> Array:
        """Return a copy of the named posture, or of the default posture, shape (nq,).

        Raises:
            PostureNotFound: The robot lacks this posture.
        """
        name = name or self.default_posture
        if name not in self.postures:
            raise PostureNotFound(name, self.postures, where=self.name)
        return np.array(self.postures[name], dtype=float)

    @property
    def upright(self) -> Array | None:
        """World z axis in base axes, at the default posture, shape (3,); ``None`` for a fixed base."""
        return pin.Quaternion(self.posture()[3:7]).matrix()[2].copy() if self.floating else None

    @checked
    def check_posture(self, q: Array, *, where: str = "posture", limits: bool = True) -> Array:
        """Check length, finiteness, quaternion, couplings and limits; return ``q`` with unit quaternions.

        Raises:
            PostureError: ``q`` has a wrong length, a number that is not finite, or an invalid quaternion.
            NotWithinLimits: A joint is outside its limits.
        """
        q = np.array(q, dtype=float).reshape(-1)
        if q.size != self.nq:
            fault = f"a posture of {self.name} has {self.nq} numbers, this one {q.size}"
            raise PostureError(fault, where=where, hint=f"give {self.convention.split(';')[0]}")
        if not np.isfinite(q).all():
            fault = f"entry {int(np.argmin(np.isfinite(q)))} is not finite"
            raise PostureError(fault, where=where, hint="correct it")
        self._check_norms(q, where)
        if self.floating:
            self._check_swapped(q[3:7], where)
        q = pin.normalize(self.model, q)
        if limits:
            q = self._check_coupled(q, where)
            self.check_limits(q, where=where)
        return np.asarray(q)

    def coupled(self, q: Array) -> Array:
        """Return a copy of ``q``, shape (nq,), with each follower at the position that its leader requires."""
        return coupled(self.model, self.couplings, q)

    def _check_coupled(self, q: Array, where: str) -> Array:
        """Return ``q`` with exact positions of followers; raise an error if they differ by more than ``_COUPLED``."""
        exact = self.coupled(q)
        for c in self.couplings:
            index = self.model.idx_qs[self.model.getJointId(c.follower)]
            if abs(exact[index] - q[index]) > _COUPLED:
                fault = (
                    f"joint '{c.follower}' is at {q[index]:.4g}, but it follows '{c.leader}' to {exact[index]:.4g}"
                )
                raise PostureError(fault, where=where, hint=f"change one of them, or leave out '{c.follower}'")
        return exact

    def _check_norms(self, q: Array, where: str) -> None:
        """Raise an error if a quaternion, or a cosine and sine of a continuous joint, does not have unit length."""
        for i, part in unit_parts(self.model):
            norm = float(np.linalg.norm(q[part]))
            if abs(norm - 1) > 1e-3:
                four, name = part.stop - part.start == 4, str(self.model.names[i])
                kind = "quaternion" if four else "pair of cosine and sine"
                what = f"the base {kind}" if self.floating and i == 1 else f"the {kind} of joint '{name}'"
                order = " x y z w" if four else ""
                raise PostureError(f"{what} has norm {norm:.4g}", where=where, hint=f"give a unit {kind}{order}")

    def _check_swapped(self, quaternion: Array, where: str) -> None:
        """Raise an error if the base quaternion seems to be in the order w x y z."""
        rotation = pin.Quaternion(*[float(quaternion[k]) for k in (3, 0, 1, 2)]).matrix()
        swapped = pin.Quaternion(*[float(v) for v in quaternion]).matrix()
        # The base is upside down in the order x y z w, but upright in the order w x y z.
        if rotation[2, 2] < -0.9 and swapped[2, 2] > 0.9 and self.spec.kind in ("aerial", "quadruped", "humanoid"):
            fault = "puts the robot on its head"
        elif abs(quaternion[0]) > 0.999 and abs(quaternion[3]) < 0.04:
            fault = "turns the robot by 180° about x"
        else:
            return
        what = f"the base quaternion {fault} and looks like w x y z"
        raise PostureError(what, where=where, hint="give it as x y z w (scalar last)")

    @checked
    def check_limits(self, q: Array, *, where: str = "posture") -> None:
        """Raise :class:`NotWithinLimits` for the first joint of ``q`` outside its position limits."""
        for joint in self.joint_names:
            index = self.model.getJointId(joint)
            if self.model.nqs[index] != self.model.nvs[index]:
                continue  # Continuous joints have no limits.
            entries = q_slice(self.model, index)
            for k in range(entries.start, entries.stop):
                low, high = float(self.model.lowerPositionLimit[k]), float(self.model.upperPositionLimit[k])
                if not low - _ON_LIMIT <= q[k] <= high + _ON_LIMIT:
                    angle = joint_family(self.model.joints[index]) == "revolute"
                    raise NotWithinLimits(joint, float(q[k]), low, high, where=where, angle=angle)


def unit_parts(model: pin.Model) -> list[tuple[int, slice]]:
    """Return (joint index, entries in ``q``) of every quaternion and every pair of cosine and sine in ``q``."""
    parts = []
    for joint in range(1, model.njoints):
        if model.nqs[joint] != model.nvs[joint]:
            end = q_slice(model, joint).stop
            count = 4 if joint_family(model.joints[joint]) in ("spherical", "free-flyer") else 2
            parts.append((joint, slice(end - count, end)))
    return parts
