"""What finishes a result folder: figures, C code and report, in this process or in another."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from impact_posture.errors import CompilerError, one_line
from impact_posture.output.result_reader import SolvedPostures, motion_of, result_view
from impact_posture.posture.formulation.problem_file import Prepared
from impact_posture.system.escape import file_name
from impact_posture.system.output_folder import write_record
from impact_posture.system.processes import fork_map

# Matplotlib and the C export are imported where they are used, because that takes longer than a small problem.
if TYPE_CHECKING:
    from impact_posture.codegen.export import Export
    from impact_posture.output.plot import ResultView
    from impact_posture.output.report.report_scene import ReportScene

FORMATS = ("png",)


@dataclass(frozen=True, eq=False)
class FinishRequest:
    """What :func:`finish_result` draws, exports and reports.  It can be sent to a process.

    Attributes:
        folder: The folder, with the files of the path to the optimum, if it was searched.
        found: The solution.
        codegen: Whether to export, build and check the C code.
        formats: Formats of the figures.
        report: Whether to write ``report.html``.
        meshes: Whether the report may hold the meshes of the user's own URDF.
        jobs: Processes that draw and compile side by side.
    """

    folder: Path
    found: SolvedPostures
    codegen: bool
    formats: Sequence[str]
    report: bool
    meshes: bool
    jobs: int


Finished = tuple[int, int, "tuple[Export, str] | str | None"]
Finish = Callable[[FinishRequest], Iterator[Finished]]


@dataclass(frozen=True)
class Written:
    """A result folder that was written.

    Attributes:
        out: The folder.
        export: The C export, or ``None``.
        compiler_error: Why the C code could not be built; empty if it was built, or if there is no compiler.
        report_error: Why there is no report; empty if there is one, or if none was wanted.
    """

    out: Path
    export: Export | None
    compiler_error: str = ""
    report_error: str = ""


def default_out(prepared: Prepared) -> Path:
    """Return the default folder ``./<robot>-<frame>``."""
    return Path(file_name(f"{prepared.impact.robot.name}-{prepared.impact.contact.frame}"))


def finish_result(prepared: Prepared, request: FinishRequest) -> Iterator[Finished]:
    """Draw the figures of a result, export its C code and write its report; yield after each.

    Yields:
        The number of finished files, the number of all files, and what :func:`_export` or :func:`_report` returns if
        it has ended.
    """
    # The C code comes first, because it takes longest.
    exports = [partial(_export, prepared, request)] if request.codegen else []
    motion = motion_of(request.folder, request.found.document, prepared.impact.robot)
    view = result_view(prepared, request.found, motion)
    tasks: list[Callable[[], Any]] = [*exports, *_drawings(view, request.folder, request.formats, request.report)]
    count = len(tasks) + request.report
    scene: ReportScene | None = None
    pictures: list[tuple[str, str]] = []
    with fork_map(lambda index: tasks[index](), len(tasks), request.jobs) as results:
        if request.report:
            # This process would only wait.  What goes wrong here goes wrong again for the report, which says so.
            with suppress(Exception):
                scene = _scene(prepared, view, request.meshes)
        for done, (index, result) in enumerate(results, start=1):
            exported = index < len(exports)
            pictures += [] if exported else result
            yield done, count, result if exported else None
    if request.report:
        # It shows the figures, so it comes last.
        yield count, count, _report(prepared, view, request, scene, sorted(pictures))


def _scene(prepared: Prepared, view: ResultView, meshes: bool) -> ReportScene:
    """Return the packed scene of the report, and load the viewer."""
    from impact_posture.output.report.report_page import read_viewer
    from impact_posture.output.report.result_report import result_scene

    scene = result_scene(prepared, view, meshes)
    _ = scene.packed
    read_viewer()
    return scene


def _report(
    prepared: Prepared,
    view: ResultView,
    request: FinishRequest,
    scene: ReportScene | None,
    pictures: Sequence[tuple[str, str]],
) -> str:
    """Write the report; return why that failed, because a result is kept without it."""
    try:
        from impact_posture.output.report.result_report import write_result_report

        write_result_report(
            request.folder,
            prepared,
            view,
            request.found.document,
            meshes=request.meshes,
            scene=scene,
            pictures=pictures,
        )
    except Exception as error:
        return one_line(f"{type(error).__name__}: {error}")
    return ""


def _export(prepared: Prepared, request: FinishRequest) -> tuple[Export, str]:
    """Write the C export; return it and the reason if it could not be built."""
    from impact_posture.codegen.c_names import products
    from impact_posture.codegen.export import export
    from impact_posture.impact.elasticity.contact_compression import compression

    folder, optimal, failure, impact = request.folder / "c", request.found.optimal, "", prepared.impact
    folder.mkdir()
    squeezed = compression(impact.objective, optimal, impact.speed, impact.contact_stiffness)
    try:
        made = export(impact.objective, folder, posture=optimal, compression=squeezed)
    except CompilerError as error:
        # The posture is kept although the compiler failed. The command line reports the error.
        failure = error.line
        made = export(impact.objective, folder, posture=optimal, compression=squeezed, force=True, check=False)
    # A record of its own lets the export be replaced alone, with the products of its Makefile.
    write_record(folder, "export", products(made.prefix))
    return made, failure


def _drawings(
    view: ResultView, folder: Path, formats: Sequence[str], report: bool
) -> list[Callable[[], list[tuple[str, str]]]]:
    """Return a function for each figure that draws it, and returns it as the report shows it."""
    from impact_posture.output.plot import draw_all, drawable
    from impact_posture.output.report.report_page import figures

    def draw(name: str) -> list[tuple[str, str]]:
        drawn = draw_all(view, folder, formats, [name])
        return figures(folder, drawn) if report else []

    return [partial(draw, name) for name in drawable(view)]
