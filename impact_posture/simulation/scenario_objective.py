"""The impact of a scenario as the offline problem sees it: the objective, its gradient, and the offline optimum."""

from __future__ import annotations

import fcntl
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impact_posture.codegen.export import write_export
from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.errors import CompilerError, MetricError, OutputError
from impact_posture.impact.contact import ImpactContact
from impact_posture.impact.metric import Metric
from impact_posture.impact.objective import ImpactObjective
from impact_posture.impact.supports import resolve_supports
from impact_posture.libraries import cache_folder, is_cached, library_path, source_key
from impact_posture.progress import tell
from impact_posture.settings import ObjectiveKind
from impact_posture.simulation.scenario import RepeatedContacts, Setup
from impact_posture.toolchain import find_compiler

Array = NDArray[np.float64]
Gradient = Callable[[Array], tuple[float, Array]]


def scenario_objective(setup: Setup, kind: ObjectiveKind = "impulse", *, free: bool = False) -> ImpactObjective:
    """The objective of the scenario's impact: at the shape that hits, or at the frame that is pushed.

    Args:
        setup: The experiment.
        kind: Which of the metric family.
        free: Without the feet that hold a robot that stands.
    """
    scenario, robot = setup.scenario, setup.robot
    offset = scenario.shape.offset if isinstance(scenario.task, RepeatedContacts) else (0.0, 0.0, 0.0)
    x, y, z = (float(value) for value in scenario.normal)
    contact = ImpactContact(scenario.task.frame, (x, y, z), offset)
    supports = () if free or scenario.control.footing is None else resolve_supports(robot, None)
    return ImpactObjective(robot, contact, Metric(), kind, supports)


def interpreted(objective: ImpactObjective) -> Gradient:
    """``q → (objective, gradient)`` by CasADi's interpreter: ready at once, several times slower than the C export.

    The gradient is a view that the next call overwrites.
    """
    function = objective.gradient_fun()
    # Its stubs ask for sizes that it does not take.
    buffer: Any
    buffer, evaluate = function.buffer()
    q, n = np.zeros(objective.robot.nq), np.array(objective.contact.normal, dtype=float)
    value, gradient = np.zeros(1), np.zeros(objective.robot.nv)
    for k, given in enumerate((q, n)):
        buffer.set_arg(k, memoryview(given))  # type: ignore[arg-type]
    for k, found in enumerate((value, gradient)):
        buffer.set_res(k, memoryview(found))  # type: ignore[arg-type]

    def call(at: Array) -> tuple[float, Array]:
        q[:] = at
        evaluate()
        if not np.isfinite(value[0]):
            raise MetricError("does not exist there", where=objective.name, hint="start elsewhere")
        return float(value[0]), gradient

    # The buffer knows addresses only: what lies there must live as long as the call.
    call.__dict__["kept"] = (function, buffer, n)
    return call


def compiled(objective: ImpactObjective) -> Gradient:
    """The same from the C export, built once and kept in the cache folder; interpreted where no compiler is.

    Raises:
        CompilerError: The compiler failed, or what it made computes other numbers.
        OutputError: The cache folder cannot be written, or is not the user's alone.
    """
    if find_compiler() is None:
        return interpreted(objective)
    folder = cache_folder("gradients") / _key(objective)
    with _locked(folder.with_suffix(".lock")):
        if not is_cached(library_path(folder, "impact")):
            tell("compiling the gradient")
            written = write_export([objective], folder, prefix="impact", portable=True, build=True, force=True)
            if written.library is None:
                raise CompilerError("has gone", where="C compiler", hint="try again")
    return ImpactGradient.load(folder, robot=objective.robot).objective


def _key(objective: ImpactObjective) -> str:
    """Hash of what shapes the C code."""
    point = objective.robot.model.frames[objective.robot.frame_id(objective.contact.frame)]
    held = [objective.robot.model.frames[objective.robot.frame_id(s.frame)] for s in objective.supports]
    content = [
        ca.CasadiMeta.version(),
        objective.robot.model_sha256,
        *[f"{f.parentJoint} {f.placement.homogeneous.tolist()}" for f in (point, *held)],
        repr(replace(objective.contact, impulse=1.0)),
        repr((objective.kind, objective.metric, objective.supports, objective.compliance)),
    ]
    return source_key(content, "dynamics", "impact", "codegen")


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """One process at a time: the others find the work done."""
    try:
        file = path.open("w")
    except OSError as error:
        raise OutputError(
            f"cannot be written ({error.strerror})",
            where=str(path.parent),
            hint="set IMPACT_POSTURE_CACHE to a folder",
        ) from None
    with file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
