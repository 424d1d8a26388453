"""Finish a result folder with its figures, C code and report."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from impact_posture.errors import CompilerError, one_line
from impact_posture.output.result_reader import SolvedPostures, motion_of, result_view
from impact_posture.posture.formulation.problem_file import Prepared
from impact_posture.posture.search.growing_search import Progress
from impact_posture.system.escape import file_name
from impact_posture.system.folder_record import write_record
from impact_posture.system.processes import fork_call, fork_map

# Import Matplotlib and the C export only where they are used, because the import takes longer than a small problem.
if TYPE_CHECKING:
    from impact_posture.codegen.export import Export
    from impact_posture.output.report.report_scene import ReportScene


@dataclass(frozen=True)
class Written:
    """A result folder that was written, with its C export or ``None``.

    ``compiler_error`` says why the C code could not be built; it is empty without a compiler.  ``report_error`` says
    why the report could not be written.
    """

    out: Path
    export: Export | None = None
    compiler_error: str = ""
    report_error: str = ""


def default_out(prepared: Prepared) -> Path:
    """Return the default folder ``./<robot>-<frame>``."""
    return Path(file_name(f"{prepared.impact.robot.name}-{prepared.impact.contact.frame}"))


def finish_result(
    folder: Path,
    prepared: Prepared,
    postures: SolvedPostures,
    *,
    codegen: bool,
    formats: Sequence[str],
    report: bool,
    meshes: bool,
    jobs: int,
    progress: Progress | None,
) -> Written:
    """Draw the figures of a result, export, build and check its C code, and write ``report.html``.

    The folder already contains ``problem.toml``, and the path to the optimum if a path was searched.  ``meshes``
    permits the report to contain the meshes of the user's own URDF.  If ``jobs`` is more than one, ``jobs`` processes
    draw the figures, and another process writes the C code.  ``progress`` is called with the numbers of finished
    files and of all files.
    """
    export = partial(_export, folder, prepared, postures) if codegen else partial(Written, folder)
    scene: ReportScene | None = None
    # Writing the C code takes longest.  Another process therefore starts it before this process imports matplotlib.
    with fork_call(export) if codegen and jobs > 1 else nullcontext(export) as exported:
        from impact_posture.output.plot import draw_all, drawable
        from impact_posture.output.report.result_report import result_scene, write_result_report

        view = result_view(prepared, postures, motion_of(folder, postures.document, prepared.impact.robot))
        names = drawable(view)
        count = len(names) + codegen + report
        with fork_map(lambda k: draw_all(view, folder, formats, [names[k]]), len(names), jobs) as results:
            if report:
                # The main process prepares the scene while it waits for the workers.  An error here is ignored,
                # because it occurs again when the report is written, and is reported then.
                with suppress(Exception):
                    scene = result_scene(prepared, view, meshes)
                    _ = scene.packed
            written = exported()
            if codegen and progress:
                progress(1, count)
            for done, _ in enumerate(results, start=1 + codegen):
                if progress:
                    progress(done, count)
    if not report:
        return written
    report_error = ""
    try:
        # The report shows the figures, so it comes last.
        write_result_report(folder, prepared, view, postures.document, meshes=meshes, scene=scene)
    except Exception as error:
        # Keep the result even if its report cannot be written.
        report_error = one_line(f"{type(error).__name__}: {error}")
    if progress:
        progress(count, count)
    return replace(written, report_error=report_error)


def _export(folder: Path, prepared: Prepared, postures: SolvedPostures) -> Written:
    from impact_posture.codegen.c_names import products
    from impact_posture.codegen.export import export
    from impact_posture.impact.elasticity.contact_compression import compression

    code, impact, compiler_error = folder / "c", prepared.impact, ""
    code.mkdir()
    squeezed = compression(impact.objective, postures.answer, impact.speed, impact.contact_stiffness)
    write = partial(export, impact.objective, code, posture=postures.answer, compression=squeezed)
    try:
        exported = write()
    except CompilerError as error:
        # Keep the posture even if the compiler failed.  The command line reports the error.
        compiler_error, exported = error.line, write(force=True, check=False)
    # The export has its own record of files, so it can be replaced alone, with the products of its Makefile.
    write_record(code, "export", products(exported.prefix))
    return Written(folder, exported, compiler_error)
