"""The command line in a process of its own that need not import everything again: a fork of the test's."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO

# What the commands import when they run, once for all of them.
import impact_posture.codegen.export
import impact_posture.experiment.figures
import impact_posture.experiment.folders
import impact_posture.experiment.reproduction
import impact_posture.plot
import impact_posture.result_folder
import impact_posture.verification.verification
from impact_posture_cli.main import main


def run(
    *arguments: object,
    cwd: Path | None = None,
    env: Mapping[str, str] | None = None,
    prepare: Callable[[], None] | None = None,
    timeout: float = 600,
    pictures: bool = False,
) -> subprocess.CompletedProcess[str]:
    """Run ``impact-posture`` with arguments, as its entry point does; ``env`` is added to the environment.

    Without ``pictures`` one figure is drawn instead of all: they take most of the time of a small robot's answer.
    The timeout ends what hangs; it is no bound on how long a command takes.
    """
    words = [str(argument) for argument in arguments]
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as errors:
        target = (words, cwd, {"COLUMNS": "80", "NO_COLOR": "1", **(env or {})}, prepare, out, errors)
        child = multiprocessing.get_context("fork").Process(target=_command, args=(*target, pictures))
        child.start()
        child.join(timeout)
        if child.exitcode is None:
            child.kill()
            raise subprocess.TimeoutExpired(words, timeout)
        texts = []
        for file in (out, errors):
            file.seek(0)
            texts.append(file.read().decode())
    return subprocess.CompletedProcess(words, child.exitcode, *texts)


def _command(
    words: list[str],
    cwd: Path | None,
    env: Mapping[str, str],
    prepare: Callable[[], None] | None,
    out: IO[bytes],
    errors: IO[bytes],
    pictures: bool,
) -> None:
    """Become what a shell would have started: streams, folder, signals and warnings are those of a new program."""
    os.dup2(out.fileno(), 1)
    os.dup2(errors.fileno(), 2)
    sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)
    os.environ.update(env)
    os.chdir(cwd or ".")
    signal.signal(signal.SIGINT, signal.default_int_handler)
    logging.getLogger().handlers.clear()
    warnings.resetwarnings()
    for category in (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning):
        warnings.simplefilter("ignore", category)
    if not pictures:
        impact_posture.plot.drawable = lambda view: ["jump"]
        # Of a run the snapshots stay.
        figures = impact_posture.experiment.figures
        figures.draw_run = figures.draw_comparison = lambda *arguments: []
    if prepare is not None:
        prepare()
    sys.argv = ["impact-posture", *words]
    main()
