"""Write output folders completely or not at all, and never overwrite files of the user without ``--force``.

A file belongs to the user unless the record of its folder lists it with its SHA-256
(:mod:`impact_posture.system.folder_record`).  :func:`whole_folder` makes a new folder.  ``--force`` replaces an
existing folder, with all changes in it, but only if the folder contains no foreign files.  :func:`added_files` adds
files to a folder.  ``--force`` replaces only the files with the same names.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import secrets
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from impact_posture.errors import OutputError, listed, remedy
from impact_posture.system.folder_record import (
    Kind,
    changed_files,
    extended_record,
    foreign_files,
    is_own,
    read_record,
    write_record,
)
from impact_posture.system.processes import signals_held, undone
from impact_posture.system.scratch_folder import RECORD, SCRATCH, remove_killed, remove_scratch, scratch_folder

# Number of foreign files that a message names.
_SHOWN = 3
_EXISTS = "choose another `out`, or give `force` to replace it"


def check_output(out: Path, *, force: bool, kind: Kind) -> None:
    """Raise an error if an output folder cannot be used.  ``force`` allows a folder with an earlier result.

    Raises:
        OutputError: The path is not a folder, the folder exists and ``force`` is false, the folder has foreign files,
            or the folder cannot be written.
    """
    check_name(out)
    if out.is_symlink():
        raise OutputError("is a symbolic link", where=str(out), hint="name the target of the link, or another folder")
    if os.path.lexists(out) and not out.is_dir():
        raise OutputError("exists and is not a folder", where=str(out), hint="choose another `out`")
    if Path(os.path.realpath(out)) in (Path.cwd(), *Path.cwd().parents):
        fault = "is the current folder or a folder around it"
        raise OutputError(fault, where=str(out), hint="choose a new folder, such as ./result")
    if os.path.ismount(out):
        raise OutputError("is a mount point", where=str(out), hint="choose a folder in it")
    if out.is_dir() and any(out.iterdir()):
        if not force:
            changed = changed_files(out)
            edited = f", and it holds changes of yours in {listed(changed, _SHOWN)}" if changed else ""
            raise OutputError(f"exists{edited}", where=str(out), hint=_EXISTS)
        _check_ours(out, kind)
        # In a parent folder that everyone may write to, another user can own the folder.
        if not os.access(out, os.W_OK | os.X_OK):
            raise OutputError(
                "cannot be replaced, because its files cannot be deleted", where=str(out), hint="choose another `out`"
            )
    parent = next(folder for folder in out.absolute().parents if folder.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        raise OutputError("cannot be written", where=str(parent), hint="choose another `out`")


def check_name(out: Path) -> None:
    """Raise an error if no file or folder can have this name.

    Raises:
        OutputError: The system rejects the name.
    """
    try:
        os.lstat(out)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except (OSError, ValueError) as error:
        raise OutputError.unwritable(out, error, "choose another name") from None


@contextmanager
def whole_folder(out: Path, *, force: bool, kind: Kind, products: Sequence[str] = ()) -> Iterator[Path]:
    """Yield a temporary folder, which replaces ``out`` after the block and is removed after an error.

    ``products`` are files that may be built later in the folder, such as libraries.  They are not foreign.

    Raises:
        OutputError: ``out`` cannot be used (:func:`check_output`), or the disk is full or not writable.
    """
    check_output(out, force=force, kind=kind)
    out = out.absolute()
    try:
        with parents_of(out), scratch_folder(out.parent, 0o777) as beside:
            try:
                yield beside
            except OutputError as error:
                raise _renamed(error, beside, out) from None
            write_record(beside, kind, products)
            with signals_held():
                _replace(beside, out, force, kind)
    except OSError as error:
        raise _unwritable(out, error, "free space or choose another `out`") from error


@contextmanager
def added_files(folder: Path, *, force: bool) -> Iterator[Path]:
    """Yield a temporary folder; after the block, its files move to ``folder`` and into the record of ``folder``.

    An existing file is replaced if this program wrote it and nobody changed it, or if ``force`` is true.  If an
    existing file must not be replaced, or after any other error, no file of ``folder`` changes.

    Raises:
        OutputError: A file of the user would be replaced, or ``folder`` cannot be written.
    """
    check_name(folder)
    out = folder.absolute()
    try:
        with parents_of(out / RECORD), scratch_folder(out) as beside:
            new, old = beside / "new", beside / "old"
            new.mkdir()
            old.mkdir()
            try:
                yield new
            except OutputError as error:
                raise _renamed(error, new, folder) from None
            names = sorted(os.listdir(new))
            with used_alone(folder, out), signals_held():
                (new / RECORD).write_text(extended_record(folder, new), encoding="utf-8")
                _move([*names, RECORD], new, folder, old, force)
    except OSError as error:
        raise _unwritable(folder, error, "free space or choose another folder") from error


def _unwritable(out: Path, error: OSError, hint: str) -> OutputError:
    """Return the error for a folder that cannot be written.  If another file causes it, the error names this file."""
    cause = Path(os.fsdecode(error.filename) if isinstance(error.filename, str | bytes) else out).absolute()
    whole = out.absolute()
    inside = whole in (cause, *cause.parents) or cause == whole.parent
    if inside or any(part.startswith(SCRATCH) for part in cause.parts):
        return OutputError.unwritable(out, error, hint)
    fault = f"cannot be written, because of {cause} ({error.strerror})"
    return OutputError(fault, where=str(out), hint=remedy(error, "check that file and its permissions"))


def _move(names: Sequence[str], new: Path, out: Path, old: Path, force: bool) -> None:
    """Move all files from ``new`` to ``out``, or none.  ``old`` gets links to the replaced files."""
    for name in names:
        if os.path.lexists(out / name):
            _check_replaceable(out, name, out / name, force)
    moved = []
    try:
        for name in names:
            _place(new / name, out / name, old / name)
            moved.append(name)
            if os.path.lexists(old / name):
                # Check again, because the file may have been changed since the first check.
                _check_replaceable(out, name, old / name, force)
    except BaseException:
        for name in names:
            if os.path.lexists(old / name):
                os.replace(old / name, out / name)
            elif name in moved:
                os.unlink(out / name)
        raise


def _place(new: Path, target: Path, old: Path) -> None:
    """Move the file ``new`` to ``target``.  A file that exists at ``target`` is kept as the hard link ``old``."""
    if os.path.lexists(target):
        _link(target, old)
        os.replace(new, target)
    else:
        _link(new, target)


def _check_replaceable(folder: Path, name: str, path: Path, force: bool) -> None:
    """Raise an error if the file ``name`` of a folder must not be replaced; ``path`` is where the file is now."""
    where = str(folder / name)
    if path.is_dir() and not path.is_symlink():
        raise OutputError("is a folder", where=where, hint="move it away")
    if not force and not is_own(folder, name, path):
        fault = "was not written by this program, or was changed since"
        raise OutputError(fault, where=where, hint="move it away, or give `force` to replace it")


def _link(source: Path, target: Path) -> None:
    """Make a hard link, which never replaces a file; move the file if the file system has no hard links."""
    try:
        os.link(source, target, follow_symlinks=False)
    except FileExistsError:
        hint = "run the command again"
        raise OutputError("was written by another program meanwhile", where=str(target), hint=hint) from None
    except OSError:
        os.rename(source, target)


def _renamed(error: OutputError, temporary: Path, final: Path) -> OutputError:
    """Return the error with the final folder, because the user does not know the temporary folder."""
    return OutputError(error.what, where=error.where.replace(str(temporary), str(final)), hint=error.hint)


def write_json(path: Path, document: object) -> None:
    """Write a document as JSON.  A NaN raises a ``ValueError``, because JSON has no NaN."""
    path.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file completely or not at all.

    Raises:
        OutputError: The file cannot be written.
    """
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")

    def remove() -> None:
        with suppress(OSError):
            beside.unlink()

    try:
        with undone(remove):
            beside.unlink(missing_ok=True)
            # Mode x never opens an existing file, such as a symbolic link of another user.
            with beside.open("xb") as file:
                file.write(content.encode() if isinstance(content, str) else content)
            os.replace(beside, path)
    except OSError as error:
        raise OutputError.unwritable(path, error, "check the disk and permissions") from None


def _check_ours(out: Path, kind: Kind) -> None:
    content = read_record(out)
    if content is not None and content["kind"] not in (kind, "pictures"):
        fault = f"holds another command's results ({content['kind']})"
        raise OutputError(fault, where=str(out), hint="choose another `out`")
    remove_killed(out)
    foreign = foreign_files(out)
    if foreign:
        fault = f"holds {listed(foreign, _SHOWN)}, which this command did not write"
        hint = "choose another `out`, or move these files away: `force` replaces only earlier results"
        raise OutputError(fault, where=str(out), hint=hint)


def _replace(beside: Path, out: Path, force: bool, kind: Kind) -> None:
    """Replace ``out`` by ``beside``.  After an interruption at any time, the old or the new folder exists."""
    if not force or not out.exists():
        try:
            # The rename is atomic.  The rename fails if another process has filled the folder in the meantime.
            os.rename(beside, out)
        except OSError as error:
            if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
                raise OutputError("exists", where=str(out), hint=_EXISTS) from None
            raise
        return
    # scratch_folder does not remove a folder of this name.  If the process is killed between the two renames, the old
    # result remains in ``old``.
    old = out.with_name(f"{out.name}.old-{secrets.token_hex(4)}")
    os.rename(out, old)
    try:
        # Check again, because after the rename no other process writes into the old folder.
        if any(old.iterdir()):
            _check_ours(old, kind)
        os.rename(beside, out)
    except BaseException:
        os.rename(old, out)
        raise
    swept = out.with_name(f"{SCRATCH}{secrets.token_hex(4)}")
    os.rename(old, swept)
    remove_scratch(swept)


@contextmanager
def used_alone(folder: Path, lock: Path) -> Iterator[None]:
    """Lock the file or folder ``lock`` during the block, so that no other command uses ``folder``.

    Raises:
        OutputError: Another command uses the folder.
    """
    descriptor = os.open(lock, os.O_RDONLY | os.O_NONBLOCK)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            hint = "wait until it ends, or choose another folder"
            raise OutputError("is in use by another command", where=str(folder), hint=hint) from None
        except OSError:
            # Some file systems do not support locks.  Folders on these file systems are not locked.
            pass
        yield
    finally:
        os.close(descriptor)


@contextmanager
def parents_of(out: Path) -> Iterator[None]:
    """Make the folders above ``out``.  After the block, remove the new folders that are empty."""
    missing = [folder for folder in out.parents if not folder.exists()]

    def remove() -> None:
        for folder in missing:
            with suppress(OSError):
                folder.rmdir()

    with undone(remove):
        try:
            for folder in reversed(missing):
                folder.mkdir(exist_ok=True)
        except OSError as error:
            raise OutputError.unwritable(Path(error.filename), error, "choose another folder") from None
        yield
