"""Output folders: written whole or not at all, never over something that is not ours."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from impact_posture.errors import OutputError


def check_output(out: Path, *, force: bool, marks: tuple[str, ...]) -> None:
    """Refuse an output folder early, before hours of work.

    Args:
        out: The folder to be written.
        force: Whether an existing folder of ours may be replaced.
        marks: A folder counts as ours if it holds a file that matches one of these patterns.

    Raises:
        OutputError: It exists, is a file, is not ours, or its parent cannot be written.
    """
    if out.is_symlink() or out.is_file():
        raise OutputError("exists and is no folder", where=str(out), mend="choose another --out")
    if out.is_dir() and any(out.iterdir()):
        if not force:
            raise OutputError("exists", where=str(out), mend="choose another --out, or --force to replace it")
        if not any(any(out.glob(mark)) for mark in marks):
            raise OutputError(
                "exists and does not look like an earlier result",
                where=str(out),
                mend="choose another --out: --force replaces results only",
            )
    parent = _first_existing(out.absolute().parent)
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        raise OutputError("cannot be written", where=str(parent), mend="choose another --out")


@contextmanager
def whole_folder(out: Path, *, force: bool, marks: tuple[str, ...]) -> Iterator[Path]:
    """Yield a folder beside ``out`` to write into; on success it takes ``out``'s place, else nothing is left.

    Raises:
        OutputError: As :func:`check_output`, or the disk is full or not writable.
    """
    check_output(out, force=force, marks=marks)
    out = out.absolute()
    made = _make_parents(out.parent)
    beside: Path | None = None
    try:
        beside = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
        beside.chmod(0o777 & ~_umask())
        yield beside
        _replace(beside, out, force)
        made = []
    except OSError as error:
        words = error.strerror or str(error)
        raise OutputError(
            f"cannot be written ({words})", where=str(out), mend="free space or choose another --out"
        ) from error
    finally:
        if beside is not None and beside.exists():
            shutil.rmtree(beside, ignore_errors=True)
        for folder in reversed(made):
            try:
                folder.rmdir()
            except OSError:
                break


def _replace(beside: Path, out: Path, force: bool) -> None:
    """Put ``beside`` in ``out``'s place; whatever interrupts it, one of the two results is there."""
    if not force or not out.exists():
        try:
            # Atomic; on a folder that somebody filled meanwhile it fails instead of replacing it.
            os.rename(beside, out)
        except OSError as error:
            if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
                raise OutputError(
                    "exists", where=str(out), mend="choose another --out, or --force to replace it"
                ) from None
            raise
        return
    old = Path(tempfile.mkdtemp(prefix=f".{out.name}-old-", dir=out.parent))
    os.rename(out, old / out.name)
    try:
        os.rename(beside, out)
    except BaseException:
        os.rename(old / out.name, out)
        old.rmdir()
        raise
    # Ours by its marks, and already replaced: not a user's folder.
    shutil.rmtree(old, ignore_errors=True)


def _make_parents(parent: Path) -> list[Path]:
    missing = []
    while not parent.exists():
        missing.append(parent)
        parent = parent.parent
    made = []
    try:
        for folder in reversed(missing):
            folder.mkdir()
            made.append(folder)
    except OSError as error:
        raise OutputError(
            f"cannot be made ({error.strerror})", where=str(missing[0]), mend="choose another --out"
        ) from None
    return made


def _first_existing(path: Path) -> Path:
    while not path.exists():
        path = path.parent
    return path


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
