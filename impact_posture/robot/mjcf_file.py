"""Compile an MJCF with the compiler of MuJoCo, and refuse content that a tree of joints cannot represent."""

from __future__ import annotations

import codecs
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from impact_posture.config.problem_settings import Root
from impact_posture.errors import MjcfError, listed
from impact_posture.robot.joint_coupling import JointCoupling, composed
from impact_posture.robot.urdf import FARTHEST, MOST_DEGREES_OF_FREEDOM
from impact_posture.system.arrays import Array
from impact_posture.system.isolated_calls import CallFailed, isolated_call
from impact_posture.system.optional_package import import_mujoco, unwarned
from impact_posture.system.text_files import open_regular, read_bytes

# Value of the compiler option ``inertiafromgeom`` with which geoms replace stated inertias.
_FROM_GEOMS = 1
# Pattern of the root element after a declaration and comments.  Atomic groups keep the search short in a file with
# many comments.  A file with the root ``mujocoinclude`` is a part of another file.
_ROOT = re.compile(
    rb"(?:\xef\xbb\xbf)?\s*(?>(?><\?.*?\?>|<!--.*?-->|<!DOCTYPE[^>]*>)\s*)*+<mujoco(?:include)?\b", re.S
)
# Number of bytes at the start of a file in which the root element is searched.
_HEAD = 50_000
# Largest number of bodies, of repetitions, and of rows or columns of a height field.  MuJoCo takes 2 s to read 10,000
# bodies, and four times as long for twice as many.  MuJoCo crashes if a height field does not fit into memory.
_MOST = 5_000
_COUNT = re.compile(rb"""\b(?:nrow|ncol|count)\s*=\s*["']\s*(\d{1,9})""")
# Processor time of the compiler, s.  The compiler needs 2 s for 10,000 bodies.
_SECONDS = 30.0
_UTF_16 = codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE
# Fields of a compiled model that must be finite.
_NUMBERS = (
    "qpos0", "body_pos", "body_quat", "body_ipos", "body_iquat", "jnt_pos", "jnt_axis", "dof_armature", "site_pos",
    "site_quat", "geom_pos", "geom_quat", "geom_size", "eq_data", "key_qpos", "actuator_gear", "actuator_armature",
    "gravity", "qpos_spring", "jnt_stiffness", "dof_damping", "dof_frictionloss", "geom_friction", "geom_solref",
    "geom_solimp", "geom_solmix", "geom_margin", "geom_gap",
)  # fmt: skip
# Fields of ranges, which may be infinite.
_RANGES = ("jnt_range", "jnt_actfrcrange", "actuator_forcerange", "actuator_ctrlrange", "actuator_gainprm")


class MjcfFile(NamedTuple):
    """A compiled MJCF.

    Attributes:
        model: The ``mujoco.MjModel`` with the chosen root.
        keyframes: Name of a keyframe → name of a joint → entries of the joint in ``qpos``.
        couplings: Couplings of joints by equality constraints.
        notes: Warnings about content of the MJCF that is ignored, one line each.
    """

    model: Any
    keyframes: dict[str, dict[str, Array]]
    couplings: tuple[JointCoupling, ...]
    notes: tuple[str, ...]


def is_mjcf(path: Path) -> bool:
    """Return whether the root of a file is ``<mujoco>`` or ``<mujocoinclude>``; ``False`` if it is unreadable."""
    try:
        with open_regular(path) as file:
            head = file.read(_HEAD)
    except (OSError, ValueError):
        return False
    if head.startswith(_UTF_16):
        head = head.decode("utf-16", errors="ignore").encode()
    return _ROOT.match(head) is not None


def read_mjcf(path: Path, root: Root | None) -> MjcfFile:
    """Compile an MJCF.  ``root`` adds or removes the free joint; ``None`` keeps the root of the file.

    Raises:
        MjcfError: MuJoCo rejects the file, crashes, or takes too much time or memory; or loops, tendons or
            polynomials couple joints.
        InputError: MuJoCo is not installed.
    """
    import_mujoco()
    text = read_bytes(path)
    if text.startswith(_UTF_16):
        raise MjcfError("is in UTF-16, which MuJoCo cannot read", where=str(path), hint="save it as UTF-8")
    if max(text.count(b"<body"), *map(int, _COUNT.findall(text)), 0) > _MOST:
        fault = f"has more than {_MOST} bodies, repetitions, or rows or columns of a height field"
        raise MjcfError(fault, where=str(path), hint="name the file of the robot without its scene")
    try:
        return isolated_call(lambda: _read(path, root), _SECONDS)
    except CallFailed as fault:
        hint = "correct it and the files that it names"
        raise MjcfError(fault.what, where=str(path), hint=hint) from None


def _read(path: Path, root: Root | None) -> MjcfFile:
    mujoco = import_mujoco()
    with unwarned(), warnings.catch_warnings(action="ignore"):
        try:
            spec = mujoco.MjSpec.from_file(str(path))
            spec.nkey = len(spec.keys)  # A larger number in the file would only waste memory.
            if len(spec.bodies) < 2:  # The first body is the world.
                hint = "name the file of a robot, or the file that includes this part"
                raise MjcfError("has no body", where=str(path), hint=hint)
            spec.compiler.fusestatic = False
            model, notes = _compile(spec, path)
            keyframes = _keyframes(model)
            free = [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]
            if root is not None and (root == "free-flyer") != bool(free):
                model = _rerooted(spec, free, path)
        except (ValueError, UnicodeError, mujoco.FatalError) as error:
            hint = "correct the file, or name the file that includes it"
            raise MjcfError(f"MuJoCo refuses it ({error})", where=str(path), hint=hint) from None
    _check_tree(model, path)
    couplings = _couplings(model, path)
    return MjcfFile(model, keyframes, couplings, (*notes, *_left_out(model)))


def object_name(model: Any, kind: str, index: int) -> str:
    """Return the name of a MuJoCo object, or its ``kind`` (``body``, ``joint``, …) and index if it has no name."""
    return getattr(model, kind)(index).name or f"{kind}{index}"


def drives_joint(model: Any, actuator: int) -> bool:
    """Return whether an actuator acts on one joint, not on a tendon, a site or a body."""
    kind, types = model.actuator_trntype[actuator], import_mujoco().mjtTrn
    return bool(kind == types.mjTRN_JOINT or kind == types.mjTRN_JOINTINPARENT)


def _compile(spec: Any, path: Path) -> tuple[Any, list[str]]:
    """Compile a spec without textures and sensors; if all inertias are stated, also without missing meshes."""
    for sensor in list(spec.sensors):  # Sensors of a robot may need geoms of its scene.
        spec.delete(sensor)
    for texture in spec.textures:
        texture.file, texture.cubefiles = "", [""] * 6
        texture.builtin, texture.width, texture.height = import_mujoco().mjtBuiltin.mjBUILTIN_FLAT, 1, 1
    assets, missing = [*spec.meshes, *spec.hfields], dict[str, str]()
    for asset in assets:
        file = _asset(spec, asset)
        if asset.file and not file.is_file():
            missing[asset.name] = asset.file
            if file.exists():
                raise MjcfError(f"mesh '{asset.file}' is not a file", where=str(path), hint="correct its path")
    try:
        return spec.compile(), []
    except ValueError:
        if not missing:
            raise
    for geom in list(spec.geoms):
        if not (name := missing.get(geom.meshname) or missing.get(geom.hfieldname)):
            continue
        body = geom.parent
        if body.name != "world" and not (body.explicitinertial and spec.compiler.inertiafromgeom != _FROM_GEOMS):
            fault = f"no mesh '{name}', and body '{body.name}' takes its inertia from the mesh"
            raise MjcfError(fault, where=str(path), hint="add the mesh file, or state <inertial>")
        spec.delete(geom)
    for part in (*(asset for asset in assets if asset.name in missing), *spec.skins):
        spec.delete(part)
    files = listed([f"'{file}'" for file in sorted(missing.values())], 1)
    return spec.compile(), [f"no mesh {files}: their shapes are left out; the file states all inertias"]


def _asset(spec: Any, asset: Any) -> Path:
    name = Path(asset.file).name if spec.strippath else asset.file
    return Path(spec.modelfiledir, (asset.compiler or spec.compiler).meshdir, name)


def _keyframes(model: Any) -> dict[str, dict[str, Array]]:
    ends = np.append(model.jnt_qposadr, model.nq)
    joints = {object_name(model, "joint", j): slice(ends[j], ends[j + 1]) for j in range(model.njnt)}
    return {
        object_name(model, "key", k): {name: np.array(model.key_qpos[k][at]) for name, at in joints.items()}
        for k in range(model.nkey)
    }


def _rerooted(spec: Any, free: list[Any], path: Path) -> Any:
    """Compile a spec without its free joints, or with a free joint at the only body that is on the world."""
    if free:
        for joint in free:
            spec.delete(joint)
    else:
        bodies = list(spec.worldbody.bodies)
        if len(bodies) != 1 or list(bodies[0].joints):
            fault = f"root free-flyer needs one body on the world that does not move, not {len(bodies)}"
            if len(bodies) == 1:
                fault = f"root free-flyer does not fit, because joints move body '{bodies[0].name}' in the world"
            raise MjcfError(fault, where=str(path), hint="leave `root` out, or write a <freejoint/> into the file")
        bodies[0].add_freejoint()
    for key in list(spec.keys):
        spec.delete(key)
    return spec.compile()


def is_floating(model: Any) -> bool:
    """Return whether the first joint of an ``MjModel`` is free."""
    return bool(model.njnt and model.jnt_type[0] == import_mujoco().mjtJoint.mjJNT_FREE)


def _check_tree(model: Any, path: Path) -> None:
    """Raise an error for models without joints, with flexible bodies, or with several floating bodies."""
    if not model.nv:
        raise MjcfError("has no movable joint", where=str(path), hint="use `root` free-flyer or another file")
    if model.nv > MOST_DEGREES_OF_FREEDOM:
        fault = f"has {model.nv} degrees of freedom, more than the supported {MOST_DEGREES_OF_FREEDOM}"
        raise MjcfError(fault, where=str(path), hint="remove the joints that hardly matter in a copy of the file")
    if model.nflex:
        raise MjcfError("has flexible bodies", where=str(path), hint="remove the <flexcomp> in a copy of the file")
    heavy = np.flatnonzero(~np.isfinite(np.c_[model.body_mass, model.body_inertia]).all(axis=1))
    if heavy.size:
        fault = f"body '{object_name(model, 'body', int(heavy[0]))}' has an infinite mass or inertia"
        raise MjcfError(fault, where=str(path), hint="correct the mass or the size of its geoms")
    for key in (*_NUMBERS, *_RANGES):
        values = model.opt.gravity if key == "gravity" else getattr(model, key)
        if not (np.isfinite(values) if key in _NUMBERS else ~np.isnan(values)).all():
            fault = f"its {key.replace('_', ' ')} is not finite"
            raise MjcfError(fault, where=str(path), hint="correct the nan or inf in the file")
        if key.endswith("_pos") and (np.abs(values) > FARTHEST).any():
            fault = f"its {key.replace('_', ' ')} has a coordinate of {np.abs(values).max():g} m"
            raise MjcfError(fault, where=str(path), hint=f"give coordinates up to {FARTHEST:g} m")
    free = np.flatnonzero(model.jnt_type == import_mujoco().mjtJoint.mjJNT_FREE)
    if free.size and (free.size > 1 or free[0]):
        name = object_name(model, "body", int(model.jnt_bodyid[free[-1]]))
        fault = f"body '{name}' floats in addition to the robot"
        hint = "remove the body in a copy of the file, put the robot first, or name the file without the scene"
        raise MjcfError(fault, where=str(path), hint=hint)


def _tendon_terms(model: Any, k: int) -> dict[int, float]:
    """Return joint → factor ``c`` for a tendon equality ``Σ c (q − q⁰) = a₀`` of up to two joints; else empty."""
    mujoco, terms = import_mujoco(), dict[int, float]()
    curved = model.eq_obj2id[k] >= 0 and model.eq_data[k, 2:5].any()
    if curved or not model.eq_type[k] == mujoco.mjtEq.mjEQ_TENDON:
        return {}
    for tendon, scale in ((model.eq_obj1id[k], 1.0), (model.eq_obj2id[k], -model.eq_data[k, 1])):
        for w in range(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon] * (tendon >= 0)):
            if not model.wrap_type[w] == mujoco.mjtWrap.mjWRAP_JOINT:
                return {}
            j = int(model.wrap_objid[w])
            terms[j] = terms.get(j, 0.0) + scale * float(model.wrap_prm[w])
    terms = {j: c for j, c in terms.items() if c}
    return terms if len(terms) < 3 else {}


def _couplings(model: Any, path: Path) -> tuple[JointCoupling, ...]:
    """Return the couplings by equality constraints; raise an error for loops, polynomials and more than two joints.

    The constraint is ``q − q⁰ = a₀ + a₁ (q' − q'⁰) + …`` with the positions ``q⁰``, ``q'⁰`` in ``qpos0``.  A joint
    that a constraint holds at a constant position gets equal limits.
    """
    mujoco, couplings, followers = import_mujoco(), dict[str, JointCoupling](), set[int]()
    for k in map(int, np.flatnonzero(model.eq_active0)):
        if model.eq_type[k] == mujoco.mjtEq.mjEQ_JOINT:
            first, second = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
            constant, ratio, *curved = model.eq_data[k, :5]
        elif terms := _tendon_terms(model, k):
            first, second, *_ = *sorted(terms, key=lambda j: j in followers), -1
            constant, ratio, curved = model.eq_data[k, 0] / terms[first], -terms.get(second, 0.0) / terms[first], []
        else:
            kind = mujoco.mjtEq(int(model.eq_type[k])).name.removeprefix("mjEQ_").lower()
            what = "couples more than two joints" if kind == "tendon" else "closes a kinematic loop"
            fault = f"equality '{object_name(model, 'equality', k)}' ({kind}) {what}, which is not supported"
            hint = "if the equality hardly matters, remove it in a copy of the file and `lock` the guided joints"
            raise MjcfError(fault, where=str(path), hint=hint)
        followers.add(first)
        name, start = object_name(model, "joint", first), model.qpos0[model.jnt_qposadr[first]]
        if name in couplings:
            raise MjcfError(f"joint '{name}' follows two joints", where=str(path), hint="remove one")
        if second < 0 or not (ratio or any(curved)):
            model.jnt_limited[first], model.jnt_range[first] = 1, start + constant
        elif any(curved):
            hint = "make the coupling linear in a copy of the file, or remove it and `lock` the joint"
            raise MjcfError(f"joint '{name}' follows another by a polynomial", where=str(path), hint=hint)
        else:
            offset = start + constant - ratio * model.qpos0[model.jnt_qposadr[second]]
            couplings[name] = JointCoupling(name, object_name(model, "joint", second), float(ratio), float(offset))
    for name in _coupling_armatures(model):
        hint = "remove its armature in a copy of the file, or move it to the joints"
        raise MjcfError(f"the armature of {name} couples joints", where=str(path), hint=hint)
    return composed(couplings, str(path))


def _coupling_armatures(model: Any) -> Iterator[str]:
    types = import_mujoco().mjtJoint
    for t in np.flatnonzero(model.tendon_armature):
        yield f"tendon '{object_name(model, 'tendon', int(t))}'"
    for a in np.flatnonzero(model.actuator_armature):
        kind = model.jnt_type[model.actuator_trnid[a, 0]] if drives_joint(model, int(a)) else None
        if not (kind == types.mjJNT_SLIDE or kind == types.mjJNT_HINGE):
            yield f"actuator '{object_name(model, 'actuator', int(a))}'"


def _left_out(model: Any) -> Iterator[str]:
    """Yield a line that names and counts the contents of the file that the impact model ignores, if any."""
    mujoco = import_mujoco()
    balls = (model.jnt_type == mujoco.mjtJoint.mjJNT_BALL) & (model.jnt_limited > 0)
    tendons = (model.tendon_stiffness > 0) | (model.tendon_limited > 0) | (model.tendon_damping > 0)
    counts = {
        "armature of the free joint": np.count_nonzero(model.dof_armature[:6]) * is_floating(model),
        "damping": np.count_nonzero(model.dof_damping),
        "friction loss": np.count_nonzero(model.dof_frictionloss),
        "springs": np.count_nonzero(model.jnt_stiffness),
        "limits of ball joints": np.count_nonzero(balls),
        "limits and springs of tendons": np.count_nonzero(tendons),
        "gravity compensation": np.count_nonzero(model.body_gravcomp),
        "geoms of the world": int(model.body_geomnum[0]) * is_floating(model),
    }
    parts = [f"{what} ({count})" for what, count in counts.items() if count]
    if parts:
        yield f"the model of an impact leaves out these parts of the MJCF: {', '.join(parts)}"
