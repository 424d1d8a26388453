"""Read a URDF into a ``pin.Model`` without its meshes."""

from __future__ import annotations

import codecs
import contextlib
import os
import re
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from functools import cache
from importlib.resources import files
from pathlib import Path
from xml.parsers import expat

import pinocchio as pin

from impact_posture.config.text_parsers import finite_numbers
from impact_posture.errors import PackageNotFound, SpecError, UrdfError
from impact_posture.robot.inertia_checks import check_inertias
from impact_posture.robot.joint_coupling import JointCoupling, urdf_couplings
from impact_posture.robot.urdf_joints import clear_negative_limits, correct_joints
from impact_posture.system.text_files import read_bytes

# pin.Data always contains 6 nv³ numbers.  These numbers take 0.4 GB for 200 degrees of freedom, and 48 GB for 1,000.
MOST_DEGREES_OF_FREEDOM = 200
# Largest coordinate of an origin, m.  Doubles do not resolve micrometers at greater distances, and hulls fail there.
FARTHEST = 1e10
# Largest number of joints in a chain, including fixed joints.  Above 2,000, the URDF parser overflows the stack.
_DEEPEST = 1_000
# A comment.  A comment may contain "--", which XML forbids and urdfdom accepts.  A comment that does not end reaches
# to the end of the file.
_COMMENT = re.compile(r"<!--.*?(?:-->|\Z)", re.DOTALL)
# An ampersand that does not begin an entity.  XML forbids this ampersand, and urdfdom accepts it.
_LONE_AMPERSAND = re.compile(r"&(?!(?:amp|lt|gt|quot|apos|#\d+|#x[\da-fA-F]+);)")

EXAMPLE_PREFIX = "example-robot-data:"


@cache
def example_robot_data() -> Path:
    """Return the folder ``robots/`` of example-robot-data; raise ``PackageNotFound`` without this package."""
    from importlib.metadata import PackageNotFoundError
    from importlib.metadata import files as dist_files

    try:
        listed = dist_files("example-robot-data") or []
    except PackageNotFoundError:
        listed = []
    for entry in listed:
        parts = entry.parts
        if "example-robot-data" in parts and "robots" in parts:
            return Path(str(entry.locate())).parents[len(parts) - parts.index("robots") - 2]
    raise PackageNotFound("example-robot-data", [], hint="pip install example-robot-data")


def robots_data() -> Path:
    """Return the folder of the robot descriptions that ship with this project."""
    return Path(str(files("impact_posture_robots")))


def resolve_path(text: str, base: Path) -> Path:
    """Return the absolute path for a path in robot.toml.

    ``text`` is ``example-robot-data:<path below robots/>``, an absolute path, or a path relative to ``base``.

    Raises:
        PackageNotFound: The package example-robot-data has no such file.
        SpecError: The path contains a null character.
    """
    if "\0" in text:
        raise SpecError(f"'{text}' is not a path", where="robot.toml [model]", hint="remove the null character")
    if not text.startswith(EXAMPLE_PREFIX):
        return (base / Path(text).expanduser()).resolve()
    root = example_robot_data()
    path = root / text.removeprefix(EXAMPLE_PREFIX)
    if not os.path.isfile(path):
        known = example_models(path.suffix)
        raise PackageNotFound(text.removeprefix(EXAMPLE_PREFIX), known, where=EXAMPLE_PREFIX.rstrip(":"))
    return path


def example_models(suffix: str = ".urdf") -> list[str]:
    """Return the paths of models below the ``robots/`` folder of example-robot-data, sorted."""
    root = example_robot_data()
    return [p.relative_to(root).as_posix() for p in sorted(root.rglob("*.[us]rdf")) if str(p).endswith(suffix)]


def build_model(
    path: Path, *, free_flyer: bool, accept_inertias: bool = False
) -> tuple[pin.Model, tuple[str, ...], tuple[JointCoupling, ...]]:
    """Parse a URDF without its meshes; return the model, warnings, and the couplings of its joints.

    ``free_flyer`` adds a free-flyer joint before the root link.  With ``accept_inertias``, impossible inertias are
    warnings instead of errors.

    Raises:
        UrdfError: The file is missing or is not a URDF, Pinocchio rejects it, or it has too many joints.
        InertiaError: A link has an impossible mass or inertia.
    """
    text, root = _read(path)
    _check_depth(root, path)
    _check_origins(root, path)
    below_zero = clear_negative_limits(root)
    couplings, lost = urdf_couplings(root, str(path))
    try:
        with quiet_stderr() as errors:
            # Parse the decoded text instead of the file, because urdfdom reads each file as UTF-8.
            text = ET.tostring(root, encoding="unicode") if below_zero or couplings else text
            model = pin.buildModelFromXML(text, *([pin.JointModelFreeFlyer()] if free_flyer else []))
    except OSError:  # No file descriptor is left for quiet_stderr().
        raise
    except Exception as error:  # The type of exception differs between versions of Pinocchio.
        fault = f"makes no robot ({errors[0] or error})"
        raise UrdfError(fault, where=str(path), hint="correct the URDF") from None
    if model.nv == 0:
        raise UrdfError("has no movable joint", where=str(path), hint="use `root` free-flyer or another URDF")
    first = 2 if free_flyer else 1
    if model.njoints > first and model.joints[first].shortname() == "JointModelFreeFlyer":
        fault = f"its first joint, '{model.names[first]}', is floating"
        hint = "remove that joint with its parent link, and use `root` free-flyer"
        raise UrdfError(fault, where=str(path), hint=hint)
    if model.nv > MOST_DEGREES_OF_FREEDOM:
        fault = f"has {model.nv} degrees of freedom, more than the supported {MOST_DEGREES_OF_FREEDOM}"
        raise UrdfError(fault, where=str(path), hint="in the URDF, fix the joints that hardly matter")
    checked = (*check_inertias(root, model, path, accept_inertias), *correct_joints(root, model, path))
    return model, (*checked, *lost, *below_zero), couplings


def _check_depth(root: ET.Element, path: Path) -> None:
    """Raise an error for deep trees and cycles, in which the URDF parser overflows the stack."""
    joints = [(joint.find("parent"), joint.find("child")) for joint in root.findall("joint")]
    parents = {c.get("link"): p.get("link") for p, c in joints if p is not None and c is not None}
    children: dict[str | None, list[str | None]] = {}
    for child, parent in parents.items():
        children.setdefault(parent, []).append(child)
    level, below = [link for link in children if link not in parents], set(parents)
    for _ in range(_DEEPEST):
        if not level:
            break
        level = [child for link in level for child in children.get(link, ())]
        below.difference_update(level)
    if any(link in children for link in level):
        hint = "in the URDF, fix the joints that hardly matter"
        raise UrdfError(f"has a chain of more than {_DEEPEST} joints", where=str(path), hint=hint)
    if below:
        link = next(link for link in parents if link in below)
        raise UrdfError(f"link '{link}' is below itself", where=str(path), hint="correct its joints")


def _check_origins(root: ET.Element, path: Path) -> None:
    """Raise an error if the origin of a joint, mass or shape is farther away than :data:`FARTHEST`."""
    for owner in (*root.findall("link"), *root.findall("joint")):
        for origin in owner.iter("origin"):
            xyz = origin.get("xyz", "")
            if any(abs(number) > FARTHEST for number in finite_numbers(xyz, 3)):
                fault = f"{owner.tag} '{owner.get('name', '?')}' has an origin at '{xyz}'"
                raise UrdfError(fault, where=str(path), hint=f"give coordinates in m, up to {FARTHEST:g}")


def parse_urdf(path: Path) -> ET.Element:
    """Return the root element of a URDF; see :func:`_read` for errors."""
    return _read(path)[1]


def _read(path: Path) -> tuple[str, ET.Element]:
    """Return the text of a URDF without comments, and its root element.

    The function accepts everything that urdfdom accepts: names with ``:``, any encoding, ``--`` in comments.

    Raises:
        UrdfError: The file is missing, is not a URDF, or contains expressions or elements of xacro.
    """
    if os.path.isdir(path):
        raise UrdfError("is a folder", where=str(path), hint="name the .urdf file in this folder")
    try:
        text = _xml_text(path)
        root = _parse_xml(text)
    except OSError as error:
        raise UrdfError.unreadable(path, error) from None
    except (expat.ExpatError, ValueError) as error:  # Path raises ValueError for a name with a null character.
        raise UrdfError(f"is not XML ({error})", where=str(path), hint="give a URDF file") from None
    if root.tag in ("mujoco", "mujocoinclude"):
        raise UrdfError("is an MJCF that MuJoCo cannot read", where=str(path), hint="save it as UTF-8")
    if root.tag != "robot":
        fault = f"is XML but not a URDF: its root is <{root.tag}>, not <robot>"
        raise UrdfError(fault, where=str(path), hint="expand xacro first, or give the .urdf")
    if root.find("link") is None:
        raise UrdfError("has no <link>", where=str(path), hint="expand xacro first, or give the .urdf")
    # Search the elements only if the text contains a sign of xacro, because this search takes longer.
    if ("$" in text or "<xacro:" in text) and (leftover := _xacro_leftover(root)):
        fault = f"contains {leftover}, which only xacro can evaluate"
        hint = "name the file .xacro"
        if leftover.startswith("<xacro:"):
            hint += ", or remove this element in a copy, if it adds no links"
        raise UrdfError(fault, where=str(path), hint=hint)
    return text, root


def read_srdf(path: Path) -> ET.Element:
    """Return the root element of an SRDF; raise ``UrdfError`` if the file cannot be read or is not XML."""
    try:
        return ET.fromstring(read_bytes(path))
    except (OSError, ET.ParseError) as error:
        raise UrdfError(f"is not an SRDF ({error})", where=str(path), hint="correct the SRDF") from None


def _parse_xml(text: str) -> ET.Element:
    """Parse XML without namespaces and without the text between tags, which have no meaning in a URDF."""
    builder, parser = ET.TreeBuilder(), expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    parser.Parse(text, True)
    return builder.close()


def _xml_text(path: Path) -> str:
    """Return a file as text without comments; most files are in UTF-8, whatever encoding they declare."""
    data = read_bytes(path)
    declared = re.match(rb"""\s*<\?xml[^>]*?encoding=["']([\w.:-]+)""", data)
    utf_16 = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    for encoding in ("utf-16" if utf_16 else "utf-8-sig", declared[1].decode() if declared else "", "latin-1"):
        with contextlib.suppress(UnicodeDecodeError, LookupError):
            text = data.decode(encoding)
            break
    text = _COMMENT.sub(lambda comment: "\n" * comment[0].count("\n"), text)
    return _LONE_AMPERSAND.sub("&amp;", text).strip()


def _xacro_leftover(root: ET.Element) -> str:
    """Return the first xacro element, or else the first number that is a xacro expression; else an empty text."""
    for element in root:
        if element.tag.startswith("xacro:"):
            return f"<{element.tag}>"
        for part in element.iter() if element.tag in ("link", "joint") else ():
            for key, value in part.items():
                if ("${" in value or "$(" in value) and key not in ("name", "link", "joint", "filename"):
                    return f"'{value}' in <{part.tag} {key}>"
    return ""


@contextlib.contextmanager
def quiet_stderr() -> Iterator[list[str]]:
    """Hide the error output of C++ libraries; after the block, the yielded list contains its first error line."""
    errors = [""]
    # Prefer a file in memory, because there may be no writable folder.
    in_memory = hasattr(os, "memfd_create")
    with os.fdopen(os.memfd_create("stderr"), "w+b") if in_memory else tempfile.TemporaryFile() as sink:
        saved = os.dup(2)
        os.dup2(sink.fileno(), 2)
        try:
            yield errors
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            sink.seek(0)
            lines = sink.read().decode(errors="replace").split("\n")
            errors[0] = next((line.strip() for line in lines if "rror" in line), "")
