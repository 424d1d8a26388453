"""Read a URDF into a ``pin.Model``, meshes or not, and say plainly what is wrong with one that cannot be."""

from __future__ import annotations

import contextlib
import os
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path

import numpy as np
import pinocchio as pin

from impact_posture.errors import InertiaError, PackageNotFound, UrdfError

EXAMPLE_PREFIX = "example-robot-data:"
# Below _TINY a mass (kg) or a moment (kg m²) counts as zero; a relative fault below the slack is rounding.
_TINY = 1e-10
_TRIANGLE_SLACK = 1e-3


def example_robot_data() -> Path:
    """Return the ``robots/`` folder of the installed example-robot-data package.

    Raises:
        PackageNotFound: The package is not installed or is laid out otherwise.
    """
    from importlib.metadata import PackageNotFoundError
    from importlib.metadata import files as dist_files

    try:
        listed = dist_files("example-robot-data") or []
    except PackageNotFoundError:
        listed = []
    for entry in listed:
        parts = entry.parts
        if "example-robot-data" in parts and "robots" in parts:
            root = Path(*parts[: parts.index("robots") + 1])
            located = Path(str(entry.locate()))
            return located.parents[len(parts) - len(root.parts) - 1]
    raise PackageNotFound("example-robot-data", [], mend="pip install example-robot-data")


def robots_data() -> Path:
    """Return the folder with this project's own robot descriptions."""
    return Path(str(files("impact_posture_robots")))


def resolve_path(text: str, base: Path) -> Path:
    """Turn a path of robot.toml into a file: ``example-robot-data:<below robots/>``, absolute, or relative to ``base``."""
    if not text.startswith(EXAMPLE_PREFIX):
        return (base / Path(text).expanduser()).resolve()
    root = example_robot_data()
    path = root / text.removeprefix(EXAMPLE_PREFIX)
    if not path.is_file():
        known = [p.relative_to(root).as_posix() for p in sorted(root.rglob("*.[us]rdf"))]
        suffix = path.suffix
        raise PackageNotFound(
            text.removeprefix(EXAMPLE_PREFIX), [k for k in known if k.endswith(suffix)], where=EXAMPLE_PREFIX.rstrip(":")
        )
    return path


def build_model(path: Path, *, free_flyer: bool, accept_inertias: bool = False) -> tuple[pin.Model, tuple[str, ...]]:
    """Parse the URDF at ``path``; no mesh is opened.  Returns the model and warnings about its links.

    Args:
        path: The URDF.
        free_flyer: Put a free-flyer joint between the world and the root link.
        accept_inertias: Turn refusals of impossible inertias into warnings.

    Raises:
        UrdfError: Missing file, not XML, not a URDF, or a tree that Pinocchio rejects.
        InertiaError: A mass or inertia that no rigid body has.
    """
    root = _parse(path)
    try:
        with _quiet_stderr() as words:
            if free_flyer:
                model = pin.buildModelFromUrdf(str(path), pin.JointModelFreeFlyer())
            else:
                model = pin.buildModelFromUrdf(str(path))
    except Exception as error:  # Pinocchio raises ValueError, RuntimeError or IndexError by version and fault.
        said = words[0] or str(error)
        raise UrdfError(f"makes no robot ({said})", where=str(path), mend="correct the URDF") from None
    if model.nv == 0:
        raise UrdfError("has no movable joint", where=str(path), mend="use --root free-flyer or another URDF")
    return model, _check_inertias(root, model, path, accept_inertias)


def _parse(path: Path) -> ET.Element:
    if path.is_dir():
        raise UrdfError("is a folder", where=str(path), mend="name the .urdf file in it")
    try:
        root = ET.parse(path).getroot()
    except FileNotFoundError:
        raise UrdfError("no such file", where=str(path), mend="check the path") from None
    except OSError as error:
        raise UrdfError(f"cannot be read ({error.strerror})", where=str(path), mend="check the file") from None
    except (ET.ParseError, UnicodeDecodeError) as error:
        raise UrdfError(f"is not XML ({error})", where=str(path), mend="give a URDF file") from None
    if root.tag != "robot":
        raise UrdfError(
            f"is XML but not a URDF: its root is <{root.tag}>, not <robot>",
            where=str(path),
            mend="expand xacro first, or give the .urdf",
        )
    if root.find("link") is None:
        raise UrdfError("has no <link>", where=str(path), mend="expand xacro first, or give the .urdf")
    return root


def _check_inertias(root: ET.Element, model: pin.Model, path: Path, accept: bool) -> tuple[str, ...]:
    """Refuse impossible inertias; a fault too small to matter in the body it is lumped into is a warning."""
    where, warnings = str(path), []
    for link in root.iter("link"):
        fault = _link_fault(link, where)
        if fault is None:
            continue
        name = link.get("name", "?")
        frame = model.getFrameId(name, pin.FrameType.BODY)
        joint = model.frames[frame].parentJoint if frame < model.nframes else 0
        if joint == 0:
            continue  # welded to the world: it never moves
        size, words = fault
        body = float(np.linalg.eigvalsh(model.inertias[joint].inertia)[-1])
        if size <= _TRIANGLE_SLACK * body:
            warnings.append(f"{words}; too small to matter in the body it belongs to")
        elif accept:
            warnings.append(f"{words}; accepted as robot.toml asks")
        else:
            raise InertiaError(
                words, where=where, mend="correct its <inertial>, or set accept_inertias = true in robot.toml [model]"
            )
    return tuple(warnings)


def check_moved_mass(model: pin.Model, where: str) -> None:
    """Refuse a joint that moves nothing: the mass matrix would be singular.

    Raises:
        InertiaError: A joint without armature whose whole subtree has neither mass nor rotational inertia.
    """
    moved = np.array([max(i.mass, float(np.abs(i.inertia).max())) for i in model.inertias])
    for joint in range(model.njoints - 1, 0, -1):
        first = model.idx_vs[joint]
        armature = np.asarray(model.armature)[first : first + model.nvs[joint]]
        if moved[joint] <= _TINY and not (armature > 0).all():
            raise InertiaError(
                f"joint '{model.names[joint]}' moves no mass", where=where, mend="give its links a mass or --lock it"
            )
        moved[model.parents[joint]] += moved[joint]


def _link_fault(link: ET.Element, where: str) -> tuple[float, str] | None:
    """Return how far, in kg m², a link's inertia is from a possible one, and the fault in words."""
    inertial, name = link.find("inertial"), link.get("name", "?")
    if inertial is None:
        return None
    mass_tag, inertia_tag = inertial.find("mass"), inertial.find("inertia")
    if mass_tag is None:
        raise InertiaError(f"link '{name}' has an <inertial> without <mass>", where=where, mend="add its mass")
    mass = _number(mass_tag, "value", name, where)
    if mass < 0:
        raise InertiaError(f"link '{name}' has the mass {mass:g} kg", where=where, mend="give a positive mass")
    if inertia_tag is None:
        return None
    xx, xy, xz, yy, yz, zz = (
        _number(inertia_tag, key, name, where) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
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


def _number(tag: ET.Element, key: str, link: str, where: str) -> float:
    text = tag.get(key, "0")
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise InertiaError(f"link '{link}': {tag.tag} {key}='{text}' is no number", where=where, mend="correct it")
    return value


@contextlib.contextmanager
def _quiet_stderr() -> Iterator[list[str]]:
    """Keep the URDF parser's own words off the terminal; hand back the first line of them."""
    words = [""]
    with tempfile.TemporaryFile() as sink:
        saved = os.dup(2)
        os.dup2(sink.fileno(), 2)
        try:
            yield words
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            sink.seek(0)
            lines = sink.read().decode(errors="replace").split("\n")
            words[0] = next((line.strip() for line in lines if "rror" in line), "")
