"""Output folders and temporary ones: whole or not at all, nothing left behind, never over what is not ours.

Each output folder holds a record, ``.impact-posture.json``, of the files that were written into it.  ``--force``
replaces a folder only if the record names everything that is there.

A temporary folder has the same file from its first moment on, locked by the process that works in it.  One that
nobody locks was left by a process that was killed, and the next one that works in the same place removes it.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

from impact_posture.errors import OutputError
from impact_posture.processes import signals_held, undone

RECORD = ".impact-posture.json"
SCHEMA = "impact-posture/folder/1"
_SCRATCH = ".impact-posture-"
_SHOWN = 3

Kind = Literal["result", "export", "run", "comparison", "reproduction", "runs"]


def check_output(out: Path, *, force: bool, kind: Kind) -> None:
    """Refuse an output folder early, before hours of work.

    Args:
        out: The folder to be written.
        force: Whether an existing folder of the same kind may be replaced.
        kind: What will be written there.

    Raises:
        OutputError: It exists, is no folder, holds what is not ours, cannot be replaced, or its parent cannot be
            written.
    """
    if out.is_symlink():
        raise OutputError("is a symbolic link", where=str(out), hint="name the folder that it leads to, or another")
    if os.path.lexists(out) and not out.is_dir():
        raise OutputError("exists and is no folder", where=str(out), hint="choose another --out")
    if Path(os.path.realpath(out)) in (Path.cwd(), *Path.cwd().parents):
        raise OutputError(
            "is the current folder or one around it", where=str(out), hint="choose a new folder, such as ./result"
        )
    if os.path.ismount(out):
        raise OutputError("is a mount point", where=str(out), hint="choose a folder in it")
    if out.is_dir() and any(out.iterdir()):
        if not force:
            raise OutputError("exists", where=str(out), hint="choose another --out, or --force to replace it")
        _check_ours(out, kind)
    parent = _first_existing(out.absolute().parent)
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        raise OutputError("cannot be written", where=str(parent), hint="choose another --out")


@contextmanager
def whole_folder(out: Path, *, force: bool, kind: Kind, products: Sequence[str] = ()) -> Iterator[Path]:
    """Yield a folder beside ``out`` to write into; on success it takes ``out``'s place, else nothing is left.

    Args:
        out: The folder to be written.
        force: Whether an existing folder of the same kind may be replaced.
        kind: What will be written.
        products: Files that what is written may make there later, such as libraries; they count as ours.

    Raises:
        OutputError: As :func:`check_output`, or the disk is full or not writable.
    """
    check_output(out, force=force, kind=kind)
    out = out.absolute()
    try:
        with _parents_of(out), _scratch(out.parent, 0o777) as beside:
            try:
                yield beside
            except OutputError as error:
                # The user knows the folder by its own name.
                raise OutputError(
                    error.what, where=error.where.replace(str(beside), str(out)), hint=error.hint
                ) from None
            write_record(beside, kind, products)
            with signals_held():
                _replace(beside, out, force, kind)
    except OSError as error:
        words = error.strerror or str(error)
        raise OutputError(
            f"cannot be written ({words})", where=str(out), hint="free space or choose another --out"
        ) from error


@contextmanager
def scratch_folder(parent: Path | None = None) -> Iterator[Path]:
    """Yield a temporary folder, nobody else's to read; it is gone behind the block, and when a signal ends us.

    Args:
        parent: Where; the system's folder for such things by default.

    Raises:
        OutputError: The system has no such folder.
        OSError: It cannot be made.
    """
    try:
        parent = Path(tempfile.gettempdir()) if parent is None else parent
    except FileNotFoundError:
        raise OutputError("no temporary folder can be written", where="TMPDIR", hint="set it to one") from None
    with _scratch(parent, 0o700) as folder:
        yield folder


def write_record(folder: Path, kind: Kind, products: Sequence[str] = ()) -> None:
    """Name everything in a folder as ours, and ``products`` that may be made there later.

    Raises:
        OSError: It cannot be written.
    """
    files = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir())
    content = {"schema": SCHEMA, "kind": kind, "files": files, "products": sorted(products)}
    (folder / RECORD).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def is_ours(folder: Path, kind: Kind) -> bool:
    """Whether a folder has the record of that kind; not whether nothing else is in it."""
    content = _read_record(folder)
    return content is not None and content["kind"] == kind


def add_to_record(folder: Path, paths: Iterable[Path]) -> None:
    """Name more files as ours in a folder that has a record; elsewhere nothing happens.

    Raises:
        OutputError: The record cannot be written.
    """
    content = _read_record(folder)
    if content is None:
        return
    added = {path.absolute().relative_to(folder.absolute()).as_posix() for path in paths}
    content["files"] = sorted(added.union(content["files"]))
    write_whole(folder / RECORD, json.dumps(content, indent=1) + "\n")


def write_whole(path: Path, text: str) -> None:
    """Write a file that appears whole or not at all.

    Raises:
        OutputError: The file cannot be written.
    """
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")

    def remove() -> None:
        with suppress(OSError):
            beside.unlink()

    try:
        with undone(remove):
            beside.write_text(text, encoding="utf-8", newline="\n")
            os.replace(beside, path)
    except OSError as error:
        hint = "check the disk and permissions"
        raise OutputError(f"cannot be written ({error.strerror})", where=str(path), hint=hint) from None


# ---- what is ours --------------------------------------------------------------------------------------------------


def _check_ours(out: Path, kind: Kind) -> None:
    content = _read_record(out)
    if content is not None and content["kind"] != kind:
        raise OutputError(
            f"holds another command's results ({content['kind']})", where=str(out), hint="choose another --out"
        )
    foreign = _foreign(out, set())
    if foreign:
        more = f" and {len(foreign) - _SHOWN} more" if len(foreign) > _SHOWN else ""
        raise OutputError(
            f"holds {', '.join(foreign[:_SHOWN])}{more}, which this command did not write",
            where=str(out),
            hint="choose another --out, or move that away: --force replaces earlier results only",
        )


def _foreign(folder: Path, ours: set[str], below: str = "") -> list[str]:
    """What a folder holds that neither ``ours`` nor its own record names, sorted."""
    content = _read_record(folder)
    names = [] if content is None else [RECORD, *content["files"], *content["products"]]
    ours = ours.union(below + name for name in names)
    found = []
    for entry in sorted(os.scandir(folder), key=lambda e: e.name):
        name = below + entry.name
        if entry.is_dir(follow_symlinks=False):
            inside = any(one.startswith(f"{name}/") for one in ours) and not os.path.ismount(entry.path)
            found += _foreign(Path(entry.path), ours, f"{name}/") if inside else [f"{name}/"]
        elif name not in ours or not entry.is_file(follow_symlinks=False):
            found.append(name)
    return found


def _read_record(folder: Path) -> dict[str, Any] | None:
    try:
        content = json.loads((folder / RECORD).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    if not isinstance(content, dict) or content.get("schema") != SCHEMA:
        return None
    lists = [content.get("files"), content.get("products")]
    sound = all(isinstance(names, list) and all(isinstance(name, str) for name in names) for names in lists)
    return content if sound and isinstance(content.get("kind"), str) else None


# ---- taking a place ------------------------------------------------------------------------------------------------


def _replace(beside: Path, out: Path, force: bool, kind: Kind) -> None:
    """Put ``beside`` in ``out``'s place; whatever interrupts it, one of the two results is there."""
    if not force or not out.exists():
        try:
            # Atomic; on a folder that somebody filled meanwhile it fails instead of replacing it.
            os.rename(beside, out)
        except OSError as error:
            if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
                raise OutputError(
                    "exists", where=str(out), hint="choose another --out, or --force to replace it"
                ) from None
            raise
        return
    # A name that is never swept: killed between the two renames, the old result waits there for its user.
    old = out.with_name(f"{out.name}.old-{secrets.token_hex(4)}")
    os.rename(out, old)
    try:
        # Again, where nobody else writes any more.
        if any(old.iterdir()):
            _check_ours(old, kind)
        os.rename(beside, out)
    except BaseException:
        os.rename(old, out)
        raise
    swept = out.with_name(f"{_SCRATCH}{secrets.token_hex(4)}")
    os.rename(old, swept)
    _remove(swept)


@contextmanager
def _parents_of(out: Path) -> Iterator[None]:
    """Make the folders above ``out``; those that stay empty go again."""
    missing = [folder for folder in out.parents if not folder.exists()]

    def remove() -> None:
        with suppress(OSError):
            for folder in missing:
                folder.rmdir()

    with undone(remove):
        try:
            for folder in reversed(missing):
                folder.mkdir(exist_ok=True)
        except OSError as error:
            raise OutputError(
                f"cannot be made ({error.strerror})", where=str(missing[-1]), hint="choose another --out"
            ) from None
        yield


def _first_existing(path: Path) -> Path:
    while not path.exists():
        path = path.parent
    return path


# ---- temporary folders ---------------------------------------------------------------------------------------------


@contextmanager
def _scratch(parent: Path, mode: int) -> Iterator[Path]:
    _sweep(parent)
    folder = parent / f"{_SCRATCH}{secrets.token_hex(4)}"
    # Before it exists: no signal falls between.
    with undone(lambda: _remove(folder)):
        folder.mkdir(mode)
        record = os.open(folder / RECORD, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        try:
            # Where nothing can be locked, nothing is swept either.
            with suppress(OSError):
                fcntl.flock(record, fcntl.LOCK_EX)
            # After the lock: who finds the record unlocked finds it empty, and leaves it alone.
            os.write(record, json.dumps({"schema": SCHEMA, "host": os.uname().nodename}).encode())
            yield folder
        finally:
            os.close(record)


def _sweep(parent: Path) -> None:
    """Remove the temporary folders here that a process of ours has left that is gone."""
    with suppress(OSError):
        for folder in parent.glob(f"{_SCRATCH}*"):
            with suppress(OSError, ValueError, RecursionError):
                _sweep_one(folder)


def _sweep_one(folder: Path) -> None:
    if folder.is_symlink() or folder.stat().st_uid != os.geteuid():
        return
    record = os.open(folder / RECORD, os.O_RDWR | os.O_NOFOLLOW)
    try:
        # Fails where its process is alive.
        fcntl.flock(record, fcntl.LOCK_EX | fcntl.LOCK_NB)
        content = json.loads(os.read(record, 1 << 24))
        # Locks may not reach across machines.  A folder that was moved away as a whole names no machine.
        if content["schema"] == SCHEMA and content.get("host", os.uname().nodename) == os.uname().nodename:
            _remove(folder)
    except (KeyError, TypeError):
        return
    finally:
        os.close(record)


def _remove(folder: Path) -> None:
    """Remove a temporary folder, its record last: what is interrupted is still known as ours."""
    with suppress(OSError):
        for entry in os.scandir(folder):
            if entry.is_dir(follow_symlinks=False):
                shutil.rmtree(entry.path, ignore_errors=True)
            elif entry.name != RECORD:
                os.unlink(entry.path)
    shutil.rmtree(folder, ignore_errors=True)
