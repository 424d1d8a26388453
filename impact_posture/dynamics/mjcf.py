"""Build a MuJoCo model from a ``pin.Model``, with the same bodies, joints, inertias and armature.

MuJoCo's own URDF reader loses package paths, the floating base and the armature, and changes the order of joints.
The model has no geometry.  A simulation adds it with :meth:`Mjcf.add_geom` and :meth:`Mjcf.add_plane`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pinocchio as pin

from impact_posture.dynamics.chart import BOUNDED, Chart, JointSlot
from impact_posture.dynamics.mjcf_layout import MjcfLayout
from impact_posture.errors import InputError
from impact_posture.robot.model_joints import ENDLESS
from impact_posture.system.arrays import Array
from impact_posture.system.escape import xml_name

Geom = Literal["sphere", "box", "plane"]

# Joint index of the world.
WORLD = 0
# MuJoCo refuses a moving body with less mass (kg) or moment (kg m²) than this.
_LEAST = 1e-15
# With these options MuJoCo keeps every inertia and every body as stated.
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
        layout: Conversions of coordinates.
        bodies: Name of the body that each Pinocchio joint moves, by joint index.
        joints: Names of the MuJoCo joints that make up each Pinocchio joint, by joint index.
        sites: Name of the site of each frame, by frame index.  Of frames with the same name, only the first has one.
        moments: Principal moments, kg·m², shape (3,), by body, that violate the triangle inequality.  MuJoCo refuses
            them, so the spec has the nearest valid moments, and :meth:`compile` sets the exact ones.
    """

    spec: Any
    layout: MjcfLayout
    bodies: dict[int, str]
    joints: dict[int, tuple[str, ...]]
    sites: dict[int, str]
    moments: dict[str, Array]

    def body(self, joint: int) -> Any:
        """Return the ``MjsBody`` that a Pinocchio joint moves, or the world for :data:`WORLD`."""
        return self.spec.worldbody if joint == WORLD else self.spec.body(self.bodies[joint])

    def add_geom(self, joint: int, name: str, kind: Geom, size: Sequence[float], placement: pin.SE3) -> None:
        """Add a massless shape, which collides only in contact pairs.

        ``joint`` is the index of the Pinocchio joint that moves it, or :data:`WORLD`, and ``placement`` its pose in
        the frame of the joint.  ``size`` is its radius, or three half extents, m.  A plane is endless, normal to its
        z axis.
        """
        type_ = getattr(import_mujoco().mjtGeom, f"mjGEOM_{kind.upper()}")
        size = (*size, 0.0, 0.0)[:3]
        self.body(joint).add_geom(
            name=name, type=type_, size=size, mass=0.0, contype=0, conaffinity=0, **pose(placement)
        )

    def add_plane(self, name: str, point: Array, normal: Array) -> None:
        """Add an endless plane through a point to the world, with a unit normal, each world, shape (3,)."""
        upright = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), np.array(normal)).matrix()
        self.add_geom(WORLD, name, "plane", (1.0, 1.0, 1.0), pin.SE3(upright, np.array(point)))

    def compile(self) -> Any:
        """Return the ``mujoco.MjModel``, or raise InputError if MuJoCo refuses the model."""
        mujoco = import_mujoco()
        try:
            model = self.spec.compile()
        except ValueError as error:
            raise InputError(f"MuJoCo refuses the model ({error})", where="MJCF", hint="correct the URDF") from None
        for name, moments in self.moments.items():
            model.body_inertia[model.body(name).id] = moments
        if self.moments:
            mujoco.mj_setConst(model, mujoco.MjData(model))
        return model


def import_mujoco() -> Any:
    """Return the ``mujoco`` module, or raise InputError if it is not installed."""
    try:
        import mujoco
    except ImportError:
        hint = "pip install 'impact-posture[sim]'"
        raise InputError("MuJoCo is not installed", where="the extra 'sim'", hint=hint) from None
    return mujoco


def pose(placement: pin.SE3) -> dict[str, Array]:
    """Return ``pos`` (m) and ``quat`` (w x y z, unit) of a placement."""
    quaternion = pin.Quaternion(np.array(placement.rotation)).normalized()
    return {"pos": np.array(placement.translation), "quat": np.array(quaternion.coeffs()[[3, 0, 1, 2]])}


def build_mjcf(model: pin.Model, name: str = "robot") -> Mjcf:
    """Build the MuJoCo model of a Pinocchio model.

    Each body has the name of the link at its origin, or else of its joint.  Every frame becomes a site with its name.
    Where a link and a joint have the same name, it is the frame of the link.  A free-flyer on the world becomes a
    free joint, and any other free-flyer three slides and a ball.  A planar joint becomes two slides and a hinge, and
    a translation three slides.  A massless body gets the least mass and moments that MuJoCo accepts, 1e-15.  The
    model has no friction, damping or effort limits, because the dynamics of Pinocchio have none.

    Raises:
        UnsupportedJoint: The joint type is not possible in a URDF.
        InputError: MuJoCo is not installed, or the armature differs between axes that have one value in MuJoCo.
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
    """Return the joint indices in the order in which MuJoCo numbers bodies."""
    order, waiting = [], [WORLD]
    while waiting:
        order.append(waiting.pop())
        waiting += list(model.children[order[-1]])[::-1]
    return order[1:]


def _is_free(model: pin.Model, slot: JointSlot) -> bool:
    """Return whether a joint can be a free joint, which moves in the world and has one armature for all six axes."""
    if slot.kind.family != "free-flyer" or model.parents[slot.index] != 0:
        return False
    return bool(np.ptp(np.asarray(model.armature)[slot.v]) == 0)


def _link_name(model: pin.Model, joint: int) -> str:
    """Return the name of the link whose frame coincides with the joint's, or else the name of the joint."""
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
    """Add the MuJoCo joints of a Pinocchio joint to its body and return their names.

    A column of the motion subspace becomes a slide or a hinge, and three columns of rotation become a ball.
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
    """Refuse different armatures of the axes of a ball, or of slides that a rotation turns."""
    if armature.size and np.ptp(armature) > 0:
        what = f"the armature of joint '{slot.name}' differs between its axes"
        raise InputError(what, where="MJCF", hint="give it one value")


def _inertia(inertia: pin.Inertia) -> tuple[dict[str, Any], Array | None]:
    """Return the arguments of ``add_body`` for an inertia, and its exact moments where MuJoCo refuses them."""
    moments, axes = np.linalg.eigh(np.array(inertia.inertia))
    if np.linalg.det(axes) < 0:
        axes[:, 0] = -axes[:, 0]
    accepted = np.maximum(moments, _LEAST)
    # MuJoCo refuses a largest moment above the sum of the others.
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


@contextmanager
def unwarned() -> Iterator[None]:
    """Keep MuJoCo from writing warnings to a log file in the working directory.  The state shows the problem."""
    mujoco = import_mujoco()
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
