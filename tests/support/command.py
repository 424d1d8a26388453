"""Run the command line in a fork of the test process, so that modules need not be imported again."""

from __future__ import annotations

import contextlib
import gc
import logging
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from importlib.metadata import entry_points
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import matplotlib.backends.backend_agg  # noqa: F401
import PIL.Image
import rich.cells
import rich.markdown
import rich.progress
import rich.table
import typer.rich_utils
from matplotlib.figure import Figure

# Commands import these modules when they run.  Import them once before the forks, because this saves time.
import impact_posture.codegen.export
import impact_posture.experiment.experiment_folders
import impact_posture.experiment.jobs
import impact_posture.experiment.reproduction
import impact_posture.impact.evaluation.evaluation
import impact_posture.output.plot.snapshots_figure
import impact_posture.output.report.result_report
import impact_posture.output.result_folder
import impact_posture.posture.analysis.robustness
import impact_posture.robot.robot_summary
import impact_posture.verification.verification
import impact_posture_cli.argv
import impact_posture_cli.error_boundary
import impact_posture_cli.impact_tables
import impact_posture_cli.output
import impact_posture_cli.progress_line  # noqa: F401
from impact_posture_cli.app import COMMANDS, app, load

with contextlib.suppress(ImportError):
    import mujoco  # noqa: F401

# These libraries load data at their first use.  Load the data before the forks.
PIL.Image.preinit()
rich.cells.cell_len("×")
PARSER = typer.main.get_command(app)
for name in COMMANDS:
    load(name)

# Names of all figures of a result.
ALL_PICTURES = tuple(impact_posture.output.plot.FIGURES)

# Entry point of the installed program ``impact-posture``.
(MAIN,) = (entry.load() for entry in entry_points(group="console_scripts", name="impact-posture"))


def run(
    *arguments: object,
    cwd: Path | None = None,
    env: Mapping[str, str] | None = None,
    prepare: Callable[[], None] | None = None,
    timeout: float = 600,
    pictures: Collection[str] = (),
) -> subprocess.CompletedProcess[str]:
    """Run ``impact-posture`` with arguments, as its entry point does; ``env`` contains more environment variables.

    Only the figures named in ``pictures`` are drawn, because drawing takes most of the time for a small robot.  Other
    figures are blank.  The timeout is long: it only ends commands that hang.
    """
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as errors:
        child = start(arguments, out.fileno(), errors.fileno(), cwd, env, prepare, pictures)
        child.join(timeout)
        if child.exitcode is None:
            child.kill()
            raise subprocess.TimeoutExpired([str(argument) for argument in arguments], timeout)
        texts = []
        for file in (out, errors):
            file.seek(0)
            texts.append(file.read().decode())
    return subprocess.CompletedProcess([str(argument) for argument in arguments], child.exitcode, *texts)


def succeed(*arguments: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run a command as :func:`run` does, and check that it succeeds."""
    done = run(*arguments, **options)
    assert done.returncode == 0, done.stderr
    return done


def refused(done: subprocess.CompletedProcess[str], code: int, *words: str) -> None:
    """Check that a command failed with this exit code and one error line, without a traceback."""
    assert done.returncode == code, (done.returncode, done.stdout, done.stderr)
    lines = [line for line in done.stderr.splitlines() if line.startswith("error:")]
    assert len(lines) == 1, done.stderr
    assert "Traceback" not in done.stderr
    for word in words:
        assert word in lines[0], lines[0]


def on_terminal(*arguments: object, cwd: Path) -> str:
    """Run a command whose standard error is a terminal, and return the text on the terminal."""
    ours, theirs = os.openpty()
    with tempfile.TemporaryFile() as out:
        child = start(arguments, out.fileno(), theirs, cwd, {"TERM": "xterm"})
        os.close(theirs)
        said = read_terminal(ours)
        child.join()
    assert child.exitcode == 0, said
    return said


def read_terminal(ours: int) -> str:
    """Read a terminal until every process has closed it, then close the descriptor ``ours``."""
    said = b""
    with contextlib.suppress(OSError):
        while part := os.read(ours, 65536):
            said += part
    os.close(ours)
    return said.decode()


def start(
    arguments: Sequence[object],
    out: int,
    errors: int,
    cwd: Path | None = None,
    env: Mapping[str, str] | None = None,
    prepare: Callable[[], None] | None = None,
    pictures: Collection[str] = (),
) -> BaseProcess:
    """Start a command for :func:`run`, with ``out`` and ``errors`` as standard output and standard error."""
    words = [str(argument) for argument in arguments]
    variables = {"COLUMNS": "80", "NO_COLOR": "1", "BROWSER": "true", **(env or {})}
    target = words, cwd, variables, prepare, out, errors, pictures
    child = multiprocessing.get_context("fork").Process(target=_command, args=target)
    child.start()
    return child


def _command(
    words: list[str],
    cwd: Path | None,
    env: Mapping[str, str],
    prepare: Callable[[], None] | None,
    out: int,
    errors: int,
    pictures: Collection[str],
) -> None:
    """Run the command with the streams, folder, signal handlers and warnings that a new program would have."""
    # Without this call, the garbage collector would write to memory that is shared with the test, and copy it.
    gc.freeze()
    # A new program starts without cached controllers.
    impact_posture.experiment.jobs.controller_factory.cache_clear()
    os.dup2(out, 1)
    os.dup2(errors, 2)
    sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)
    os.environ.update(env)
    os.chdir(cwd or ".")
    signal.signal(signal.SIGINT, signal.default_int_handler)
    logging.getLogger().handlers.clear()
    warnings.resetwarnings()
    for category in (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning):
        warnings.simplefilter("ignore", category)
    impact_posture.output.plot.FIGURES.update(dict.fromkeys(set(ALL_PICTURES) - set(pictures), blank))
    if not pictures:
        # Simulated runs still write their snapshots, as blank figures.
        figures = impact_posture.experiment.experiment_folders
        figures.figures_of_run = figures.figures_of_comparison = lambda views: {"snapshots": blank(views)}
        if words[0] != "report":
            # Only tests of the report need ``report.html``.
            impact_posture.output.report.result_report.write_result_report = lambda *arguments, **options: None
            impact_posture.output.report.result_report.result_scene = lambda *arguments: None
            impact_posture.experiment.experiment_folders.try_report = lambda *arguments, **options: ""
    if prepare is not None:
        prepare()
    sys.argv = ["impact-posture", *words]
    MAIN()


def blank(views: object) -> Figure:
    return Figure(figsize=(1, 1))
