"""Temporary folders, which disappear also after a process was killed.

A temporary folder holds a record, ``.impact-posture.json``, from its first moment on, locked by the process that
works in it.  A folder that nobody locks is what a killed process left.  The next process that works in the same
place removes it.
"""

from __future__ import annotations

import fcntl
import json
import os
import secrets
import shlex
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from impact_posture.errors import OutputError
from impact_posture.system.processes import undone

RECORD = ".impact-posture.json"
SCHEMA = "impact-posture/folder/1"
SCRATCH = ".impact-posture-"
_PROGRAM = "impact-posture"


def made_by() -> dict[str, str]:
    """Return the words with which this program was called, for a record; nothing for another program."""
    program, *words = sys.argv or [""]
    return {"command": shlex.join([_PROGRAM, *words])} if Path(program).stem == _PROGRAM else {}


@contextmanager
def scratch_folder(parent: Path | None = None, mode: int = 0o700) -> Iterator[Path]:
    """Yield a temporary folder.  It is removed after the block, also after a signal.

    Args:
        parent: The folder above it; the system's temporary folder by default.
        mode: Permissions; only the user can read it by default.

    Raises:
        OutputError: The system has no temporary folder.
        OSError: The folder cannot be made.
    """
    try:
        parent = Path(tempfile.gettempdir()) if parent is None else parent
    except FileNotFoundError:
        raise OutputError("no temporary folder can be written", where="TMPDIR", hint="set it to one") from None
    _sweep(parent)
    folder = parent / f"{SCRATCH}{secrets.token_hex(4)}"
    # The folder does not exist yet, so no signal can come between.
    with undone(lambda: remove_scratch(folder)):
        folder.mkdir(mode)
        record = os.open(folder / RECORD, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        try:
            # Where nothing can be locked, nothing is swept.
            with suppress(OSError):
                fcntl.flock(record, fcntl.LOCK_EX)
            # This follows the lock.  A process that finds the record unlocked finds it empty, and leaves it alone.
            content = {"schema": SCHEMA, "host": os.uname().nodename, **made_by()}
            os.write(record, json.dumps(content).encode())
            yield folder
        finally:
            os.close(record)


def _sweep(parent: Path) -> None:
    """Remove the temporary folders that processes of this package left when they were killed."""
    with suppress(OSError):
        for folder in parent.glob(f"{SCRATCH}*"):
            with suppress(OSError, ValueError, RecursionError, KeyError, TypeError):
                _sweep_one(folder)


def _sweep_one(folder: Path) -> None:
    if folder.is_symlink() or folder.stat().st_uid != os.geteuid():
        return
    # A pipe in its place has nothing to read.
    record = os.open(folder / RECORD, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        # This fails while the process of the folder lives.
        fcntl.flock(record, fcntl.LOCK_EX | fcntl.LOCK_NB)
        content = json.loads(os.read(record, 1 << 24))
        # Locks may not reach across machines.  The record of a finished folder names no machine.
        if content["schema"] == SCHEMA and content.get("host", os.uname().nodename) == os.uname().nodename:
            remove_scratch(folder)
    finally:
        os.close(record)


def remove_scratch(folder: Path) -> None:
    """Remove a temporary folder and its record last, so that after an interruption it still counts as ours."""
    with suppress(OSError):
        for entry in os.scandir(folder):
            if entry.is_dir(follow_symlinks=False):
                shutil.rmtree(entry.path, ignore_errors=True)
            elif entry.name != RECORD:
                os.unlink(entry.path)
    shutil.rmtree(folder, ignore_errors=True)
