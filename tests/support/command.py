"""The command line in a process of its own that need not import everything again: a fork of the test's."""

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

import matplotlib.backends.backend_agg  # noqa: F401
import PIL.Image
import rich.cells
import rich.markdown
import rich.progress
import rich.table
import typer.rich_utils
from matplotlib.figure import Figure

# What the commands import when they run, once for all of them.
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

# What these read or build once in a process.
PIL.Image.preinit()
rich.cells.cell_len("×")
PARSER = typer.main.get_command(app)
for name in COMMANDS:
    load(name)

# The figures of a result.
ALL_PICTURES = tuple(impact_posture.output.plot.FIGURES)

# The program that the installation puts on the path.
(MAIN,) = (entry.load() for entry in entry_points(group="console_scripts", name="impact-posture"))


def run(
    *arguments: object,
    cwd: Path | None = None,
    env: Mapping[str, str] | None = None,
    prepare: Callable[[], None] | None = None,
    timeout: float = 600,
    pictures: Collection[str] = (),
) -> subprocess.CompletedProcess[str]:
    """Run ``impact-posture`` with arguments, as its entry point does; ``env`` is added to the environment.

    Figures but the named ``pictures`` are blank: to draw them takes most of the time of a small robot's answer.
    The timeout ends what hangs; it is no bound on how long a command takes.
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


def refused(done: subprocess.CompletedProcess[str], code: int, *words: str) -> None:
    """One line, the right code, no traceback."""
    assert done.returncode == code, (done.returncode, done.stdout, done.stderr)
    lines = [line for line in done.stderr.splitlines() if line.startswith("error:")]
    assert len(lines) == 1, done.stderr
    assert "Traceback" not in done.stderr
    for word in words:
        assert word in lines[0], lines[0]


def on_terminal(*arguments: object, cwd: Path) -> str:
    """Run with standard error on a terminal; return what came there."""
    ours, theirs = os.openpty()
    with tempfile.TemporaryFile() as out:
        child = start(arguments, out.fileno(), theirs, cwd, {"TERM": "xterm"})
        os.close(theirs)
        said = read_terminal(ours)
        child.join()
    assert child.exitcode == 0, said
    return said


def read_terminal(ours: int) -> str:
    """What comes on a terminal until nobody has it open any more; ``ours`` is then closed."""
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
    """Start what :func:`run` waits for, its standard output and error on these descriptors."""
    words = [str(argument) for argument in arguments]
    target = (
        words,
        cwd,
        {"COLUMNS": "80", "NO_COLOR": "1", "BROWSER": "true", **(env or {})},
        prepare,
        out,
        errors,
        pictures,
    )
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
    """Become what a shell would have started: streams, folder, signals and warnings are those of a new program."""
    # The test's objects are left alone: a page that is looked at is a page that is copied.
    gc.freeze()
    # A new program has made no controllers, nor compiled anything for them.
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
        # Of a run the snapshots stay, as blank.
        figures = impact_posture.experiment.experiment_folders
        figures.figures_of_run = figures.figures_of_comparison = lambda views: {"snapshots": blank(views)}
        if words[0] != "report":
            # A page without figures is made where it is what a test is about.
            impact_posture.output.report.result_report.write_result_report = lambda *arguments, **options: None
            impact_posture.output.report.result_report.result_scene = lambda *arguments: None
            impact_posture.experiment.experiment_folders.try_report = lambda *arguments, **options: ""
    if prepare is not None:
        prepare()
    sys.argv = ["impact-posture", *words]
    MAIN()


def blank(views: object) -> Figure:
    return Figure(figsize=(1, 1))
