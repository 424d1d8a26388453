"""Calls in a copy of the process: results, errors, crashes, limits and signals."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import resource
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from impact_posture.errors import ImpactPostureError, InputError
from impact_posture.system import isolated_calls as module
from impact_posture.system.isolated_calls import CallFailed, isolated_call, isolated_calls


def test_results_and_errors_come_in_order() -> None:
    def half(number: int) -> np.ndarray:
        if number % 2:
            raise InputError(f"{number} is odd", where="half")
        return np.full(100_000, number // 2)

    outcomes = list(isolated_calls(half, [4, 3, 2], lambda _: 5.0))
    assert [type(outcome) for outcome in outcomes] == [np.ndarray, InputError, np.ndarray]
    assert outcomes[0][99_999] == 2 and outcomes[2][0] == 1 and outcomes[1].where == "half"
    with pytest.raises(InputError, match="3 is odd"):
        isolated_call(lambda: half(3), 5.0)


def busy() -> None:
    while True:
        pass


FATES = {
    "segmentation fault": (lambda: os.kill(os.getpid(), signal.SIGSEGV), "crashes its reader"),
    "abort": (os.abort, "crashes its reader"),
    "killed": (lambda: os.kill(os.getpid(), signal.SIGKILL), "takes too much memory"),
    "too large": (lambda: np.ones(1 << 30), "takes too much memory"),
    "endless": (busy, "takes more than 0.1 s"),
}


@pytest.mark.parametrize("name", FATES)
def test_a_failed_call_ends_neither_this_process_nor_the_other_calls(
    name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    fate, words = FATES[name]

    def call(k: int) -> int:
        if k == 1:
            fate()
        return k

    limit = resource.getrlimit(resource.RLIMIT_AS)
    first, failed, last = isolated_calls(call, range(3), lambda k: 0.1 if name == "endless" else 10.0)
    assert (first, last) == (0, 2) and isinstance(failed, CallFailed) and words in failed.what
    assert capfd.readouterr() == ("", "")
    assert resource.getrlimit(resource.RLIMIT_AS) == limit


def test_a_system_without_free_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    def full() -> int:
        raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))

    monkeypatch.setattr(os, "fork", full)
    with pytest.raises(ImpactPostureError, match=r"no process can be started .*; end other processes"):
        isolated_call(os.getpid, 5.0)


@pytest.mark.skipif(sys.platform != "linux", reason="looks at processes in /proc")
def test_a_call_that_waits_for_a_pipe_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_LONGEST_SLEEP", 0.3)
    os.mkfifo(tmp_path / "pipe")
    start = time.monotonic()
    with pytest.raises(CallFailed, match="names a pipe or a device"):
        isolated_call((tmp_path / "pipe").read_bytes, 10.0)
    assert time.monotonic() - start < 5


@pytest.fixture
def slow_file(tmp_path: Path) -> Iterator[Path]:
    """A file on a FUSE disk that answers every request after 0.8 s with an input/output error."""
    path, system = tmp_path / "robot.xml", ctypes.CDLL(None)
    path.touch()
    try:
        disk = os.open("/dev/fuse", os.O_RDWR)
    except OSError:
        pytest.skip("the system has no FUSE")
    options = f"fd={disk},rootmode=100000,user_id={os.getuid()},group_id={os.getgid()}"

    def serve() -> None:
        with contextlib.suppress(OSError):
            while True:
                _, operation, number = struct.unpack_from("IIQ", os.read(disk, 1 << 17))
                if operation == 26:  # FUSE_INIT: answer with version 7.31, and writes of 4096 bytes.
                    os.write(disk, struct.pack("IiQ2I12xI40x", 80, 0, number, 7, 31, 4096))
                else:
                    time.sleep(0.8)
                    os.write(disk, struct.pack("IiQ", 16, -errno.EIO, number))

    if system.mount(b"disk", bytes(path), b"fuse", 0, options.encode()):
        os.close(disk)
        pytest.skip("only root can mount a disk")
    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield path
    finally:
        system.umount2(bytes(path), 2)  # MNT_DETACH, which also ends the reads of the disk
        thread.join()
        os.close(disk)


@pytest.mark.skipif(sys.platform != "linux", reason="looks at processes in /proc")
def test_a_call_may_wait_for_a_slow_disk(slow_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_LONGEST_SLEEP", 0.3)
    with pytest.raises(OSError, match="Input/output error"):
        isolated_call(slow_file.read_bytes, 10.0)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_process_that_waits_for_a_call(number: int, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    code = (
        "import os\n"
        "from impact_posture_cli.process import prepare\n"
        "from impact_posture.system import isolated_calls\n"
        "isolated_calls._LONGEST_SLEEP = 60\n"
        "prepare()\n"
        "def wait():\n"
        "    print(os.getpid(), flush=True)\n"
        f"    open({str(tmp_path / 'pipe')!r})\n"
        "isolated_calls.isolated_call(wait, 60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stderr is not None
        copy = int(process.stdout.readline())
        time.sleep(0.1)
        process.send_signal(number)
        assert process.wait(10) == 128 + number
        assert process.stderr.read().count(b"error: ") == 1
        with pytest.raises(ProcessLookupError):
            os.kill(copy, 0)
