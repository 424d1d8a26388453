"""Exported controllers for tests, each built once per run, without compiler optimization to save time."""

from __future__ import annotations

import os
import subprocess
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.codegen.manifest_reader import read_manifest
from impact_posture.controller_export.compiled_controller import CompiledController
from impact_posture.controller_export.default_formulation import ControllerKind, default_formulation
from impact_posture.controller_export.export_controller import export_controller
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import load_robot
from impact_posture.system.arrays import Array
from impact_posture.system.libraries import library_path, load_library
from impact_posture.tsid.flow.reference_flow_posture import ReferenceFlowPosture
from impact_posture.tsid.task_formulation import TaskFormulation
from tests.support.daqp import sources_or_skip
from tests.support.tools import need_compiler

KINDS: dict[str, ControllerKind] = {
    "tilthex_arm": "aerial", "hextilt": "aerial", "panda": "arm",
    "solo8": "legged", "talos": "legged", "g1": "legged",
}  # fmt: skip
ABUSE = Path(__file__).with_name("controller_abuse.c")
_KEPT = TemporaryDirectory()


def exported(
    name: str, objective: WorstCaseObjective | None = None, flags: str = "-O0", path: tuple[float, ...] | None = None
) -> Path:
    """Return the folder of a robot's controller with default gains and a library.

    Args:
        objective: Objective whose gradient the posture task follows.
        flags: Flags for the compiler.
        path: Posture that the reference flow visits first; empty for a controller without a flow.
    """
    sources_or_skip()
    return _exported(name, objective, flags, path)


@cache
def _exported(name: str, objective: WorstCaseObjective | None, flags: str, path: tuple[float, ...] | None) -> Path:
    out = Path(_KEPT.name) / f"{name}-{len(os.listdir(_KEPT.name))}"
    robot = load_robot(name)
    formulation = default_formulation(robot, KINDS[name], objective, flow=path is not None)
    if path:
        flow = formulation.posture
        assert isinstance(flow, ReferenceFlowPosture)
        flow._path = [np.array(path)]
    sources = os.environ.get("DAQP_SOURCES")
    daqp = Path(sources) if sources else None
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CFLAGS", flags)
        export_controller(robot, formulation, out, objective=objective, prefix="ctl", daqp=daqp, build=True)
    return out


def abuse_program(folder: Path, out: Path) -> Path:
    """Return a program that misuses the controller library (:data:`ABUSE`)."""
    library, program = library_path(folder, "ctl"), out / "abuse"
    command = [*need_compiler(), "-std=gnu99", "-O1", f"-I{folder}", str(ABUSE), str(library), "-o", str(program)]
    subprocess.run([*command, f"-Wl,-rpath,{folder}", "-lm", "-lpthread"], check=True)
    return program


def formulation_of(name: str) -> tuple[Robot, TaskFormulation]:
    """Return a robot and its formulation with default gains."""
    robot = load_robot(name)
    return robot, default_formulation(robot, KINDS[name])


def compiled(name: str, objective: WorstCaseObjective | None = None) -> CompiledController:
    return CompiledController.load(exported(name, objective), robot=load_robot(name))


def gradient_beside(name: str, objective: WorstCaseObjective) -> ImpactGradient:
    """Return the gradient that the controller library contains."""
    folder = exported(name, objective)
    return ImpactGradient(load_library(library_path(folder, "ctl")), read_manifest(folder / "ctl_metric.json")[0])


def impact_of(robot: Robot, frame: str, normal: tuple[float, float, float]) -> WorstCaseObjective:
    """Return the default objective of an impact."""
    return WorstCaseObjective(robot, ImpactContact(frame, normal))


def random_state(robot: Robot, rng: np.random.Generator, size: float) -> tuple[Array, Array]:
    """Return a random state near the default posture."""
    q = np.asarray(pin.integrate(robot.model, robot.posture(), size * rng.normal(size=robot.nv)))
    return q, size * rng.normal(size=robot.nv)
