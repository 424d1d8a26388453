"""A sweep whose network loses all packets continues, or gives one error line and keeps its shards.

Two network namespaces contain the Dask scheduler and its workers or the client.  Needs ``--hostile-full`` and root.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.hostile.disturbed_sweeps import COMMAND, check, interrupted, running
from tests.support.tools import need

NEAR, FAR = f"near{os.getpid()}", f"far{os.getpid()}"
ADDRESS = "tcp://10.77.0.1:8786"
PROGRAM = """
from impact_posture.sweep import executors
from impact_posture_cli.main import main
executors._LONGEST_SILENCE, executors._WITHOUT_WORKERS = 12, 5
main()
"""
LOST = {"client": "8786 does not answer", "both workers": "has had no workers for 5 s"}


def ip(*words: str) -> None:
    done = subprocess.run([need("ip"), *words], capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"no network namespaces ({done.stderr.strip()})")


@pytest.fixture
def network(hostile_full: bool) -> Iterator[None]:
    """A network cable between two namespaces."""
    if not hostile_full:
        pytest.skip("networks that lose packets: give --hostile-full")
    need("iptables")
    try:
        for name in (NEAR, FAR):
            ip("netns", "add", name)
        ip("link", "add", "cable", "netns", NEAR, "type", "veth", "peer", "name", "cable", "netns", FAR)
        for k, name in enumerate((NEAR, FAR), 1):
            ip("-n", name, "addr", "add", f"10.77.0.{k}/24", "dev", "cable")
            for device in ("lo", "cable"):
                ip("-n", name, "link", "set", device, "up")
        yield
    finally:
        for name in (NEAR, FAR):
            subprocess.run(["ip", "netns", "del", name], capture_output=True)


def within(namespace: str) -> tuple[str, ...]:
    return ("ip", "netns", "exec", namespace)


def lose_packets(change: str) -> None:
    """Lose all packets between the namespaces (``-A``), or no packets any more (``-D``)."""
    for chain, direction in (("INPUT", "-i"), ("OUTPUT", "-o")):
        rule = ("iptables", change, chain, direction, "cable", "-j", "DROP")
        subprocess.run([*within(NEAR), *rule], check=True)


@pytest.mark.parametrize("far", ["client", "client, Ctrl-C", "client, for 3 s", "one worker", "both workers"])
def test_the_network_loses_packets(far: str, network: None, sweep: Path, tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    dask = (sys.executable, "-m")
    scheduler = (*within(NEAR), *dask, "distributed.cli.dask_scheduler", "--no-dashboard", "--host", "10.77.0.1")
    worker = (*dask, "distributed.cli.dask_worker", ADDRESS, "--no-dashboard", "--no-nanny", "--nthreads", 1,
              "--local-directory", tmp_path / "dask")  # fmt: skip
    first, second = (
        within(FAR if far in names else NEAR) for names in (("one worker", "both workers"), ("both workers",))
    )
    soon = {"DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL": "10s"}

    def harm(pid: int) -> None:
        lose_packets("-A")
        if far != "one worker":
            time.sleep(3)
        if "Ctrl-C" in far:
            os.killpg(pid, signal.SIGINT)
        elif "for" in far:
            lose_packets("-D")

    client = (*within(FAR if "client" in far else NEAR), sys.executable, "-c", PROGRAM, *COMMAND[2:])
    ready = (*within(NEAR), "bash", "-c", "until (echo > /dev/tcp/10.77.0.1/8786) 2> /dev/null; do sleep 0.2; done")
    with running(*scheduler, **soon), running(*first, *worker, **soon), running(*second, *worker, **soon):
        subprocess.run(ready, timeout=120, check=True)
        outcome = interrupted([*client, "sweep", str(sweep), "--scheduler", ADDRESS], tmp_path / "out", harm)
    wanted = 130 if "Ctrl-C" in far else 1 if far in LOST else 0
    assert (outcome.code, LOST.get(far, "") in outcome.err) == (wanted, True), outcome.err
    check(outcome, sweep, tmp_path / "out")
