"""Write the solution of a posture problem into a result folder, whole or not at all."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from impact_posture.errors import CompilerError, one_line
from impact_posture.escape import file_name
from impact_posture.output_folder import whole_folder, write_json, write_record
from impact_posture.posture.global_search import SelfMotionMap
from impact_posture.posture.null_space_path import NullSpacePath, null_space_path
from impact_posture.posture.problem_settings import Prepared, dump_settings, resolved_settings
from impact_posture.posture.result import result_arrays
from impact_posture.posture.solve import PostureSolution
from impact_posture.posture.tradeoff import TradeOff
from impact_posture.processes import fork_map
from impact_posture.result_view import motion_of, result_view
from impact_posture.robot.postures import write_posture

# Matplotlib and the C export are imported where they are used, because that takes longer than a small problem.
if TYPE_CHECKING:
    from impact_posture.codegen.export import Export
    from impact_posture.path.posture_path import PosturePath
    from impact_posture.plot import ResultView
    from impact_posture.report.scene import Scene

FORMATS = ("png",)

FinishRequest = tuple[
    Path, np.ndarray, np.ndarray, NullSpacePath, SelfMotionMap | None, dict[str, Any], bool, Sequence[str], int,
    bool, bool,
]  # fmt: skip
Finished = tuple[int, int, "tuple[Export, str] | str | None"]
Finish = Callable[[FinishRequest], Iterator[Finished]]


@dataclass(frozen=True)
class Written:
    """Result folder that :func:`write_result` wrote.

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


def write_result(
    prepared: Prepared,
    solution: PostureSolution,
    document: dict[str, Any],
    out: Path,
    *,
    tradeoff: TradeOff | None = None,
    motion: PosturePath | None = None,
    mapped: SelfMotionMap | None = None,
    force: bool = False,
    codegen: bool = True,
    formats: Sequence[str] = FORMATS,
    report: bool = True,
    meshes: bool = False,
    jobs: int = 1,
    progress: Callable[[int, int], None] | None = None,
    finish: Finish | None = None,
) -> Written:
    """Write the result folder, whole or not at all.

    Args:
        prepared: The problem.
        solution: Its solution.
        document: The content of ``result.json``, from :func:`~impact_posture.posture.result.result_document`.
        out: The folder.
        tradeoff: The trade-off, if it was computed.
        motion: The path to the optimum, if it was searched.
        mapped: The self-motion map, if it was computed.
        force: Replace an earlier result.
        codegen: Export, build and check the C code, too.
        formats: Formats of the figures.
        report: Write ``report.html``, too.
        meshes: Let it hold the meshes of the user's own URDF.
        jobs: Processes that draw and compile side by side.
        progress: Called with ``(done, all)`` after each figure, the C code and the report.
        finish: :func:`finish_result` of this problem, in another process; in this one by default.

    Raises:
        OutputError: The folder exists without ``force``, or cannot be written.
    """
    path = null_space_path(solution.problem, solution.initial, solution.q)
    made: Export | None = None
    failure = report_error = ""
    with whole_folder(out, force=force, kind="result") as folder:
        write_json(folder / "result.json", document)
        np.savez_compressed(folder / "result.npz", **result_arrays(solution, path, tradeoff, mapped))  # type: ignore[arg-type]
        write_json(folder / "posture.json", write_posture(prepared.impact.robot, solution.q))
        (folder / "problem.toml").write_text(dump_settings(resolved_settings(prepared)), encoding="utf-8")
        if motion is not None:
            from impact_posture.path.files import write_path

            write_path(folder, prepared.impact.robot, motion)
        request = (
            folder, solution.initial, solution.q, path, mapped, document, codegen, formats, jobs, report, meshes
        )  # fmt: skip
        for done, count, result in (finish or partial(finish_result, prepared))(request):
            if isinstance(result, str):
                report_error = result
            elif result is not None:
                made, failure = result
            if progress:
                progress(done, count)
    return Written(out, made, failure, report_error)


def finish_result(prepared: Prepared, request: FinishRequest) -> Iterator[Finished]:
    """Draw the figures of a result, export its C code and write its report; yield after each.

    Args:
        prepared: The problem.
        request: The folder, the postures before and after, the path between them, the self-motion map, the content of
            ``result.json``, whether to export, the formats of the figures, the number of processes, whether to write
            a report, and whether it may hold the user's own meshes.  It can be sent to a process.

    Yields:
        The number of finished files, the number of all files, and what :func:`_export` or :func:`_report` returns if
        it has ended.
    """
    folder, initial, optimal, path, mapped, document, codegen, formats, jobs, report, meshes = request
    # The C code comes first, because it takes longest.
    tasks: list[Callable[[], Any]] = [partial(_export, prepared, optimal, folder / "c")] if codegen else []
    motion = motion_of(folder, document, prepared.impact.robot)
    view = result_view(prepared, initial, optimal, path, document, motion, mapped)
    tasks += _drawings(view, folder, formats, report)
    count = len(tasks) + report
    scene: Scene | None = None
    pictures: list[tuple[str, str]] = []
    with fork_map(lambda index: tasks[index](), len(tasks), jobs) as results:
        if report:
            # This process would only wait.  What goes wrong here goes wrong again for the report, which says so.
            with suppress(Exception):
                scene = _scene(prepared, view, meshes)
        for done, (index, result) in enumerate(results, start=1):
            exported = codegen and index == 0
            pictures += [] if exported else result
            yield done, count, result if exported else None
    if report:
        # It shows the figures, so it comes last.
        yield count, count, _report(folder, prepared, view, document, meshes, scene, sorted(pictures))


def _scene(prepared: Prepared, view: ResultView, meshes: bool) -> Scene:
    """Return the packed scene of the report, and load the viewer."""
    from impact_posture.report.page import read_viewer
    from impact_posture.report.result_report import result_scene

    scene = result_scene(prepared, view, meshes)
    _ = scene.packed
    read_viewer()
    return scene


def _report(
    folder: Path,
    prepared: Prepared,
    view: ResultView,
    document: dict[str, Any],
    meshes: bool,
    scene: Scene | None,
    pictures: Sequence[tuple[str, str]],
) -> str:
    """Write the report; return why that failed, because a result is kept without it."""
    try:
        from impact_posture.report.result_report import write_result_report

        write_result_report(folder, prepared, view, document, meshes=meshes, scene=scene, pictures=pictures)
    except Exception as error:
        return one_line(f"{type(error).__name__}: {error}")
    return ""


def _export(prepared: Prepared, optimal: np.ndarray, folder: Path) -> tuple[Export, str]:
    """Write the C export; return it and the reason if it could not be built."""
    from impact_posture.codegen.export import export
    from impact_posture.codegen.naming import products
    from impact_posture.impact.contact_compression import compression

    folder.mkdir()
    failure, impact = "", prepared.impact
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
    from impact_posture.plot import draw_all, drawable
    from impact_posture.report.page import figures

    def draw(name: str) -> list[tuple[str, str]]:
        drawn = draw_all(view, folder, formats, [name])
        return figures(folder, drawn) if report else []

    return [partial(draw, name) for name in drawable(view)]
