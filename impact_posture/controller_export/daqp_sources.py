"""C sources of DAQP, the QP solver of an exported controller, in one version whose content is checked.

pip downloads the source distribution from PyPI once, but neither builds nor runs the distribution.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import re
import subprocess
import sys
import tarfile
from collections.abc import Callable
from pathlib import Path

from impact_posture.errors import InputError
from impact_posture.system.libraries import building, cache_folder, is_cached
from impact_posture.system.text_files import open_regular, read_bytes

VERSION = "0.11.0"
SOURCES = ("auxiliary.c", "daqp.c", "factorization.c")
_HEADERS = ("auxiliary.h", "constants.h", "daqp.h", "factorization.h", "types.h")
# Two hashes: SHA-256 of the source distribution, which pip checks, and SHA-256 of all files in FILES, joined in
# order.
_ARCHIVE_SHA256 = "2f27baf18d2acca14186498e651b34e0bed455627e777d3fd8ba655e7e40f920"
_CONTENT_SHA256 = "7cce7844f7cf515e8c1fe9208e3996b0569c954ef641ad5b3478657ee23a6e9d"
# Path of each file in the distribution.  In an exported controller, all files are in one folder.
FILES = {
    **{name: f"csrc/src/{name}" for name in SOURCES},
    **{name: f"csrc/include/{name}" for name in _HEADERS},
    "LICENSE": "LICENSE",
}
# Largest permitted size of a file, bytes.
_LARGEST = 1 << 20
# Build backend that only returns the metadata that pip requires.  The build backend of DAQP would run code of the
# distribution, which takes minutes.
_BACKEND = f"""
import pathlib
def prepare_metadata_for_build_wheel(folder, settings=None):
    info = pathlib.Path(folder, "daqp-{VERSION}.dist-info")
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\\nName: daqp\\nVersion: {VERSION}\\n")
    return info.name
"""
_FOLDER_HINT = f"give the folder of DAQP {VERSION}'s sources with `daqp`"


def daqp_sources(folder: Path | None = None) -> dict[str, bytes]:
    """Return file name → content for the files in :data:`FILES`.

    Args:
        folder: Unpacked source distribution, or a folder that directly contains the files.  With ``None``, the
            distribution in the cache is used; if it is missing, pip downloads it.

    Raises:
        InputError: The sources are not available, or belong to another version than :data:`VERSION`.
        OutputError: The cache cannot be written, or other users may write to it.
    """
    if folder is not None:
        return _checked(lambda name: _from_folder(folder, name), str(folder), _FOLDER_HINT)
    archive, again = cache_folder() / f"daqp-{VERSION}.tar.gz", "delete it; the next run downloads it again"
    if not is_cached(archive):
        with building(archive) as place:
            _download(place)
    try:
        with open_regular(archive) as file, tarfile.open(fileobj=file) as tar:
            return _checked(lambda name: _from_archive(tar, name), str(archive), again)
    except (OSError, EOFError, tarfile.TarError) as error:
        raise InputError.unreadable(archive, error, again) from None


def renamed(sources: dict[str, bytes], prefix: str) -> dict[str, str]:
    """Return a header and a source file that add ``prefix`` to the names of all DAQP functions.

    Without the prefix, names collide in a program that contains two controllers or another DAQP.
    """
    headers = "".join(sources[name].decode() for name in _HEADERS)
    names = re.findall(r"^(?:void|int|c_float) (\w+)\(", headers, re.MULTILINE)
    renames = "".join(f"#define {name} {prefix}_{name}\n" for name in sorted(names))
    header = f"""/* DAQP {VERSION}.  The names of its functions begin with the prefix of this controller, unless an
 * installed DAQP is linked. */
#ifndef {prefix.upper()}_INSTALLED_DAQP
{renames}#endif
#include "daqp.h"
"""
    includes = "".join(f'#include "{name}"\n' for name in SOURCES)
    return {f"{prefix}_daqp.h": header, f"{prefix}_daqp.c": f'#include "{prefix}_daqp.h"\n{includes}'}


def _checked(read: Callable[[str], bytes | None], where: str, hint: str) -> dict[str, bytes]:
    """Read all files; raise :class:`InputError` if a file is missing or the contents have the wrong hash."""
    sources, digest = dict[str, bytes](), hashlib.sha256()
    for name in FILES:
        content = read(name)
        if content is None:
            raise InputError(f"has no file {FILES[name]}", where=where, hint=hint)
        sources[name] = content
        digest.update(content)
    if digest.hexdigest() != _CONTENT_SHA256:
        raise InputError(f"is not DAQP {VERSION} (another SHA-256 of its sources)", where=where, hint=hint)
    return sources


def _from_folder(folder: Path, name: str) -> bytes | None:
    for path in (folder / FILES[name], folder / name):
        try:
            if path.is_file() and path.stat().st_size <= _LARGEST:
                return read_bytes(path)
        except OSError as error:
            raise InputError.unreadable(path, error, _FOLDER_HINT) from None
    return None


def _from_archive(tar: tarfile.TarFile, name: str) -> bytes | None:
    """Return the content of a regular file in the archive, or ``None`` if there is no such file.

    The archive is not unpacked, so names and links in the archive cannot change other files.
    """
    try:
        member = tar.getmember(f"daqp-{VERSION}/{FILES[name]}")
    except KeyError:
        return None
    file = tar.extractfile(member) if member.isreg() and member.size <= _LARGEST else None
    return None if file is None else file.read()


def _download(folder: Path) -> None:
    if importlib.util.find_spec("pip") is None:
        raise InputError("pip is missing", where=f"DAQP {VERSION}", hint=f"install pip, or {_FOLDER_HINT}")
    backend, wanted = folder / "backend" / "setuptools", folder / "wanted.txt"
    backend.mkdir(parents=True)
    (backend / "__init__.py").touch()
    (backend / "build_meta.py").write_text(_BACKEND, encoding="utf-8")
    wanted.write_text(f"daqp=={VERSION} --hash=sha256:{_ARCHIVE_SHA256}\n", encoding="utf-8")
    options = ["--no-deps", "--no-build-isolation", "--no-binary", "daqp", "--require-hashes"]
    run = subprocess.run(
        [sys.executable, "-m", "pip", "download", *options, "-r", str(wanted), "-d", str(folder)],
        env=os.environ | {"PYTHONPATH": str(backend.parent), "PIP_RETRIES": "1", "PIP_TIMEOUT": "20"},
        capture_output=True,
        text=True,
        errors="replace",
    )
    if run.returncode:
        lines = [line for line in run.stderr.splitlines() if line.startswith("ERROR")] or ["ERROR: no message"]
        what = f"its sources cannot be downloaded ({lines[-1].removeprefix('ERROR: ')})"
        raise InputError(what, where=f"DAQP {VERSION}", hint=f"connect to the network once, or {_FOLDER_HINT}")
