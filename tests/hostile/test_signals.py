"""Signals at random times end the process with one error line and leave no files or processes.

``--hostile-full`` sends more signals.
"""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

COMMAND = Path(sys.executable).parent / "impact-posture"
PUSH = ("tilthex_arm", "--normal", "0", "0", "1")
# Commands, and the minimum processor time of their first process, s.
COMMANDS = {
    "evaluate": (("evaluate", *PUSH), 0.7),
    "codegen": (("codegen", *PUSH, "--compile", "--out", "deep/er/out"), 1.0),
    "optimize": (("optimize", *PUSH, "--starts", "6", "--jobs", "2", "--quiet", "--out", "out"), 1.5),
    "simulate": (("simulate", "solo8-push", "--quiet", "--out", "out"), 3.0),
}
SIGNALS = (signal.SIGINT, signal.SIGINT, signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
TICKS = os.sysconf("SC_CLK_TCK")

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="looks at processes in /proc")


def caught(pid: int) -> int:
    """Return the signals that a process handles, as a bit mask."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("SigCgt"):
            return int(line.split()[1], 16)
    return 0


def busy(pid: int) -> float:
    """Return the processor time that a process has used, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def session(leader: int) -> list[str]:
    """Return the command lines of the running processes of a session."""
    commands = []
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError, ValueError):
            fields = (entry / "stat").read_text().rpartition(")")[2].split()
            if int(entry.name) and int(fields[3]) == leader and fields[0] not in "ZX":
                commands.append((entry / "cmdline").read_text().replace("\0", " "))
    # A process without a command line is terminating.
    return [command for command in commands if command]


def times(count: int) -> list[tuple[str, int, signal.Signals]]:
    return [(name, k, SIGNALS[(k + n) % len(SIGNALS)]) for k in range(count) for n, name in enumerate(COMMANDS)]


def send(name: str, k: int, number: signal.Signals, folder: Path) -> None:
    arguments, whole = COMMANDS[name]
    # The signal is sent after a given processor time, because elapsed times differ between machines.
    moment = random.Random(f"{name} {k}").uniform(0.0, whole)
    work, temporary = folder / "work", folder / "temporary"
    for place in (work, temporary):
        place.mkdir()
    cache = {"XDG_CACHE_HOME": str(folder / "cache"), "MPLCONFIGDIR": os.environ.get("MPLCONFIGDIR", "")}
    process = subprocess.Popen(
        [str(COMMAND), *arguments], cwd=work, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True, env=os.environ | cache | {"TMPDIR": str(temporary)},
    )  # fmt: skip
    try:
        with contextlib.suppress(OSError):
            # Wait until the program has installed its signal handler.
            while process.poll() is None and not caught(process.pid) >> (signal.SIGTERM - 1) & 1:
                time.sleep(0.002)
            begin = busy(process.pid)
            while process.poll() is None and busy(process.pid) < begin + moment:
                time.sleep(0.005)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        _, errors = process.communicate(timeout=60)
        left = session(process.pid)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    about = f"{name} at {moment:.2f} s, {number.name}: {process.returncode}, {errors!r}"
    lines = [line for line in errors.splitlines() if not line.startswith("warning: ")]
    if process.returncode != 0:
        assert process.returncode == 128 + number, about
        assert len(lines) == 1 and lines[0].startswith("error: "), about
    assert "Traceback" not in errors and "ignored" not in errors, about
    # If a process ends before the signal, its output folder must be complete.
    names = {path.name for path in work.iterdir()}
    assert names <= {"out", "deep"}, about
    if "deep" in names:
        assert [path.name for path in (work / "deep" / "er").iterdir()] == ["out"], about
    # Matplotlib creates a temporary folder if its cache is not writable.
    assert not [path for path in temporary.iterdir() if not path.name.startswith("matplotlib-")], about
    assert not list((folder / "cache").rglob(".impact-posture-*")), about
    assert not left, about


@pytest.mark.long(
    but=(
        "optimize-1-SIGTERM",
        "evaluate-0-SIGINT",
        "codegen-0-SIGINT",
        "simulate-1-SIGHUP",
        "simulate-2-SIGINT",
        "codegen-2-SIGTERM",
        "optimize-2-SIGHUP",
    )
)
@pytest.mark.parametrize(("name", "k", "number"), times(3), ids=lambda value: str(getattr(value, "name", value)))
def test_a_signal_ends_everything(name: str, k: int, number: signal.Signals, tmp_path: Path) -> None:
    send(name, k, number, tmp_path)


def test_many_signals(tmp_path: Path, hostile_full: bool) -> None:
    if not hostile_full:
        pytest.skip("many signals: give --hostile-full")
    for name, k, number in times(25):
        folder = tmp_path / f"{name}-{k}"
        folder.mkdir()
        send(name, k, number, folder)


def test_a_signal_during_an_import_ends_the_process() -> None:
    """While the cleanup module is imported, the module exists but its functions are still missing."""
    code = (
        "import os, signal, sys, types\n"
        "from impact_posture_cli.process import prepare\n"
        "prepare()\n"
        "sys.modules['impact_posture.system.processes'] = types.ModuleType('impact_posture.system.processes')\n"
        "os.kill(os.getpid(), signal.SIGTERM)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 128 + signal.SIGTERM and done.stderr == "error: terminated\n"
