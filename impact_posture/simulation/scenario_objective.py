"""Objective of the impact of a scenario, and its gradient."""

from __future__ import annotations

import fcntl
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np

from impact_posture.codegen.export import write_export
from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.config.problem_settings import ObjectiveKind
from impact_posture.errors import MetricError, OutputError
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.metric import Metric
from impact_posture.impact.supports import resolve_supports
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.simulation.setup import Setup
from impact_posture.system.arrays import Array
from impact_posture.system.libraries import cache_folder, is_cached, library_path, source_key
from impact_posture.system.progress import tell
from impact_posture.system.toolchain import require_compiler

Gradient = Callable[[Array], tuple[float, Array]]


def scenario_objective(setup: Setup, kind: ObjectiveKind = "impulse", *, free: bool = False) -> WorstCaseObjective:
    """Return the objective for the impact of a scenario.

    With ``free``, the objective ignores the contacts at the feet of a standing robot.  A robot that falls has no
    supports, and its feet are the contacts.
    """
    scenario, robot = setup.scenario, setup.robot
    x, y, z = (float(value) for value in scenario.normal)
    offsets = {scenario.task.frame: scenario.offset}
    if scenario.contacts is not None:
        offsets |= {s.frame: s.offset for s in scenario.shapes if s.frame in scenario.contacts.others}
    contact, *others = (
        ImpactContact(frame, (x, y, z), offset, friction=scenario.friction) for frame, offset in offsets.items()
    )
    footing = scenario.control.footing
    supports = () if free or footing is None or others else resolve_supports(robot, None)
    supports = tuple(s for s in supports if footing is None or s.frame not in footing.lifted)
    return WorstCaseObjective(robot, contact, Metric(), kind, supports, others=tuple(others))


def interpreted(objective: WorstCaseObjective) -> Gradient:
    """Return the function ``q → (objective, gradient)``, evaluated by the CasADi interpreter (slower than C)."""
    function, normal = objective.gradient_fun(), np.array(objective.contact.normal, dtype=float)

    def call(q: Array) -> tuple[float, Array]:
        value, gradient = function(q, normal)
        if not np.isfinite(float(value)):
            raise MetricError("is undefined at this posture", where=objective.name, hint="use another start posture")
        return float(value), np.asarray(gradient).ravel()

    return call


def compiled(objective: WorstCaseObjective) -> Gradient:
    """Return the function ``q → (objective, gradient)`` from the cached C export; build the export if it is missing.

    Raises:
        CompilerError: There is no compiler, the compiler failed, or the results of the library differ from CasADi.
        OutputError: The cache folder cannot be written, or other users can write it.
        SpecError: The library cannot be loaded, for example because another machine built it.
    """
    folder = cache_folder("gradients") / objective_key(objective)
    with locked(folder.with_suffix(".lock")):
        if not is_cached(library_path(folder, "impact")):
            require_compiler("gradient")
            tell("compiling the gradient")
            write_export([objective], folder, prefix="impact", portable=True, build=True, force=True)
    return ImpactGradient.load(folder, robot=objective.robot).objective


def objective_key(objective: WorstCaseObjective) -> str:
    """Return a hash of everything that the C code depends on."""
    robot, names = objective.robot, [objective.contact.frame, *(s.frame for s in objective.supports)]
    frames = [robot.model.frames[robot.frame_id(name)] for name in names]
    content = [
        ca.CasadiMeta.version(),
        robot.model_sha256,
        *[f"{frame.parentJoint} {frame.placement.homogeneous.tolist()}" for frame in frames],
        repr(replace(objective.contact, impulse=1.0)),
        repr((objective.kind, objective.metric, objective.supports, objective.compliance)),
    ]
    return source_key(content, "dynamics", "impact", "codegen")


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Lock a file, so that only one process at a time runs the ``with`` block."""
    try:
        file = path.open("w")
    except OSError as error:
        raise OutputError.unwritable(path.parent, error, "set IMPACT_POSTURE_CACHE to a folder") from None
    with file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
