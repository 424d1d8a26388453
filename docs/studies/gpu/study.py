"""Prepare the cases of the GPU study in ``build/gpu``, and run them if this machine has a GPU."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator

from docs.studies.core import ROOT, Request
from docs.studies.gpu.prepare import prepare
from impact_posture.errors import InputError


def lines(request: Request) -> Iterator[str]:
    """Yield the lines that ``run.py`` prints, or, without ``--write``, the reason why it cannot run."""
    folder = ROOT / "build" / "gpu"
    missing = [tool for tool in ("nvidia-smi", "nvcc", "gcc") if shutil.which(tool) is None]
    if missing and request.write:
        hint = f"leave out --write, copy {folder} to a machine with a GPU, and start run.py there"
        raise InputError(f"no {', '.join(missing)}", where="gpu --write", hint=hint)
    prepare(folder)
    if missing:
        yield f"skipped: no {', '.join(missing)}.  Copy {folder} to a machine with a GPU, and start run.py there."
        return
    command = [sys.executable, str(folder / "run.py"), "--only", request.only]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as running:
        assert running.stdout is not None
        yield from (line.rstrip("\n") for line in running.stdout)
    if running.returncode:
        raise InputError("nvidia-smi names no GPU", where="gpu", hint="install the driver of the GPU")
