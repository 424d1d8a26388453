"""A sweep in Slurm jobs continues, or gives one error line and keeps its shards, if jobs or the controller stop.

The test starts a cluster of one node, without accounting.  Needs ``--hostile-full``, root, Slurm and munge.
"""

from __future__ import annotations

import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from subprocess import Popen

import pytest

from tests.hostile.disturbed_sweeps import COMMAND, check, interrupted, running
from tests.support.tools import need

PROGRAM = """
from impact_posture.sweep import slurm_jobs
from impact_posture_cli.main import main
slurm_jobs._LONGEST_SILENCE, slurm_jobs._FILE_DELAY = 15, 5
main()
"""
CONFIGURATION = """
ClusterName=hostile
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={controller}
SlurmdPort={node}
AuthInfo=socket={folder}/munge
SlurmUser=root
StateSaveLocation={folder}
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/controller.pid
SlurmdPidFile={folder}/node.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MessageTimeout=3
KillWait=1
NodeName={host} NodeAddr=127.0.0.1 CPUs=2 State=UNKNOWN
PartitionName=main Nodes=ALL Default=YES State=UP
"""
# What happens to a running sweep, its exit code, and a part of its error line.
DISTURBANCES = {
    "a job is cancelled": (1, "ended without a result; logs in"),
    "all jobs are cancelled": (1, "ended without a result; logs in"),
    "processes of jobs are killed": (1, "ended without a result; logs in"),
    "the controller is stopped": (1, "the Slurm controller has not answered for 15 s"),
    "the controller is stopped, Ctrl-C": (130, "interrupted"),
    "Ctrl-C": (130, "interrupted"),
}


@pytest.fixture
def controller(hostile_full: bool, monkeypatch: pytest.MonkeyPatch) -> Iterator[Popen[bytes]]:
    """The controller of a Slurm cluster of one node."""
    if not hostile_full:
        pytest.skip("a Slurm cluster: give --hostile-full")
    if os.geteuid() != 0:
        pytest.skip("only root can start a Slurm cluster")
    pytest.importorskip("submitit")
    monkeypatch.setenv("PATH", f"{os.environ['PATH']}{os.pathsep}/usr/sbin")
    munged, slurmctld, slurmd = map(need, ("munged", "slurmctld", "slurmd"))
    folder = Path(tempfile.mkdtemp(prefix="slurm"))
    (folder / "key").write_bytes(secrets.token_bytes(128))
    (folder / "key").chmod(0o400)
    with ExitStack() as stack:
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        # Jobs survive their node.
        stack.callback(kill_processes, "environ", f"SLURM_CONF={folder}")
        probes = [stack.enter_context(socket.socket()) for _ in range(2)]
        for probe in probes:
            probe.bind(("127.0.0.1", 0))
        ports = [probe.getsockname()[1] for probe in probes]
        host = socket.gethostname().partition(".")[0]
        text = CONFIGURATION.format(folder=folder, host=host, controller=ports[0], node=ports[1])
        (folder / "slurm.conf").write_text(text)
        monkeypatch.setenv("SLURM_CONF", str(folder / "slurm.conf"))
        for probe in probes:
            probe.close()
        files = {"key-file": "key", "pid-file": "pid", "log-file": "log", "seed-file": "seed", "socket": "munge"}
        options = [f"--{option}={folder / name}" for option, name in files.items()]
        stack.enter_context(running(munged, "--foreground", "--force", *options))
        process = stack.enter_context(running(slurmctld, "-D"))
        stack.enter_context(running(slurmd, "-D"))
        end = time.monotonic() + 60
        while slurm("sinfo", "--noheader", "--format=%t") != ["idle"]:
            if time.monotonic() > end:
                pytest.skip("no Slurm cluster can run on this machine")
            time.sleep(0.5)
        yield process


def slurm(*words: str) -> list[str]:
    return subprocess.run(words, capture_output=True, text=True).stdout.split()


def waiting_jobs() -> list[str]:
    return slurm("squeue", "--noheader", "--array", "--states=PENDING", "--format=%i")


def kill_processes(file: str, *words: str) -> None:
    """Kill all processes whose ``cmdline`` or ``environ`` contains all of these words."""
    for entry in Path("/proc").iterdir():
        with suppress(OSError, ValueError):
            text = (entry / file).read_text(errors="replace")
            if all(word in text for word in words):
                os.kill(int(entry.name), signal.SIGKILL)


@pytest.mark.parametrize("disturbance", DISTURBANCES)
def test_a_slurm_cluster_is_disturbed(
    disturbance: str, controller: Popen[bytes], sweep: Path, tmp_path: Path
) -> None:
    def harm(pid: int) -> None:
        if "cancelled" in disturbance:
            slurm("scancel", *waiting_jobs()[:1] if "a job" in disturbance else ["--me"])
        elif "killed" in disturbance:
            end = time.monotonic() + 5
            while time.monotonic() < end:
                kill_processes("cmdline", "submitit.core._submit", str(tmp_path))
                time.sleep(0.05)
        elif "stopped" in disturbance:
            os.kill(controller.pid, signal.SIGSTOP)
        if "Ctrl-C" in disturbance:
            os.killpg(pid, signal.SIGINT)

    program = [sys.executable, "-c", PROGRAM, *COMMAND[2:], "sweep", str(sweep), "--slurm", "timeout_min=5"]
    outcome = interrupted(program, tmp_path / "out", harm)
    code, words = DISTURBANCES[disturbance]
    assert outcome.code == code and words in outcome.err, outcome.err
    os.kill(controller.pid, signal.SIGCONT)
    time.sleep(5)
    if "stopped" not in disturbance:
        assert not waiting_jobs()
    check(outcome, sweep, tmp_path / "out")
