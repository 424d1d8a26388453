"""Jobs that Slurm loses or refuses, with stand-ins for the commands of Slurm."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable
from pathlib import Path

import pytest

from impact_posture.errors import ImpactPostureError, InputError, SpecError, WorkerDied
from impact_posture.sweep import slurm_jobs
from impact_posture.sweep.slurm_jobs import SlurmJobs

pytest.importorskip("submitit")

# The first submission is the job array 7.
SBATCH = 'echo "Submitted batch job 7"'


@pytest.fixture
def cluster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., SlurmJobs]:
    """Return a function that starts an executor, with shell code of ``sbatch``, ``squeue`` and ``scancel``."""
    for name, value in (("_RESULTS", 0.01), ("_QUESTIONS", 0.02), ("_FILE_DELAY", 0.1), ("_LONGEST_SILENCE", 0.3)):
        monkeypatch.setattr(slurm_jobs, name, value)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}")

    def start(sbatch: str = SBATCH, squeue: str = "echo 7_0 7_1", scancel: str = "") -> SlurmJobs:
        (tmp_path / "bin").mkdir()
        for name, code in (("sbatch", sbatch), ("squeue", squeue), ("scancel", scancel), ("srun", "")):
            (tmp_path / "bin" / name).write_text(f"#!/bin/sh\n{code}\n")
            (tmp_path / "bin" / name).chmod(0o755)
        return SlurmJobs(tmp_path / "logs", {"timeout_min": 5}, "slurm")

    return start


def write_result(folder: Path, job: str, content: object) -> None:
    """Write the result of a job as submitit does."""
    path = folder / f"{job}_0_result.pkl"
    path.with_suffix(".new").write_bytes(pickle.dumps(content))
    path.with_suffix(".new").rename(path)


def test_results_and_errors_arrive(cluster: Callable[..., SlurmJobs], tmp_path: Path) -> None:
    with cluster() as executor:
        first, second = executor.submit_all([(abs, -3), (abs, "")])
        write_result(tmp_path / "logs", "7_0", ("success", slurm_jobs._attempt(abs, -3)))
        assert first.result(5) == 3
        write_result(tmp_path / "logs", "7_1", ("success", slurm_jobs._attempt(abs, "")))
        with pytest.raises(TypeError, match="bad operand"):
            second.result(5)


@pytest.mark.parametrize("content", [("error", "Traceback of the node"), 3, None])
def test_a_failed_job_is_named(content: object, cluster: Callable[..., SlurmJobs], tmp_path: Path) -> None:
    with cluster() as executor:
        first, _ = executor.submit_all([(abs, 1), (abs, 2)])
        write_result(tmp_path / "logs", "7_0", content)
        with pytest.raises(WorkerDied, match=r"job 7_0 failed; logs in .*logs\); check them, and run") as caught:
            first.result(20)
    assert caught.value.line.isprintable()


def test_a_lost_job_is_named(cluster: Callable[..., SlurmJobs]) -> None:
    with cluster(squeue="echo 7_0 17_1 7_11") as executor:
        first, second = executor.submit_all([(abs, 1), (abs, 2)])
        with pytest.raises(WorkerDied, match="job 7_1 ended without a result"):
            second.result(5)
        assert not first.done()


def test_a_silent_controller_ends_the_jobs(cluster: Callable[..., SlurmJobs]) -> None:
    with cluster(squeue="exit 1") as executor:
        futures = executor.submit_all([(abs, 1), (abs, 2)])
        for future in futures:
            with pytest.raises(WorkerDied, match=r"the Slurm controller has not answered for 0\.3 s"):
                future.result(5)


def test_jobs_that_nobody_waits_for_are_cancelled(cluster: Callable[..., SlurmJobs], tmp_path: Path) -> None:
    with cluster(scancel=f'echo "$@" > {tmp_path}/cancelled') as executor:
        executor.submit_all([(abs, 1), (abs, 2)])
    assert (tmp_path / "cancelled").read_text() == "7\n"


def test_refused_jobs_give_one_line(cluster: Callable[..., SlurmJobs], capfd: pytest.CaptureFixture[str]) -> None:
    refusal = "sbatch: error: invalid partition specified: fast\nsbatch: error: Batch job submission failed"
    with cluster(sbatch=f"echo '{refusal}' >&2; exit 1") as executor, pytest.raises(InputError) as caught:
        executor.submit_all([(abs, 1), (abs, 2)])
    assert "Batch job submission failed" in caught.value.line
    assert caught.value.line.isprintable() and not "".join(capfd.readouterr())


def test_errors_of_the_library_survive_the_way_from_a_node() -> None:
    for error in (InputError("a", where="b", hint="c"), SpecError("a", where="b", hint="c"), WorkerDied("a", "b")):
        copy = pickle.loads(pickle.dumps(error))
        assert isinstance(copy, ImpactPostureError) and copy.line == error.line
