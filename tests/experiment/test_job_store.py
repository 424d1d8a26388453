"""Simulation jobs and their store: a finished job runs again only if one of its inputs has changed."""

from __future__ import annotations

import errno
import functools
import io
import json
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pinocchio as pin
import pytest

from impact_posture.collision.urdf_shapes import LinkShape
from impact_posture.errors import ControllerNotFound, OutputError, ScenarioNotFound, SimulationDiverged
from impact_posture.experiment import job_store
from impact_posture.experiment.experiment_folders import draw_side_by_side, store_beside
from impact_posture.experiment.job_store import JobStore, key_of, run_batch
from impact_posture.experiment.jobs import SCHEMA, Job, controller_factory, execute
from impact_posture.experiment.reproduction import Reproduction, jobs_of
from tests.support.command import refused
from tests.support.command import run as start


@functools.cache
def executed(path: str) -> Any:
    return execute(Job(path, "nominal"))


@pytest.fixture
def store(tmp_path: Path) -> JobStore:
    return JobStore(tmp_path / "store")


def test_a_run_has_a_document(aerial: Path) -> None:
    runs, document = execute(Job(str(aerial), "nominal"))
    assert document["schema"] == SCHEMA and document["controller"] == "nominal" and document["seed"] == 0
    assert document["language"] == "Python"
    assert document["metrics"]["contacts"] == 1 and document["metrics"]["q_total_impact"] > 0
    assert {"inside", "outside"} <= set(document["metrics"]["saturation_s"])
    assert [w["kind"] for w in document["windows"]] == ["impact", "dwell", "recovery"]
    assert document["windows"][0]["end"] - document["windows"][0]["begin"] == pytest.approx(0.3)
    assert document["prediction"]["impacts"] == 1 and document["prediction"]["ratio"] > 0
    assert len(runs) == 1
    json.dumps(document, allow_nan=False)


def test_a_push_has_a_run_for_each_sign(push: Path) -> None:
    _, document = executed(str(push))
    assert [part["sign"] for part in document["runs"]] == [1, -1]
    mean = sum(part["metrics"]["q_total_impact"] for part in document["runs"]) / 2
    assert document["metrics"]["q_total_impact"] == pytest.approx(mean)
    _, minus = execute(Job(str(push), "nominal", sign=-1))
    assert minus["metrics"] == document["runs"][1]["metrics"]


def test_results_do_not_depend_on_processes_and_order(aerial: Path, store: JobStore) -> None:
    jobs = [Job(str(aerial), name, seed) for name, seed in (("nominal", 0), ("nominal", 1), ("stiff", 0))]
    progress: list[tuple[int, int]] = []
    forward = run_batch(jobs, progress=lambda done, total: progress.append((done, total)))
    backward = run_batch(jobs[::-1], processes=2, store=store)
    assert forward == backward[::-1]
    assert progress == [(k, 3) for k in range(4)]
    assert forward[0] != forward[1]


def test_an_interrupted_batch_continues(aerial: Path, store: JobStore, monkeypatch: pytest.MonkeyPatch) -> None:
    jobs = [Job(str(aerial), "nominal", seed) for seed in range(3)]
    seeds: list[int] = []
    # Equal jobs have equal results (tested above), so each job is simulated only once.
    cached = functools.cache(job_store.execute)

    def interrupted(job: Job, **options: Any) -> Any:
        if len(seeds) == 2:
            raise KeyboardInterrupt
        seeds.append(job.seed)
        return cached(job)

    monkeypatch.setattr(job_store, "execute", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_batch(jobs, store=store)
    assert seeds == [0, 1]
    monkeypatch.setattr(job_store, "execute", lambda job, **options: (seeds.append(job.seed), cached(job))[1])
    documents = run_batch(jobs, store=store)
    assert seeds == [0, 1, 2]
    assert documents == run_batch(jobs)
    assert seeds == [0, 1, 2, 0, 1, 2]


@pytest.mark.parametrize("changed", ["scenario", "posture", "mesh", "software"])
def test_a_changed_input_runs_the_job_again(
    changed: str, push: Path, tmp_path: Path, store: JobStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, posture, mesh = (tmp_path / name for name in ("own.toml", "start.json", "ball.obj"))
    text, count = re.subn(r"(?m)^posture = .*", 'posture = "start.json"', push.read_text(encoding="utf-8"))
    assert count == 1
    path.write_text(text, encoding="utf-8")
    q = controller_factory(str(push)).setup.q.copy()
    posture.write_text(json.dumps({"q": q.tolist()}))
    mesh.write_text("v 0 0 0")
    shape = LinkShape("ball", "base_link", pin.SE3.Identity(), "mesh", (1.0, 1.0, 1.0), mesh)
    monkeypatch.setattr(job_store, "read_shapes", lambda robot: ([shape], []))
    job = Job(str(path), "nominal")
    store.keep(job, {"metrics": {}})
    assert store.find(job) == {"metrics": {}} and store.find(replace(job, gain=3.0)) is None
    if changed == "scenario":
        path.write_text(f"{text}\n# another text\n", encoding="utf-8")
    elif changed == "posture":
        q[-1] += 0.001
        posture.write_text(json.dumps({"q": q.tolist()}))
    elif changed == "mesh":
        mesh.write_text("v 1 0 0")
    else:
        monkeypatch.setattr(job_store, "software", lambda: {"mujoco": "99"})
    job_store._scenario.cache_clear()
    controller_factory.cache_clear()
    assert store.find(job) is None


def test_runs_in_python_and_in_c_are_stored_apart(aerial: Path, store: JobStore) -> None:
    plan = {str(aerial): ["nominal"]}
    python, compiled = jobs_of(plan, 1), jobs_of(plan, 2)
    for job in python:
        store.keep(job, {"language": "Python"})
    assert [store.find(job) for job in compiled] == [None] * 2
    for job in compiled:
        store.keep(job, {"language": "C"})
    assert [store.find(job) for job in python] == [{"language": "Python"}]
    assert [store.find(job) for job in jobs_of(plan, 1, "auto")] == [{"language": "Python"}]
    assert [store.find(job) for job in jobs_of(plan, 1, "always")] == [None]


@pytest.mark.parametrize("damaged", ["empty", "half", "bytes", "changed", "missing", "series", "no series"])
def test_a_job_with_a_damaged_file_runs_again(
    damaged: str, push: Path, store: JobStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    job, calls = Job(str(push), "nominal"), []
    monkeypatch.setattr(job_store, "execute", lambda job: (calls.append(job), executed(str(push)))[1])
    documents = run_batch([job], store=store)
    assert run_batch([job], store=store) == documents and len(calls) == 1
    path = store.series(job, -1) if "series" in damaged else store.folder / f"{key_of(job)}.json"
    content = path.read_bytes()
    if damaged in ("missing", "no series"):
        path.unlink()
    else:
        path.write_bytes(
            {"empty": b"", "half": content[: len(content) // 2], "bytes": b"\xff\xfe\x00",
             "changed": content.replace(b"completed", b"fell"), "series": store.series(job, 1).read_bytes()}[damaged]
        )  # fmt: skip
    with pytest.raises(OutputError, match="the run of nominal with seed 0 was deleted or changed"):
        store.finished(job)
    assert run_batch([job], store=store) == documents and len(calls) == 2
    assert path.read_bytes() == content


def test_only_the_first_seed_has_time_series(push: Path, store: JobStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(job_store, "execute", lambda job: executed(str(push)))
    job = Job(str(push), "nominal")
    run_batch([replace(job, seed=1)], store=store)
    assert not list(store.folder.glob("*.npz"))
    run_batch([job], store=store)
    assert set(store.folder.glob("*.npz")) == {store.series(job, 1), store.series(job, -1)}


def test_remove_keeps_foreign_files(aerial: Path, store: JobStore) -> None:
    job = Job(str(aerial), "nominal")
    foreign = ["notes.json", "notes.txt", "of last year.npz", "thesis.part"]
    store.keep(job, {"runs": []})
    (store.folder / f".{store.series(job, -1).name}.99.part").write_text("half a series")
    for name in foreign:
        (store.folder / name).write_text("mine")
    store.remove()
    assert sorted(path.name for path in store.folder.iterdir()) == foreign
    for name in foreign:
        (store.folder / name).unlink()
    store.remove()
    assert not store.folder.exists()


def test_a_diverged_simulation_is_a_result(aerial: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def diverge(job: Job, **options: Any) -> Any:
        raise SimulationDiverged(1.0, where="it")

    monkeypatch.setattr(job_store, "execute", diverge)
    (document,) = run_batch([Job(str(aerial), "nominal")])
    assert (document["status"], document["seed"], document["runs"]) == ("control lost", 0, [])
    assert "the state diverged at t = 1 s" in document["events"][0]["what"] and document["events"][0]["time"] == 1.0


def test_unknown_names_are_refused_before_any_run(aerial: Path) -> None:
    with pytest.raises(ControllerNotFound, match="did you mean robust"):
        run_batch([Job(str(aerial), "nominal"), Job(str(aerial), "robsut")])
    with pytest.raises(ScenarioNotFound, match="aerial-vertical"):
        run_batch([Job("arial-vertical", "nominal")])


def test_a_file_in_the_place_of_the_store_is_refused(tmp_path: Path) -> None:
    (tmp_path / ".both.runs").write_text("mine")
    done = start("compare", "aerial-lateral", "--out", "both", cwd=tmp_path)
    refused(done, 1, ".both.runs: cannot be created", "choose another --out")
    assert (tmp_path / ".both.runs").read_text() == "mine" and len(list(tmp_path.iterdir())) == 1


def test_two_commands_cannot_share_a_store(tmp_path: Path) -> None:
    with store_beside(tmp_path / "both") as store:
        done = start("compare", "aerial-lateral", "--out", "both", cwd=tmp_path)
        refused(done, 1, ".both.runs: is in use by another command", "wait until it ends")
        assert store.folder.is_dir()
    assert not list(tmp_path.iterdir())


def test_a_store_without_runs_is_removed_and_one_with_runs_stays(aerial: Path, tmp_path: Path) -> None:
    done = start("compare", str(aerial), "--controllers", "robst", "--out", "deep/er/both", cwd=tmp_path)
    refused(done, 1, "did you mean robust")
    assert not list(tmp_path.iterdir())
    job = Job(str(aerial), "nominal")
    with pytest.raises(KeyboardInterrupt), store_beside(tmp_path / "deep" / "both") as store:
        store.keep(job, {"runs": []})
        raise KeyboardInterrupt
    with store_beside(tmp_path / "deep" / "both") as store:
        assert store.find(job) == {"runs": []}
        store.remove()
    assert not list((tmp_path / "deep").iterdir())


def test_figures_are_not_drawn_without_a_finished_run(aerial: Path, tmp_path: Path) -> None:
    reproduction = Reproduction(1, (), (Job(str(aerial), "nominal"),))
    with pytest.raises(OutputError, match="was deleted or changed"), store_beside(tmp_path / "both") as store:
        draw_side_by_side(reproduction.shown, store, tmp_path, ["png"])
    assert not list(tmp_path.iterdir())


def test_only_errors_after_the_use_of_stored_jobs_are_blamed_on_the_store(
    aerial: Path, store: JobStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(job: Job) -> Any:
        raise KeyError("a fault of the program")

    job = Job(str(aerial), "nominal")
    store.keep(job, {"runs": []})
    monkeypatch.setattr(job_store, "execute", fail)
    with pytest.raises(KeyError, match="a fault of the program"), store.locked():
        run_batch([job, replace(job, seed=1)], store=store)
    with pytest.raises(io.UnsupportedOperation), store.locked():
        run_batch([job], store=store)
        raise io.UnsupportedOperation("not writable")
    with pytest.raises(OutputError, match=r"contains runs that cannot be used \(KeyError"), store.locked():
        run_batch([job], store=store)[0]["metrics"]


def test_a_full_disk_is_reported_and_keeps_stored_jobs(
    push: Path, store: JobStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = Job(str(push), "nominal")
    store.keep(replace(job, seed=1), {"runs": []})
    before = sorted(store.folder.iterdir())

    def fail(source: Path, target: Path) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "replace", fail)
    monkeypatch.setattr(job_store, "execute", lambda job: executed(str(push)))
    with pytest.raises(OutputError, match="No space left on device"):
        run_batch([job], store=store)
    assert sorted(store.folder.iterdir()) == before
