"""Load what writes a result in another process while this one solves the problem."""

from __future__ import annotations

import gc
import os
import tempfile
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from impact_posture.errors import OutputError
from impact_posture.system.processes import fork_server
from impact_posture.system.scratch_folder import scratch_folder

# This module is imported before all that takes long to import.
if TYPE_CHECKING:
    from impact_posture.config.settings import ProblemSettings
    from impact_posture.output.result_folder import Finish

# The least priority of a thread.  The solver runs first, and what remains is done when it has ended.
_LAST = 19


@contextmanager
def early_writer(
    settings: ProblemSettings, jobs: int, *, report: bool = True, meshes: bool = False
) -> Iterator[Finish | None]:
    """Yield what finishes the result of a problem, in a process that prepares for it.

    Yield ``None`` for a single job, or where the system has no place for a process or its temporary files.

    Args:
        settings: The problem.
        jobs: Number of processes.
        report: Whether there will be a report, whose shapes take time to load.
        meshes: Whether the report may hold the meshes of the user's own URDF.
    """
    with ExitStack() as stack:
        finish = None
        if jobs > 1:
            try:
                folder = stack.enter_context(scratch_folder())
                load = partial(_load_in_background, settings, folder, report, meshes)
                finish = stack.enter_context(fork_server(load))
            except (OSError, OutputError):
                finish = None
        yield finish


def _load_in_background(
    settings: ProblemSettings, folder: Path, report: bool, meshes: bool, requested: Callable[[], bool]
) -> Finish:
    """Call :func:`load` with the least priority, in a thread because a process cannot raise its priority again.

    Threads have priorities of their own on Linux.  Elsewhere the priority stays as it is.
    """

    def last() -> None:
        with suppress(OSError, AttributeError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _LAST)

    with ThreadPoolExecutor(1, initializer=last) as pool:
        return pool.submit(load, settings, folder, report, meshes, requested).result()


def load(
    settings: ProblemSettings, folder: Path, report: bool, meshes: bool, requested: Callable[[], bool]
) -> Finish:
    """Load what writing the result of a problem needs, prepare more until it is requested, and return what writes it.

    Args:
        settings: The problem.
        folder: Place of temporary files.
        report: As :func:`early_writer`.
        meshes: As :func:`early_writer`.
        requested: Tells whether the result has been requested.
    """
    # The process may be killed.  Then nobody else removes its temporary files, of which matplotlib makes some.
    tempfile.tempdir = str(folder)
    import threadpoolctl

    import impact_posture.output.plot  # noqa: F401 (the import is what takes long)
    from impact_posture.codegen.c_literals import DOUBLE
    from impact_posture.codegen.export import cached_code, default_prefix
    from impact_posture.codegen.export_files import load_templates
    from impact_posture.codegen.self_test import casadi_reference
    from impact_posture.output.result_folder import finish_result
    from impact_posture.posture.formulation.problem_file import prepare

    # Threads of a BLAS would wait for each other, and take the cores from the solver.
    threadpoolctl.threadpool_limits(1, "blas")
    load_templates()
    prepared = prepare(settings)
    # What goes wrong here goes wrong again for the result, which says so.
    with suppress(Exception):
        if report:
            from impact_posture.output.report.drawn_robot import draw_robot
            from impact_posture.output.report.report_page import load_template, read_viewer

            load_template()
            draw_robot(prepared.impact.robot, meshes)
        # A large robot takes so long to solve that there is time to do more.
        if not requested():
            objectives = (prepared.impact.objective,)
            exported, _ = cached_code(objectives, default_prefix(objectives), DOUBLE, False)
            for own in exported:
                casadi_reference(own.objective)
            read_viewer()
    # All this is needed to the end.  To look for garbage in it takes each process that draws 0.07 s.
    gc.freeze()
    return partial(finish_result, prepared)
