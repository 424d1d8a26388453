"""Temporary folders that are removed even if the process that made them was killed.

A process locks the file ``.impact-posture.json``, called the record, in its temporary folder.  An unlocked record
means that the process was killed.  The next process that makes a temporary folder in the same place removes the old
folder.
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
    """Return the command line of this program for a record; empty if another program runs this code."""
    program, *words = sys.argv or [""]
    return {"command": shlex.join([_PROGRAM, *words])} if Path(program).stem == _PROGRAM else {}


@contextmanager
def scratch_folder(parent: Path | None = None, mode: int = 0o700) -> Iterator[Path]:
    """Yield a temporary folder, which is removed after the block, also if a signal ends the process.

    The folder is made in ``parent``, by default in the temporary folder of the system.  With the default ``mode``,
    only the user can read the folder.

    Raises:
        OutputError: The system has no temporary folder.
        OSError: The folder cannot be made.
    """
    try:
        parent = Path(tempfile.gettempdir()) if parent is None else parent
    except FileNotFoundError:
        raise OutputError("no temporary folder can be written", where="TMPDIR", hint="set it to a folder") from None
    remove_killed(parent)
    folder = parent / f"{SCRATCH}{secrets.token_hex(4)}"
    # Make the folder inside this block, so that a signal removes the folder.
    with undone(lambda: remove_scratch(folder)):
        folder.mkdir(mode)
        record = os.open(folder / RECORD, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        try:
            # On file systems without locks, the folders of killed processes are not removed.
            with suppress(OSError):
                fcntl.flock(record, fcntl.LOCK_EX)
            # Lock the record before writing it, because other processes ignore an empty record.
            content = {"schema": SCHEMA, "host": os.uname().nodename, **made_by()}
            try:
                os.write(record, json.dumps(content).encode())
            except OSError as error:
                # An error of ``os.write`` does not contain the name of the file.
                raise OSError(error.errno, error.strerror, str(folder)) from None
            yield folder
        finally:
            os.close(record)


def remove_killed(parent: Path) -> None:
    """Remove the temporary folders of killed processes in ``parent``."""
    with suppress(OSError):
        for folder in parent.glob(f"{SCRATCH}*"):
            if not folder.is_symlink() and folder.stat().st_uid == os.geteuid():
                with suppress(OSError, ValueError, RecursionError, KeyError, TypeError):
                    _remove_unlocked(folder)


def _remove_unlocked(folder: Path) -> None:
    # Without O_NONBLOCK, opening a pipe of this name would block.
    record = os.open(folder / RECORD, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        # Locking fails while the process that uses the folder runs.
        fcntl.flock(record, fcntl.LOCK_EX | fcntl.LOCK_NB)
        content = json.loads(os.read(record, 1 << 24))
        # Keep the folders of other machines, because locks may not work across machines.  The record of a finished
        # output folder names no machine.
        if content["schema"] == SCHEMA and content.get("host", os.uname().nodename) == os.uname().nodename:
            remove_scratch(folder)
    finally:
        os.close(record)


def remove_scratch(folder: Path) -> None:
    """Remove a temporary folder, its record last, so that an interrupted removal can be continued later."""
    with suppress(OSError):
        for entry in os.scandir(folder):
            if entry.is_dir(follow_symlinks=False):
                shutil.rmtree(entry.path, ignore_errors=True)
            elif entry.name != RECORD:
                os.unlink(entry.path)
    shutil.rmtree(folder, ignore_errors=True)
