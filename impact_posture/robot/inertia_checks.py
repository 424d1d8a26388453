"""Checks for impossible masses and inertias, and for singular mass matrices."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pinocchio as pin

from impact_posture.config.text_parsers import finite_numbers
from impact_posture.errors import InertiaError
from impact_posture.robot.model_joints import v_slice
from impact_posture.robot.robot import Robot

# A mass (kg) or moment of inertia (kg m²) below this value is treated as zero.
_TINY = 1e-10
# Products of entries of a mass matrix overflow if the entries are larger than this value.
_LARGEST = 1e100
# Relative violation of the triangle inequality that is treated as a rounding error.
_TRIANGLE_SLACK = 1e-3
# A mass matrix, scaled to unit diagonal, is singular if the smallest eigenvalue is below this fraction of the largest
# eigenvalue.  For all known robots, the ratio of the two is above 1e-3.
_SINGULAR = 1e-12


def check_inertias(root: ET.Element, model: pin.Model, path: Path, accept: bool) -> tuple[str, ...]:
    """Raise an error for links with impossible masses or inertias; return warnings.

    If ``accept`` is true, or if the fault is negligible compared with the inertia of the body that contains the link,
    a warning replaces the error.

    Raises:
        InertiaError: A mass is negative, a link without mass has moments, or moments break the triangle inequality.
    """
    where, warnings = str(path), []
    for link in root.findall("link"):
        fault = _link_fault(link, where)
        if fault is None:
            continue
        name = link.get("name", "?")
        frame = model.getFrameId(name, pin.FrameType.BODY)
        joint = model.frames[frame].parentJoint if frame < model.nframes else 0
        if joint == 0:  # The link is welded to the world.
            continue
        size, words = fault
        body = float(np.linalg.eigvalsh(model.inertias[joint].inertia)[-1])
        if size <= _TRIANGLE_SLACK * body:
            warnings.append(f"{words}; too small to matter in the inertia of its body")
        elif accept:
            warnings.append(f"{words}; accepted by robot.toml")
        else:
            raise InertiaError(
                words, where=where, hint="correct its <inertial>, or set accept_inertias = true in robot.toml [model]"
            )
    return tuple(warnings)


def massless_joints(model: pin.Model) -> tuple[str, ...]:
    """Return the joints without armature whose whole subtree has neither mass nor rotational inertia."""
    moved = np.array([max(i.mass, float(np.abs(i.inertia).max())) for i in model.inertias])
    massless: list[str] = []
    for joint in range(model.njoints - 1, 0, -1):
        armature = np.asarray(model.armature)[v_slice(model, joint)]
        if moved[joint] <= _TINY and not (armature > 0).all():
            massless.insert(0, str(model.names[joint]))
        moved[model.parents[joint]] += moved[joint]
    return tuple(massless)


def check_any_mass(model: pin.Model, where: str) -> None:
    """Raise ``InertiaError`` if no joint moves any mass, as in a URDF for kinematics only."""
    if len(massless_joints(model)) == model.njoints - 1:
        fault = "no link that moves has a mass, so this model is for kinematics only"
        hint = "give each moving link its <inertial> (mass, center of mass, inertia), which dynamics needs"
        raise InertiaError(fault, where=where, hint=hint)


def check_moved_mass(model: pin.Model, where: str) -> None:
    """Raise ``InertiaError`` if joints move no mass, because the mass matrix would be singular."""
    if not (joints := massless_joints(model)):
        return
    named = ", ".join(f"'{name}'" for name in joints)
    single = len(joints) == 1
    raise InertiaError(
        f"joint {named} moves no mass" if single else f"{len(joints)} joints move no mass: {named}",
        where=where,
        hint=f"give {'its' if single else 'their'} links a mass, or make {'it' if single else 'them'} rigid by "
        "`lock_massless` (robot.toml [model] lock_massless = true)",
    )


def check_mass_matrix(robot: Robot, where: str) -> None:
    """Raise an error if the mass matrix is singular at the default posture.

    Possible causes are a massless floating base, a rotating point mass, or two joints about the same axis.  ``M`` is
    first scaled to a unit diagonal, so that kg and kg m² can be compared.

    Raises:
        InertiaError: The matrix is not finite, or singular; the message names the directions that move no inertia.
    """
    model = robot.model
    upper = np.triu(pin.crba(model, model.createData(), robot.posture()))
    moving = np.isfinite(model.armature)
    M, C = (matrix[np.ix_(moving, moving)] for matrix in (upper + np.triu(upper, 1).T, robot.coupling_matrix))
    diagonal = np.diag(M)
    with np.errstate(over="ignore", invalid="ignore"):
        largest = max(float(np.abs(matrix).max()) for matrix in (M, C.T @ M @ C))
    if not largest <= _LARGEST:
        fault = f"the mass matrix has infinite or huge entries at posture '{robot.default_posture}'"
        hint = "correct the masses, inertias, lengths and `armature`; the units are kg, kg m² and m"
        raise InertiaError(fault, where=where, hint=hint)
    free = diagonal <= _TINY
    if not free.any():
        scale = 1 / np.sqrt(diagonal)
        values, vectors = np.linalg.eigh(M * np.outer(scale, scale))
        if values[0] >= _SINGULAR * values[-1]:
            return
        # The eigenvector of the least eigenvalue, scaled to joint velocities, is the motion that meets no inertia.
        motion = np.abs(scale * vectors[:, 0])
        free = motion >= 0.1 * motion.max()
    names = [name for name, moves in zip(robot.tangent_names, moving, strict=True) if moves]
    named = [name for name, moves in zip(names, free, strict=True) if moves]
    verb = "moves no inertia" if len(named) == 1 else "move no inertia together"
    fault = f"the mass matrix is singular at posture '{robot.default_posture}': {', '.join(named)} {verb}"
    hint = "give the links mass and rotational inertia, give the joints `armature`, or `lock` one of these joints"
    raise InertiaError(fault, where=where, hint=hint)


def _link_fault(link: ET.Element, where: str) -> tuple[float, str] | None:
    """Return the fault in the inertia of a link: its size (kg m²) and its description; ``None`` without a fault."""
    inertial, name = link.find("inertial"), link.get("name", "?")
    if inertial is None:
        return None
    mass_tag, inertia_tag = inertial.find("mass"), inertial.find("inertia")
    if mass_tag is None:
        raise InertiaError(f"link '{name}' has an <inertial> without <mass>", where=where, hint="add its mass")
    (mass,) = _numbers(mass_tag, "value", name, where)
    # urdfdom drops the whole <inertial> if its origin or a moment cannot be read.
    if (origin := inertial.find("origin")) is not None:
        for key in sorted({"xyz", "rpy"}.intersection(origin.keys())):
            _numbers(origin, key, name, where, 3)
    if mass < 0:
        raise InertiaError(f"link '{name}' has the mass {mass:g} kg", where=where, hint="give a positive mass")
    if inertia_tag is None:
        return None
    xx, xy, xz, yy, yz, zz = (
        _numbers(inertia_tag, key, name, where)[0] for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    )
    moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    largest = float(np.abs(moments).max())
    if largest <= _TINY:
        return None
    if mass <= _TINY:
        return largest, f"link '{name}' has no mass but rotational inertia"
    if moments[0] < -_TRIANGLE_SLACK * largest:
        return -float(moments[0]), f"link '{name}' has a negative principal moment of inertia ({moments[0]:g} kg m²)"
    excess = float(moments[2] - moments[0] - moments[1])
    if excess > _TRIANGLE_SLACK * largest:
        listed = ", ".join(f"{m:.4g}" for m in moments)
        return excess, f"link '{name}' breaks the triangle inequality (principal moments {listed} kg m²)"
    return None


def _numbers(tag: ET.Element, key: str, link: str, where: str, count: int = 1) -> list[float]:
    text = tag.get(key, "")
    if not (values := finite_numbers(text, count)):
        fault = f"link '{link}': {tag.tag} {key}='{text}' is not {'a number' if count == 1 else f'{count} numbers'}"
        raise InertiaError(fault, where=where, hint="correct it")
    return values
