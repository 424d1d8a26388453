"""Only regular files are read."""

from __future__ import annotations

import ast
import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

import impact_posture
from impact_posture.system.text_files import MOST_BYTES, MOST_CHARACTERS, open_regular, read_bytes, read_text

ROOT = Path(impact_posture.__file__).parent
# Modules that may open files without ``open_regular``, because users do not provide these files, and what they read.
ALLOWED = {
    "text_files.py": "opens regular files",
    "isolated_calls.py": "reads files of the kernel",
    "mesh_file.py": "reads members of an archive that is open",
    "npz_files.py": "reads arrays from a file that is open",
    "daqp_sources.py": "reads members of an archive that is open",
    "controller_source.py": "reads files of this package",
    "compiled_world.py": "reads files of this package",
    "report_page.py": "reads files of this package",
    "export_controller.py": "reads files that it has written into a temporary folder",
    "libraries.py": "reads files of this package and output of the preprocessor",
    "jax_metric.py": "reads a header of JAX",
    "output_folder.py": "opens a lock without waiting",
    "scratch_folder.py": "opens a lock without waiting",
    "path_files.py": "writes",
    "scenario_objective.py": "writes a lock in the cache",
}


def readers(path: Path) -> Iterator[str]:
    """Yield the calls in a module that could open a file for reading."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.Call):
            continue
        name = ast.unparse(node.func)
        # Calls of functions of text_files have no dot in their names, so they are not counted.
        of_module = name in ("np.load", "ET.parse", "json.load", "tomllib.load", "yaml.load", "pickle.load")
        method = name.rpartition(".")[2] in ("open", "read_text", "read_bytes") and "." in name
        if name == "open" or method or of_module:
            yield f"{path.name}:{node.lineno} {name}"


def test_all_modules_read_files_of_users_by_open_regular() -> None:
    calls = {path.name: list(readers(path)) for path in ROOT.rglob("*.py")}
    assert [call for name, each in calls.items() if name not in ALLOWED for call in each] == []
    assert [name for name in ALLOWED if not calls[name]] == []


@pytest.mark.parametrize("kind", ["pipe", "socket", "device", "link to a pipe"])
@pytest.mark.parametrize("read", [open_regular, read_bytes, read_text])
def test_other_files_are_refused(kind: str, read: object, tmp_path: Path) -> None:
    path = tmp_path / "file"
    if kind == "socket":
        with socket.socket(socket.AF_UNIX) as server:
            server.bind(str(path))
    elif kind == "device":
        path = Path("/dev/zero")
    else:
        os.mkfifo(tmp_path / "pipe")
        path.symlink_to("pipe")
    with pytest.raises(OSError, match=r"not a regular file|No such device") as caught:
        read(path)  # type: ignore[operator]
    assert caught.value.filename == str(path)


def test_regular_files_and_the_null_device_are_read(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"\xef\xbb\xbfa")
    (tmp_path / "link").symlink_to("file")
    assert read_text(tmp_path / "link") == "a" and read_bytes(tmp_path / "file") == b"\xef\xbb\xbfa"
    assert read_text(Path(os.devnull)) == ""
    with pytest.raises(IsADirectoryError):
        read_text(tmp_path)


def test_huge_files_are_refused(tmp_path: Path) -> None:
    """The files are sparse, so they need no space on the disk."""
    for read, size in ((read_text, MOST_CHARACTERS), (read_bytes, MOST_BYTES)):
        (tmp_path / "file").touch()
        os.truncate(tmp_path / "file", size + 1)
        with pytest.raises(OSError, match="too large"):
            read(tmp_path / "file")
