"""Commands in unusual environments: closed streams, read-only folders, settings of other programs."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

COMMAND = str(Path(sys.executable).parent / "impact-posture")
PUSH = ("tilthex_arm", "--normal", "0", "0", "1")
FULL = pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")


@pytest.mark.parametrize(
    ("line", "code", "err"),
    [
        ('"$0" inspect talos | head -1 >/dev/null; exit ${PIPESTATUS[0]}', {0, 1}, ""),
        ('"$0" inspect talos 2>&1 | head -1 >/dev/null; exit ${PIPESTATUS[0]}', {0, 1}, ""),
        ('"$0" robots >&-', {0}, ""),
        ('"$0" robots --json >&-', {0}, ""),
        ('"$0" robots 2>&-', {0}, ""),
        ('"$0" robots <&- >&- 2>&-', {0}, ""),
        ('"$0" inspect nonsense 2>&-', {1}, ""),
        ('"$0" nonsense 2>&- >&-', {2}, ""),
        pytest.param('"$0" robots >/dev/full', {1}, "error: No space left on device; free some space\n", marks=FULL),
        pytest.param('"$0" inspect nonsense 2>/dev/full', {1}, "", marks=FULL),
    ],
)
def test_streams_that_are_closed_or_full(line: str, code: set[int], err: str) -> None:
    done = subprocess.run(["bash", "-c", line, COMMAND], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode in code and done.stderr == err


def test_files_never_take_the_number_of_a_closed_stream(tmp_path: Path) -> None:
    """If standard output is closed, the next opened file gets its descriptor; no library may print into this file."""
    line = f'{sys.executable} -c "$1" >&- 2>&-'
    program = (
        "import os, sys\nfrom impact_posture_cli.process import prepare\nprepare()\n"
        "os.open('file', os.O_WRONLY | os.O_CREAT)\nos.write(1, b'noise')\nos.write(2, b'noise')\nprint('noise')\n"
    )
    done = subprocess.run(["bash", "-c", line, "bash", program], cwd=tmp_path, timeout=60, check=False)
    assert done.returncode == 0
    assert (tmp_path / "file").read_bytes() == b""


# Python finds no folder for temporary files.  A read-only folder would not have this effect for the user root.
NO_TEMPORARY_FOLDER = """
import sys, tempfile
def refuse():
    raise FileNotFoundError(2, "No usable temporary directory found")
tempfile._get_default_tempdir, tempfile.tempdir = refuse, None
from impact_posture_cli.main import main
main()
"""


@pytest.mark.parametrize("arguments", [("inspect", "talos"), ("evaluate", *PUSH)], ids=lambda a: a[0])
def test_reading_needs_no_temporary_folder(arguments: tuple[str, ...]) -> None:
    done = subprocess.run(
        [sys.executable, "-c", NO_TEMPORARY_FOLDER, *arguments, "--quiet"], capture_output=True, text=True,
        timeout=60, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert len(done.stdout) > 300


def test_what_needs_a_temporary_folder_says_so(tmp_path: Path) -> None:
    arguments = ("codegen", *PUSH, "--compile", "--out", "out")
    done = subprocess.run(
        [sys.executable, "-c", NO_TEMPORARY_FOLDER, *arguments, "--quiet"], capture_output=True, text=True,
        timeout=60, cwd=tmp_path, check=False,
    )  # fmt: skip
    assert done.returncode in (0, 1) and "Traceback" not in done.stderr
    assert done.returncode == 0 or "TMPDIR: no temporary folder can be written" in done.stderr


def test_the_backend_of_a_notebook_is_not_ours() -> None:
    program = (
        "from impact_posture_cli.process import prepare as p\np()\nimport matplotlib as m\nprint(m.get_backend())"
    )
    notebook = {"MPLBACKEND": "module://matplotlib_inline.backend_inline"}
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False,
        env=os.environ | notebook,
    )  # fmt: skip
    assert (done.stdout, done.stderr) == ("agg\n", "")


@pytest.mark.long
def test_pictures_whatever_the_backend_and_without_noise(tmp_path: Path) -> None:
    nothing = "/proc/nothing"
    # NumPy and Matplotlib read the date of a reproducible build.
    settings = {"MPLBACKEND": "nonsense", "SOURCE_DATE_EPOCH": "abc"}
    settings |= {"MPLCONFIGDIR": nothing, "HOME": nothing, "XDG_CACHE_HOME": ""}
    (tmp_path / "temporary").mkdir()
    done = subprocess.run(
        [COMMAND, "optimize", *PUSH, "--starts", "1", "--no-codegen", "--format", "svg", "--out", "out"],
        capture_output=True, text=True, timeout=120, cwd=tmp_path, check=False,
        env=os.environ | settings | {"TMPDIR": str(tmp_path / "temporary")},
    )  # fmt: skip
    assert (done.returncode, done.stderr.strip()) == (0, "")
    assert (tmp_path / "out" / "jump.svg").stat().st_size > 3000
    assert not list((tmp_path / "temporary").iterdir())
