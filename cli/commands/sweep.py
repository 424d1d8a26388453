"""``impact-posture sweep SWEEP.toml`` and ``impact-posture sweep show DIR``."""

from __future__ import annotations

import time
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from impact_posture.config.setting import OUTPUT
from impact_posture_cli import options
from impact_posture_cli.error_boundary import UsageError
from impact_posture_cli.output import Page, number, print_json

if TYPE_CHECKING:
    from concurrent.futures import Executor

RUN = "Where it runs"

Target = Annotated[
    str, typer.Argument(metavar="SWEEP.toml|show", help="File that describes the problems, or the word show.")
]
Shown = Annotated[str | None, typer.Argument(metavar="DIR", help="With show: the folder that sweep wrote.")]
Workers = Annotated[int, options.option("--workers", RUN, "Number of processes on this machine.", min=1)]
Scheduler = Annotated[
    str | None, options.option("--scheduler", RUN, "Dask cluster, such as tcp://host:8786.", metavar="ADDRESS")
]
Mpi = Annotated[bool, options.option("--mpi", RUN, "Solve on the MPI ranks of mpiexec … -m mpi4py.futures.")]
Slurm = Annotated[
    list[str] | None,
    options.option(
        "--slurm", RUN, "Run in Slurm job arrays; KEY=VALUE is a submitit option; repeatable.", metavar="KEY=VALUE"
    ),
]
Out = Annotated[
    str | None, options.out_option("Folder of the sweep; with show, folder of the maps.", "./SWEEP, or DIR/maps")
]
Force = Annotated[
    bool,
    options.option("--force", OUTPUT, "Replace another sweep; with show, files that you wrote or changed."),
]
MapAxes = Annotated[
    str | None, options.option("--axes", "Maps", "Axes of the maps.", metavar="A,B", show_default="the two longest")
]


def sweep(
    target: Target,
    folder: Shown = None,
    workers: Workers = 2,
    scheduler: Scheduler = None,
    mpi: Mpi = False,
    slurm: Slurm = None,
    axes: MapAxes = None,
    out: Out = None,
    force: Force = False,
    format: options.Formats = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    page = Page(json=json, quiet=quiet)
    if target == "show":
        if folder is None:
            raise UsageError("Missing argument 'DIR': the folder that sweep wrote.")
        _show(page, Path(folder), axes, out, format, force)
        return
    if folder is not None:
        raise UsageError("DIR is only allowed after show: use --out for the folder of the sweep.")
    if sum((scheduler is not None, mpi, slurm is not None)) > 1:
        raise UsageError("--scheduler, --mpi and --slurm exclude each other: give only one of them.")
    from impact_posture.sweep.sweep_file import read_sweep
    from impact_posture.sweep.sweep_run import run_sweep
    from impact_posture.system.escape import file_name

    path = Path(target)
    request = read_sweep(path)
    place = Path(out) if out else Path(file_name(path.stem))
    began = time.perf_counter()
    where = _executor(workers, scheduler, slurm, place, mpi=mpi)
    with (
        where as executor,
        page.progress("solving", "points in all passes", first="checking") as advance,
    ):
        run = run_sweep(request, place, executor, force=force, progress=advance)
    document: dict[str, Any] = {
        "schema": "impact-posture/sweep-run/1",
        "folder": str(place),
        "points": run.points,
        "solved": run.counts,
        "shards_written": run.shards,
        "solver_s": run.solver_s,
        "total_s": run.total_s,
        "wall_s": time.perf_counter() - began,
        "damaged": list(run.damaged),
    }
    if json:
        print_json(document)
        return
    solved = sum(run.counts.values())
    page.title(path.name, f"{run.points} problems, {solved} solved now")
    if solved:
        page.table(("status", "problems"), [(k, str(v)) for k, v in run.counts.items() if v], right=(1,))
        page.line(
            f"{number(1e3 * run.total_s / solved, 'ms')} of a worker's time for each problem, "
            f"{100 * run.solver_s / max(run.total_s, 1e-9):.0f} % of it in the solver"
        )
    page.line(f"written to {place}")
    page.warnings(f"{name} was damaged or belonged to another sweep; it was rewritten" for name in run.damaged)


def _executor(
    workers: int, scheduler: str | None, slurm: list[str] | None, out: Path, *, mpi: bool
) -> AbstractContextManager[Executor | None]:
    from impact_posture.sweep import executors
    from impact_posture.system.processes import process_pool

    if scheduler is not None:
        return executors.dask_cluster(scheduler)
    if mpi:
        return executors.mpi_ranks()
    if slurm is not None:
        from impact_posture.sweep.slurm_jobs import SlurmJobs, parse_options

        return SlurmJobs(out.with_name(f"{out.name}-slurm"), parse_options(slurm))
    return process_pool(workers) if workers > 1 else nullcontext()


def _show(page: Page, folder: Path, axes: str | None, out: str | None, format: list[Any] | None, force: bool) -> None:
    """Draw the maps of a sweep folder; print the best points, and how often neighbors have different optima."""
    from impact_posture.sweep.maps import draw_maps

    wanted = tuple(name.strip() for name in axes.split(",")) if axes else None
    with page.progress("drawing"):
        shown = draw_maps(folder, Path(out) if out else folder / "maps", wanted, format or ("png",), force=force)
    if page.json:
        print_json(shown.to_dict())
        return
    page.title(folder.name, f"{sum(shown.counts.values())} of {shown.points} problems solved")
    page.table(("status", "problems"), [(k, str(v)) for k, v in shown.counts.items() if v], right=(1,))
    page.line(f"{shown.switches} steps between neighbors switch to another optimum")
    for best in shown.best:
        page.line("best: " + ", ".join(f"{key} {value}" for key, value in best.items()))
    for path in shown.files:
        page.line(str(path))
