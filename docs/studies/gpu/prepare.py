"""Write the cases of the GPU study into a folder: ``python -m docs.studies.gpu.prepare FOLDER``.

The folder contains exports, samples with reference values, and the programs that ``run.py`` needs.  The folder can be
copied to a machine with a GPU.
"""

from __future__ import annotations

import json
import shutil
import sys
import xml.etree.ElementTree as ET
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from impact_posture.codegen.c_literals import DOUBLE, REALS
from impact_posture.codegen.export import export
from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import load_robot
from impact_posture.robot.urdf import resolve_path

# Name of a case → robot, and whether its feet stay.
ROBOTS = {
    "tilthex_arm": ("tilthex_arm", False), "panda": ("panda", False), "solo8": ("solo8", True),
    "talos": ("talos", True), "talos_free": ("talos", False),
}  # fmt: skip
# Cases that frax computes too, and cases that CuPy, PyTorch and JAX call.
_FRAX, _CALLED = ("panda", "talos"), ("panda", "talos_free")
_SAMPLES = 2048
_ROWS = 1 << 20
_PROGRAMS = ("run.py", "bench.cu", "cores.c", "frax_peer.py", "framework_peer.py")


def objective_of(robot: Robot, feet: bool) -> WorstCaseObjective:
    """Return the objective H at the default contact of the robot."""
    contact = ImpactContact(robot.spec.contact.frame, (0.0, 0.0, 1.0), robot.spec.contact.offset)
    return WorstCaseObjective(robot, contact, supports=robot.spec.supports if feet else ())


def write_samples(gradient: ImpactGradient, robot: Robot, path: Path) -> None:
    """Write random postures and normals, and H and ∇H of the C export: three sizes, then one row for each sample."""
    rng, start = np.random.default_rng(0), robot.posture()
    steps = rng.uniform(-1.0, 1.0, (_SAMPLES, robot.nv))
    steps[:, : robot.first_joint] *= np.pi / 2
    q = np.array([pin.integrate(robot.model, start, step) for step in steps])
    n = rng.normal(size=(_SAMPLES, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    H, grad = gradient.value_and_gradient_batch(q, n)
    with path.open("wb") as file:
        np.array([_SAMPLES, robot.nq, robot.nv], dtype=np.int32).tofile(file)
        np.hstack([q, n, H[:, None], grad]).tofile(file)


def write_urdf(robot: Robot, path: Path) -> None:
    """Write the URDF of a robot without shapes, because frax would search their meshes."""
    tree = ET.parse(resolve_path(robot.source, Path()))
    for link in tree.getroot().iter("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)
    tree.write(path)


def prepare(folder: Path) -> list[dict[str, Any]]:
    """Write all cases into a folder, and return the content of ``cases.json``."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in _PROGRAMS:
        shutil.copy(Path(__file__).with_name(name), folder / name)
    for package in ("impact_posture", "frax"):
        if (spec := find_spec(package)) is not None and spec.origin is not None:
            ignore = shutil.ignore_patterns("__pycache__")
            shutil.copytree(Path(spec.origin).parent, folder / package, ignore=ignore, dirs_exist_ok=True)
    cases = []
    for name, (source, feet) in ROBOTS.items():
        robot = load_robot(source)
        samples, urdf = f"{name}.samples", f"{name}.urdf"
        if name in _FRAX:
            write_urdf(robot, folder / urdf)
        for real in REALS.values():
            if feet and real is not DOUBLE:
                continue
            out = folder / f"{name}-{real.name}"
            out.mkdir(exist_ok=True)
            export(objective_of(robot, feet), out, prefix=name, real=real, cuda=True, check=False, force=True)
            # Build the library, which the calls from Python load.
            gradient = ImpactGradient.load(out)
            if real is DOUBLE:
                write_samples(gradient, robot, folder / samples)
            cases.append({
                "name": name, "real": real.name, "prefix": name, "header": f"{out.name}/{name}.cuh",
                "samples": samples, "rows": _ROWS // (4 if robot.nv > 20 else 1), "threads": 128, "nq": robot.nq,
                "nv": robot.nv, "urdf": urdf, "root": robot.spec.model.root, "frax": name in _FRAX and real is DOUBLE,
                "frameworks": name in _CALLED,
            })  # fmt: skip
    (folder / "cases.json").write_text(json.dumps(cases, indent=1), encoding="utf-8")
    return cases


if __name__ == "__main__":
    prepare(Path(sys.argv[1]))
