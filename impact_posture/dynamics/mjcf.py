"""MuJoCo's model written out of a ``pin.Model``: the same bodies, joints, inertias and armature, nothing read twice.

A URDF read by MuJoCo itself would lose package paths, the floating base and the armature, and order joints its own
way.  The model has no geometry: who simulates contact adds it (:mod:`impact_posture.dynamics.mjcf_scene`).
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.dynamics.chart import Chart, JointSlot
from impact_posture.dynamics.mjcf_layout import MjcfLayout
from impact_posture.dynamics.mjcf_text import numbers, pose
from impact_posture.errors import InputError, UnsupportedJoint
from impact_posture.escape import xml_name

Vector = NDArray[np.float64]

# MuJoCo refuses a moving body with less mass (kg) or moment (kg m²) than this.
_LEAST = 1e-15
# Pinocchio writes "no limit" as the largest double.
_ENDLESS = 1e10

_COMPILER = {
    "angle": "radian",
    "autolimits": "true",
    # Every inertia is written as it is: none derived, none raised, no body merged or turned.
    "inertiafromgeom": "false",
    "balanceinertia": "false",
    "boundmass": "0",
    "boundinertia": "0",
    "fusestatic": "false",
    "alignfree": "false",
}


@dataclass(frozen=True, eq=False)
class Mjcf:
    """A ``pin.Model`` in MuJoCo's words.

    Attributes:
        xml: The MJCF document.
        layout: Conversions of coordinates.
        bodies: Name of the body of each joint of Pinocchio's, by joint index.
        joints: Names of the joints that make up each joint of Pinocchio's, by joint index.
        sites: Name of the site of each frame, by frame index; a frame whose name another one has is left out.
        moments: Principal moments, kg·m², shape (3,), by body, that break the triangle inequality and so cannot stand
            in the XML: it has the nearest moments that hold it, and :meth:`compile` sets these.
    """

    xml: str
    layout: MjcfLayout
    bodies: dict[int, str]
    joints: dict[int, tuple[str, ...]]
    sites: dict[int, str]
    moments: dict[str, Vector]

    def compile(self) -> Any:
        """Build the ``mujoco.MjModel``.

        Raises:
            InputError: MuJoCo is not installed, or refuses the model.
        """
        mujoco = import_mujoco()
        try:
            model = mujoco.MjModel.from_xml_string(self.xml)
        except ValueError as error:
            raise InputError(f"MuJoCo refuses the model ({error})", where="MJCF", hint="correct the URDF") from None
        for name, moments in self.moments.items():
            model.body_inertia[model.body(name).id] = moments
        if self.moments:
            mujoco.mj_setConst(model, mujoco.MjData(model))
        return model


def import_mujoco() -> Any:
    """The ``mujoco`` module.

    Raises:
        InputError: It is not installed.
    """
    try:
        import mujoco
    except ImportError:
        raise InputError(
            "MuJoCo is not installed", where="the extra 'sim'", hint="pip install 'impact-posture[sim]'"
        ) from None
    return mujoco


def write_mjcf(model: pin.Model, name: str = "robot") -> Mjcf:
    """Write a model as MJCF.

    Bodies are named after the link at their origin, else after their joint; every frame becomes a site of its name
    (that of a link where a joint has the same).  A free-flyer is a free joint, or three slides and a ball where it
    does not hang on the world; planar joints are two slides and a hinge, translations three slides.  A massless body
    gets the least mass and moments that MuJoCo takes, 1e-15.  Friction, damping and effort limits are left out, as
    Pinocchio's dynamics leaves them out.

    Args:
        model: The model; treated as read-only.
        name: What the MJCF calls it.

    Raises:
        UnsupportedJoint: A joint that no URDF makes.
        InputError: An armature that differs between the axes of one joint and that MuJoCo has no place for.
    """
    order = _depth_first(model)
    slots = {slot.index: slot for slot in Chart(model).slots}
    free = frozenset(i for i in order if _is_free(model, slots[i]))
    root = ET.Element("mujoco", model=xml_name(name))
    ET.SubElement(root, "compiler", _COMPILER)
    ET.SubElement(root, "option", gravity=numbers(model.gravity.linear))
    elements = {0: ET.SubElement(root, "worldbody")}
    bodies, joints, moments = {}, {}, {}
    taken, joint_names = {"world"}, set[str]()
    for i in order:
        place = model.jointPlacements[i]
        bodies[i] = _unique(_link_name(model, i), taken)
        body = ET.SubElement(elements[int(model.parents[i])], "body", {"name": bodies[i], **pose(place)})
        _add_joint(body, model, slots[i], i in free, joint_names)
        joints[i] = tuple(str(joint.get("name")) for joint in body.findall("joint"))
        exact = _add_inertia(body, model.inertias[i])
        if exact is not None:
            moments[bodies[i]] = exact
        elements[i] = body
    sites = _add_sites(elements, model)
    ET.indent(root)
    xml = ET.tostring(root, encoding="unicode") + "\n"
    return Mjcf(xml, MjcfLayout(model, order, free), bodies, joints, sites, moments)


def _depth_first(model: pin.Model) -> list[int]:
    """Joint indices in the order in which MuJoCo numbers bodies."""
    children: dict[int, list[int]] = {}
    for i in range(1, model.njoints):
        children.setdefault(int(model.parents[i]), []).append(i)
    order: list[int] = []
    waiting = children.get(0, [])[::-1]
    while waiting:
        i = waiting.pop()
        order.append(i)
        waiting += children.get(i, [])[::-1]
    return order


def _is_free(model: pin.Model, slot: JointSlot) -> bool:
    """Whether a free-flyer can be MuJoCo's: only on the world, with one armature for all six."""
    if slot.kind.family != "free-flyer" or model.parents[slot.index] != 0:
        return False
    return bool(np.ptp(np.asarray(model.armature)[slot.v]) == 0)


def _link_name(model: pin.Model, joint: int) -> str:
    """The link whose frame is the joint's own, else the joint."""
    for frame in model.frames:
        if frame.parentJoint == joint and frame.type == pin.FrameType.BODY and frame.placement.isIdentity(1e-12):
            return str(frame.name)
    return str(model.names[joint])


def _unique(name: str, taken: set[str]) -> str:
    name = xml_name(name)
    found, count = name, 1
    while found in taken:
        count += 1
        found = f"{name}_{count}"
    taken.add(found)
    return found


# ---- joints -----------------------------------------------------------------------------------------------------


def _add_joint(body: ET.Element, model: pin.Model, slot: JointSlot, free: bool, taken: set[str]) -> None:
    family, armature = slot.kind.family, np.asarray(model.armature)[slot.v]

    def add(kind: str, suffix: str, value: float, axis: Iterable[float] = (), limits: bool = False) -> None:
        joint = ET.SubElement(body, "joint", name=_unique(slot.name + suffix, taken), type=kind)
        if axis:
            joint.set("axis", numbers(axis))
        if value:
            joint.set("armature", repr(float(value)))
        if limits:
            k = slot.q.start + "xyz".find(suffix[1:]) if suffix else slot.q.start
            low, high = float(model.lowerPositionLimit[k]), float(model.upperPositionLimit[k])
            if low < high and max(-low, high) < _ENDLESS:
                joint.set("range", numbers((low, high)))

    eye = np.eye(3)
    slides = [(f".{letter}", tuple(eye[k])) for k, letter in enumerate("xyz")]
    if family in ("revolute", "continuous", "prismatic"):
        kind = "slide" if family == "prismatic" else "hinge"
        add(kind, "", armature[0], tuple(slot.kind.axis), limits=family != "continuous")
    elif family == "translation":
        for k, (suffix, axis) in enumerate(slides):
            add("slide", suffix, armature[k], axis, limits=True)
    elif family == "planar":
        value = _alike(armature[:2], slot)
        for suffix, axis in slides[:2]:
            add("slide", suffix, value, axis)
        add("hinge", ".turn", armature[2], tuple(eye[2]))
    elif family == "spherical":
        add("ball", "", _alike(armature, slot))
    elif family == "free-flyer" and free:
        add("free", "", armature[0])
    elif family == "free-flyer":
        value = _alike(armature[:3], slot)
        for suffix, axis in slides:
            add("slide", suffix, value, axis)
        add("ball", ".turn", _alike(armature[3:], slot))
    else:
        raise UnsupportedJoint(
            f"joint '{slot.name}' of family {family} has no form in MJCF", where="MJCF", hint="lock it (--lock)"
        )


def _alike(armature: Vector, slot: JointSlot) -> float:
    """The one armature of axes that turn against each other, or of a ball."""
    if np.ptp(armature) > 0:
        raise InputError(
            f"the armature of joint '{slot.name}' differs between its axes", where="MJCF", hint="give it one value"
        )
    return float(armature[0])


# ---- inertias and sites -----------------------------------------------------------------------------------------


def _add_inertia(body: ET.Element, inertia: pin.Inertia) -> Vector | None:
    """Write a body's inertia by its principal axes; returns the moments where the XML may not have them exactly."""
    moments, axes = np.linalg.eigh(np.array(inertia.inertia))
    if np.linalg.det(axes) < 0:
        axes[:, 0] = -axes[:, 0]
    written = np.maximum(moments, _LEAST)
    # MuJoCo refuses a largest moment above the sum of the others.
    written[2] = max(min(written[2], written[0] + written[1]), written[1])
    placement = pin.SE3(axes, np.array(inertia.lever))
    mass = repr(max(float(inertia.mass), _LEAST))
    ET.SubElement(body, "inertial", {**pose(placement, always=True), "mass": mass, "diaginertia": numbers(written)})
    return moments if np.abs(written - moments).max() > 2 * _LEAST else None


def _add_sites(elements: dict[int, ET.Element], model: pin.Model) -> dict[int, str]:
    links_first = sorted(range(model.nframes), key=lambda k: (model.frames[k].type != pin.FrameType.BODY, k))
    sites: dict[int, str] = {}
    there, taken = {"universe"}, set[str]()
    for k in links_first:
        frame = model.frames[k]
        if frame.name in there:
            continue
        there.add(str(frame.name))
        sites[k] = _unique(str(frame.name), taken)
        element = elements[int(frame.parentJoint)]
        ET.SubElement(element, "site", {"name": sites[k], **pose(frame.placement)})
    return sites
