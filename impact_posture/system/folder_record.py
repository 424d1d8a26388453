"""Record of the files that this program wrote into a folder, with their SHA-256.

The record is the file ``.impact-posture.json`` in the folder.  A file is foreign if the record does not list it, and
changed if its SHA-256 differs from the record.  Files in a record of version 0.2, which contains no SHA-256, count as
unchanged.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

from impact_posture.system.scratch_folder import RECORD, SCHEMA, made_by
from impact_posture.system.text_files import open_regular, read_text

Kind = Literal["result", "export", "run", "comparison", "reproduction", "sweep", "world", "pictures"]


def write_record(folder: Path, kind: Kind, products: Iterable[str] = ()) -> None:
    """Write the record of a folder with all its files, and ``products``, which may be built later.

    Raises:
        OSError: The record cannot be written.
    """
    content = {"schema": SCHEMA, "kind": kind, "files": [], "products": sorted(products), **made_by()}
    (folder / RECORD).write_text(_with_files(content, folder), encoding="utf-8")


def extended_record(folder: Path, added: Path) -> str:
    """Return the record of ``folder`` with the files of another folder, ``added``, which move to ``folder``."""
    content = read_record(folder) or {"schema": SCHEMA, "kind": "pictures", "files": [], "products": []}
    return _with_files(content, added)


def _with_files(content: dict[str, Any], folder: Path) -> str:
    names = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if not path.is_dir()}
    hashes = {name: sha256_of(path) for name, path in names.items() if path.name != RECORD}
    content["files"] = sorted({*content["files"], *names})
    content["sha256"] = dict(sorted({**content.get("sha256", {}), **hashes}.items()))
    return json.dumps(content, indent=1) + "\n"


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file as hexadecimal digits."""
    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def typed_command(folder: Path) -> str:
    """Return the command line that wrote an output folder; empty if another program wrote the folder."""
    try:
        # Until a folder is complete, its record lists no files, and read_record returns None.
        return str(json.loads(read_text(folder / RECORD)).get("command", ""))
    except (OSError, ValueError, AttributeError, RecursionError):
        return ""


def own_files(folder: Path, kind: Kind) -> list[str]:
    """Return the files in the record of a folder, without the record itself; empty for a record of another kind."""
    content = read_record(folder)
    return [] if content is None or content["kind"] != kind else [name for name in content["files"] if name != RECORD]


def read_record(folder: Path) -> dict[str, Any] | None:
    """Return the record of a folder; ``None`` if the folder has no valid record."""
    try:
        content = json.loads(read_text(folder / RECORD))
    except (OSError, ValueError, RecursionError):
        return None
    if not isinstance(content, dict) or content.get("schema") != SCHEMA:
        return None
    lists = [content.get("files"), content.get("products")]
    sound = all(isinstance(names, list) and all(isinstance(name, str) for name in names) for names in lists)
    sound = sound and isinstance(content.get("sha256", {}), dict) and isinstance(content.get("kind"), str)
    return content if sound else None


def foreign_files(folder: Path, ours: frozenset[str] = frozenset(), below: str = "") -> list[str]:
    """Return the files and folders in a folder that neither ``ours`` nor a record in the folder lists, sorted.

    Names in ``ours`` and in the result begin with ``below``, the path of the folder.
    """
    content = read_record(folder)
    names = [] if content is None else [RECORD, *content["files"], *content["products"]]
    ours = ours.union(below + name for name in names)
    foreign = []
    for entry in sorted(os.scandir(folder), key=lambda e: e.name):
        name = below + entry.name
        if entry.is_dir(follow_symlinks=False):
            inside = any(path.startswith(f"{name}/") for path in ours) and not os.path.ismount(entry.path)
            foreign += foreign_files(Path(entry.path), ours, f"{name}/") if inside else [f"{name}/"]
        elif name not in ours or not entry.is_file(follow_symlinks=False):
            foreign.append(name)
    return foreign


def changed_files(folder: Path) -> list[str]:
    """Return the files that the record of a folder lists, but that were changed or replaced since then, sorted."""
    known = {*(read_record(folder) or {"files": []})["files"]}
    names = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir())
    return [name for name in names if name in known and not is_own(folder, name)]


def is_own(folder: Path, name: str, path: Path | None = None) -> bool:
    """Return whether this program wrote the file ``name`` into a folder, and nobody changed the file since then.

    ``path`` is the present path of the file, by default ``folder / name``.  A subfolder may have a newer record than
    the folder.  For example, ``c/`` in a result is an export.  Therefore both records count.
    """
    path = path or folder / name
    if not stat.S_ISREG(path.lstat().st_mode):
        return False
    if name == RECORD:
        return read_record(folder) is not None
    digest = sha256_of(path)
    for above in Path(name).parents:
        content = read_record(folder / above) or {"files": []}
        known = Path(name).relative_to(above).as_posix()
        if known in content["files"] and content.get("sha256", {}).get(known, digest) == digest:
            return True
    return False
