"""Write output folders completely or not at all, and never overwrite foreign files.

The file ``.impact-posture.json`` in an output folder, called the record, lists the files that were written into the
folder.  Other files are called foreign.  ``--force`` replaces a folder only if it contains no foreign files.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import secrets
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

from impact_posture.errors import OutputError, listed
from impact_posture.system.processes import signals_held, undone
from impact_posture.system.scratch_folder import RECORD, SCHEMA, SCRATCH, made_by, remove_scratch, scratch_folder
from impact_posture.system.text_files import read_text

# Number of foreign files that a message names.
_SHOWN = 3
_EXISTS = "choose another `out`, or `force` to replace it"

Kind = Literal["result", "export", "run", "comparison", "reproduction", "sweep", "world"]


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
            raise OutputError("exists", where=str(out), hint=_EXISTS)
        _check_ours(out, kind)
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
        raise OutputError.unwritable(out, error, "choose another `out`") from None


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
                # Name the final folder, because the user does not know the temporary folder.
                where = error.where.replace(str(beside), str(out))
                raise OutputError(error.what, where=where, hint=error.hint) from None
            write_record(beside, kind, products)
            with signals_held():
                _replace(beside, out, force, kind)
    except OSError as error:
        reason = error.strerror or str(error)
        if isinstance(error, FileNotFoundError) and error.filename:
            # Name the missing file, because it may be outside the folder.
            reason = f"{reason}: {error.filename}"
        fault = f"cannot be written ({reason})"
        raise OutputError(fault, where=str(out), hint="free space or choose another `out`") from error


def write_record(folder: Path, kind: Kind, products: Sequence[str] = ()) -> None:
    """Write the record of a folder: all its files, and ``products``, which may be built later.

    Raises:
        OSError: The record cannot be written.
    """
    files = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir())
    content = {"schema": SCHEMA, "kind": kind, "files": files, "products": sorted(products), **made_by()}
    write_json(folder / RECORD, content)


def typed_command(folder: Path) -> str:
    """Return the command line that wrote an output folder; empty if another program wrote the folder."""
    try:
        return str(json.loads(read_text(folder / RECORD)).get("command", ""))
    except (OSError, ValueError, AttributeError, RecursionError):
        return ""


def is_ours(folder: Path, kind: Kind) -> bool:
    """Return whether ``kind`` is in the record of a folder.  The folder may also contain foreign files."""
    content = _read_record(folder)
    return content is not None and content["kind"] == kind


def own_files(folder: Path, kind: Kind) -> list[str]:
    """Return the files in the record of a folder, without the record itself; empty for a record of another kind."""
    content = _read_record(folder)
    return [] if content is None or content["kind"] != kind else [name for name in content["files"] if name != RECORD]


def add_to_record(folder: Path, paths: Iterable[Path]) -> None:
    """Add files to the record of a folder; do nothing if the folder has no record.

    Raises:
        OutputError: The record cannot be written.
    """
    content = _read_record(folder)
    if content is None:
        return
    added = {path.absolute().relative_to(folder.absolute()).as_posix() for path in paths}
    content["files"] = sorted(added.union(content["files"]))
    write_whole(folder / RECORD, json.dumps(content, indent=1) + "\n")


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
    content = _read_record(out)
    if content is not None and content["kind"] != kind:
        fault = f"holds another command's results ({content['kind']})"
        raise OutputError(fault, where=str(out), hint="choose another `out`")
    foreign = _foreign(out, set())
    if foreign:
        fault = f"holds {listed(foreign, _SHOWN)}, which this command did not write"
        hint = "choose another `out`, or move that away: `force` replaces earlier results only"
        raise OutputError(fault, where=str(out), hint=hint)


def _foreign(folder: Path, ours: set[str], below: str = "") -> list[str]:
    """Return the names in a folder that are neither in ``ours`` nor in the record of the folder, sorted."""
    content = _read_record(folder)
    names = [] if content is None else [RECORD, *content["files"], *content["products"]]
    ours = ours.union(below + name for name in names)
    foreign = []
    for entry in sorted(os.scandir(folder), key=lambda e: e.name):
        name = below + entry.name
        if entry.is_dir(follow_symlinks=False):
            inside = any(path.startswith(f"{name}/") for path in ours) and not os.path.ismount(entry.path)
            foreign += _foreign(Path(entry.path), ours, f"{name}/") if inside else [f"{name}/"]
        elif name not in ours or not entry.is_file(follow_symlinks=False):
            foreign.append(name)
    return foreign


def _read_record(folder: Path) -> dict[str, Any] | None:
    try:
        content = json.loads(read_text(folder / RECORD)) if (folder / RECORD).is_file() else None
    except (OSError, ValueError, RecursionError):
        return None
    if not isinstance(content, dict) or content.get("schema") != SCHEMA:
        return None
    lists = [content.get("files"), content.get("products")]
    sound = all(isinstance(names, list) and all(isinstance(name, str) for name in names) for names in lists)
    return content if sound and isinstance(content.get("kind"), str) else None


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
    # result remains there.
    old = out.with_name(f"{out.name}.old-{secrets.token_hex(4)}")
    os.rename(out, old)
    try:
        # Check again: since the rename, no other process writes into the old folder.
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
    descriptor = os.open(lock, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            hint = "wait until it ends, or choose another `out`"
            raise OutputError("is in use by another command", where=str(folder), hint=hint) from None
        except OSError:
            # Some file systems do not support locks.  On them, the folder is not locked.
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
            raise OutputError.unwritable(Path(error.filename), error, "choose another `out`") from None
        yield
