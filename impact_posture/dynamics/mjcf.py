"""Build a MuJoCo model from a ``pin.Model``, with the same bodies, joints, inertias and armature.

The URDF reader of MuJoCo is not used, because it loses package paths, the floating base and the armature, and changes
the order of joints.  The model has no shapes.  A simulation adds shapes with :meth:`Mjcf.add_geom` and
:meth:`Mjcf.add_plane`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import pinocchio as pin

from impact_posture.dynamics.chart import BOUNDED, Chart, JointSlot
from impact_posture.dynamics.mjcf_layout import MjcfLayout
from impact_posture.errors import InputError
from impact_posture.robot.model_joints import ENDLESS
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array
from impact_posture.system.escape import xml_name
from impact_posture.system.optional_package import import_mujoco

Geom = Literal["sphere", "box", "plane"]

# Joint index of the world.
WORLD = 0
# Smallest mass (kg) and moment of inertia (kg m²) of a moving body that MuJoCo accepts.
_LEAST = 1e-15
# Impedance (``solimp`` of MuJoCo) of couplings, with the largest values that MuJoCo accepts.
_STIFF = (0.9999, 0.9999, 1e-4, 0.5, 2.0)
# With these options MuJoCo does not change inertias and does not merge bodies.
_COMPILER = {
    "degree": False,
    "autolimits": True,
    "inertiafromgeom": 0,
    "balanceinertia": False,
    "boundmass": 0.0,
    "boundinertia": 0.0,
    "fusestatic": False,
    "alignfree": False,
}


@dataclass(frozen=True, eq=False)
class Mjcf:
    """A ``pin.Model`` as an editable MuJoCo model.

    Attributes:
        spec: The ``mujoco.MjSpec``, which :meth:`compile` compiles.
        layout: Conversions between the coordinates of Pinocchio and MuJoCo.
        bodies: Index of a Pinocchio joint → name of the body that the joint moves.
        joints: Index of a Pinocchio joint → names of the MuJoCo joints that represent it.
        sites: Index of a frame → name of its site.  Of several frames with the same name, only one has a site.
        moments: Body name → principal moments of inertia that MuJoCo rejects, kg·m², shape (3,).  The spec contains
            the nearest accepted moments, and :meth:`compile` sets the exact moments.
        inverse_weights: Body name → ``body_invweight0`` that :meth:`compile` sets, shape (2,): 1/kg and 1/(kg m²).
            MuJoCo scales the softness of contacts with ``body_invweight0``.  ``None`` stands for the values of the
            parent body.
    """

    spec: Any
    layout: MjcfLayout
    bodies: dict[int, str]
    joints: dict[int, tuple[str, ...]]
    sites: dict[int, str]
    moments: dict[str, Array]
    inverse_weights: dict[str, Array | None] = field(default_factory=dict)

    def body(self, joint: int) -> Any:
        """Return the ``MjsBody`` that a Pinocchio joint moves; for :data:`WORLD`, the body of the world."""
        return self.spec.worldbody if joint == WORLD else self.spec.body(self.bodies[joint])

    def add_geom(self, joint: int, name: str, kind: Geom, size: Sequence[float], placement: pin.SE3) -> None:
        """Add a shape without mass, which collides only in explicit contact pairs.

        ``joint`` is the index of the Pinocchio joint that moves the shape, or :data:`WORLD`.  ``placement`` is the
        pose of the shape in the frame of this joint.  ``size`` is the radius, or three half extents, m.  A plane is
        infinite and normal to its z axis.
        """
        type_ = getattr(import_mujoco().mjtGeom, f"mjGEOM_{kind.upper()}")
        size = (*size, 0.0, 0.0)[:3]
        self.body(joint).add_geom(
            name=name, type=type_, size=size, mass=0.0, contype=0, conaffinity=0, **pose(placement)
        )

    def add_hull(self, joint: int, name: str, points: Array) -> None:
        """Add the convex hull of points in the frame of a joint, shape (k, 3), as in :meth:`add_geom`."""
        convex = import_mujoco().mjtMeshInertia.mjMESH_INERTIA_CONVEX
        self.spec.add_mesh(name=name, uservert=np.ravel(points), inertia=convex)
        self.body(joint).add_geom(
            name=name, type=import_mujoco().mjtGeom.mjGEOM_MESH, meshname=name, mass=0.0, contype=0, conaffinity=0
        )

    def couple_joints(self, robot: Robot) -> None:
        """Couple followers to their leaders, as stiffly as the time step of the model allows."""
        types = import_mujoco()
        joint, kind = types.mjtObj.mjOBJ_JOINT, types.mjtEq.mjEQ_JOINT
        for c in robot.couplings:
            equality = self.spec.add_equality(type=kind, objtype=joint, data=[c.offset, c.ratio, *np.zeros(10)])
            equality.name1, equality.name2 = (self.joints[robot.joint_id(k)][0] for k in (c.follower, c.leader))
            equality.solref, equality.solimp = (2 * self.spec.option.timestep, 1.0), _STIFF

    def add_plane(self, name: str, point: Array, normal: Array) -> None:
        """Add an infinite plane to the world through ``point`` with unit ``normal``, in world axes, shape (3,)."""
        upright = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), np.array(normal)).matrix()
        self.add_geom(WORLD, name, "plane", (1.0, 1.0, 1.0), pin.SE3(upright, np.array(point)))

    def compile(self) -> Any:
        """Return the ``mujoco.MjModel``; raise ``InputError`` if MuJoCo rejects the model."""
        mujoco = import_mujoco()
        try:
            model = self.spec.compile()
        except ValueError as error:
            raise InputError(f"MuJoCo refuses the model ({error})", where="MJCF", hint="correct the URDF") from None
        for name, moments in self.moments.items():
            model.body_inertia[model.body(name).id] = moments
        if self.moments:
            mujoco.mj_setConst(model, mujoco.MjData(model))
        for name, weights in self.inverse_weights.items():
            parent = model.body_parentid[model.body(name).id]
            model.body(name).invweight0 = model.body_invweight0[parent] if weights is None else weights
        return model


def pose(placement: pin.SE3) -> dict[str, Array]:
    """Return a placement as MuJoCo arguments: ``pos`` (m) and ``quat`` (unit, w x y z)."""
    quaternion = pin.Quaternion(np.array(placement.rotation)).normalized()
    return {"pos": np.array(placement.translation), "quat": np.array(quaternion.coeffs()[[3, 0, 1, 2]])}


def build_mjcf(model: pin.Model, name: str = "robot") -> Mjcf:
    """Build the MuJoCo model of a Pinocchio model.

    A body has the name of the link at its origin; without a link, it has the name of its joint.  Every frame becomes
    a site with the name of the frame.  If a link and a joint have the same name, the site is at the frame of the
    link.  A free-flyer whose parent is the world becomes a free joint.  Any other free-flyer becomes three slides and
    a ball.  A planar joint becomes two slides and a hinge, and a translation becomes three slides.  A body without
    mass gets the smallest mass and moments of inertia that MuJoCo accepts.  The model has no friction, damping or
    effort limits, because the dynamics of Pinocchio do not include them.

    Raises:
        UnsupportedJoint: The joint type cannot occur in a URDF.
        InputError: MuJoCo is not installed, or axes with different armatures would be one MuJoCo joint.
    """
    order = _depth_first(model)
    slots = Chart(model).slots
    free = frozenset(i for i in order if _is_free(model, slots[i - 1]))
    spec = import_mujoco().MjSpec()
    spec.modelname = xml_name(name)
    for key, value in _COMPILER.items():
        setattr(spec.compiler, key, value)
    spec.option.gravity = np.array(model.gravity.linear)
    elements = {WORLD: spec.worldbody}
    names, joints, moments = {}, {}, {}
    taken, joint_names = {"world"}, set[str]()
    for i in order:
        names[i] = _unique(_link_name(model, i), taken)
        inertia, exact = _inertia(model.inertias[i])
        body = elements[int(model.parents[i])].add_body(name=names[i], **pose(model.jointPlacements[i]), **inertia)
        joints[i] = _add_joints(body, model, slots[i - 1], i in free, joint_names)
        if exact is not None:
            moments[names[i]] = exact
        elements[i] = body
    return Mjcf(spec, MjcfLayout(model, order, free), names, joints, _add_sites(elements, model), moments)


def _depth_first(model: pin.Model) -> list[int]:
    """Return the joint indices in depth-first order, as MuJoCo numbers bodies."""
    order, waiting = [], [WORLD]
    while waiting:
        order.append(waiting.pop())
        waiting += list(model.children[order[-1]])[::-1]
    return order[1:]


def _is_free(model: pin.Model, slot: JointSlot) -> bool:
    """Return whether a MuJoCo free joint can represent a joint: a free-flyer on the world with equal armatures."""
    on_world = slot.kind.family == "free-flyer" and model.parents[slot.index] == WORLD
    return on_world and bool(np.ptp(np.asarray(model.armature)[slot.v]) == 0)


def _link_name(model: pin.Model, joint: int) -> str:
    """Return the name of the link whose frame equals the joint frame; without such a link, the name of the joint."""
    for frame in model.frames:
        if frame.parentJoint == joint and frame.type == pin.FrameType.BODY and frame.placement.isIdentity(1e-12):
            return str(frame.name)
    return str(model.names[joint])


def _unique(name: str, taken: set[str]) -> str:
    name = xml_name(name)
    unique, count = name, 1
    while unique in taken:
        count += 1
        unique = f"{name}_{count}"
    taken.add(unique)
    return unique


def _add_joints(body: Any, model: pin.Model, slot: JointSlot, free: bool, taken: set[str]) -> tuple[str, ...]:
    """Add the MuJoCo joints that represent a Pinocchio joint to its body, and return their names.

    Each column of the motion subspace becomes a slide or a hinge, but three rotation columns become one ball.
    """
    subspace, armature, types = slot.kind.subspace, np.asarray(model.armature)[slot.v], import_mujoco().mjtJoint
    names: list[str] = []

    def add(kind: str, suffix: str, value: float, axis: Array | None = None, limit: int | None = None) -> None:
        names.append(_unique(slot.name + suffix, taken))
        joint = body.add_joint(name=names[-1], type=getattr(types, f"mjJNT_{kind}"), armature=value)
        if axis is not None:
            joint.axis = axis
        if limit is not None:
            low, high = float(model.lowerPositionLimit[limit]), float(model.upperPositionLimit[limit])
            if low < high and max(-low, high) < ENDLESS:
                joint.range = (low, high)

    if free:
        add("FREE", "", armature[0])
        return tuple(names)
    slides = np.flatnonzero(subspace[:3].any(axis=0))
    turns = np.flatnonzero(subspace[3:].any(axis=0))
    if turns.size:
        _alike(armature[slides], slot)
    limited = slot.kind.family in BOUNDED
    for k in slides:
        suffix = f".{'xyz'[k]}" if slot.kind.nv > 1 else ""
        add("SLIDE", suffix, armature[k], subspace[:3, k], slot.q.start + int(k) if limited else None)
    suffix = ".turn" if slides.size else ""
    if turns.size == 1:
        add("HINGE", suffix, armature[turns[0]], subspace[3:, turns[0]], slot.q.start if limited else None)
    elif turns.size:
        _alike(armature[turns], slot)
        add("BALL", suffix, armature[turns[0]])
    return tuple(names)


def _alike(armature: Array, slot: JointSlot) -> None:
    """Raise ``InputError`` if the axes of a ball, or the slides before a rotation, have different armatures."""
    if armature.size and np.ptp(armature) > 0:
        what = f"the armature of joint '{slot.name}' differs between its axes"
        raise InputError(what, where="MJCF", hint="give all axes of the joint the same armature")


def _inertia(inertia: pin.Inertia) -> tuple[dict[str, Any], Array | None]:
    """Return the arguments of ``add_body`` for an inertia, and the principal moments if MuJoCo rejects them."""
    moments, axes = np.linalg.eigh(np.array(inertia.inertia))
    if np.linalg.det(axes) < 0:
        axes[:, 0] = -axes[:, 0]
    accepted = np.maximum(moments, _LEAST)
    # MuJoCo rejects a body if its largest moment exceeds the sum of the other two.
    accepted[2] = max(min(accepted[2], accepted[0] + accepted[1]), accepted[1])
    principal = {f"i{key}": value for key, value in pose(pin.SE3(axes, np.array(inertia.lever))).items()}
    mass = max(float(inertia.mass), _LEAST)
    exact = moments if np.abs(accepted - moments).max() > 2 * _LEAST else None
    return {**principal, "mass": mass, "inertia": accepted, "explicitinertial": True}, exact


def _add_sites(elements: dict[int, Any], model: pin.Model) -> dict[int, str]:
    links_first = sorted(range(model.nframes), key=lambda k: (model.frames[k].type != pin.FrameType.BODY, k))
    sites: dict[int, str] = {}
    seen, taken = {"universe"}, set[str]()
    for k in links_first:
        frame = model.frames[k]
        if frame.name not in seen:
            seen.add(str(frame.name))
            sites[k] = _unique(str(frame.name), taken)
            elements[int(frame.parentJoint)].add_site(name=sites[k], **pose(frame.placement))
    return sites
