"""Jobs: what they answer, that they are kept, found again, and not found when anything has changed."""

from __future__ import annotations

import functools
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from impact_posture.errors import ControllerNotFound, ScenarioNotFound, SimulationDiverged
from impact_posture.experiment import batch
from impact_posture.experiment.batch import Store, key_of, run_batch
from impact_posture.experiment.jobs import SCHEMA, Job, controller_factory, execute
from impact_posture.experiment.reproduction import jobs_of


def test_a_run_answers_with_its_document(aerial: Path) -> None:
    runs, found = execute(Job(str(aerial), "nominal"))
    assert found["schema"] == SCHEMA and found["controller"] == "nominal" and found["seed"] == 0
    assert found["language"] == "Python"
    assert found["metrics"]["contacts"] == 1 and found["metrics"]["q_total_impact"] > 0
    assert {"inside", "outside"} <= set(found["metrics"]["saturation_s"])
    assert [w["kind"] for w in found["windows"]] == ["impact", "dwell", "recovery"]
    assert found["windows"][0]["end"] - found["windows"][0]["begin"] == pytest.approx(0.3)
    assert found["prediction"]["impacts"] == 1 and found["prediction"]["ratio"] > 0
    assert len(runs) == 1
    json.dumps(found, allow_nan=False)


def test_a_push_goes_both_ways(push: Path) -> None:
    _, found = execute(Job(str(push), "nominal"))
    assert [part["sign"] for part in found["runs"]] == [1, -1]
    mean = sum(part["metrics"]["q_total_impact"] for part in found["runs"]) / 2
    assert found["metrics"]["q_total_impact"] == pytest.approx(mean)
    _, one = execute(Job(str(push), "nominal", sign=-1))
    assert one["metrics"] == found["runs"][1]["metrics"]


def test_processes_and_order_do_not_matter(aerial: Path, tmp_path: Path) -> None:
    jobs = [Job(str(aerial), name, seed) for name, seed in (("nominal", 0), ("nominal", 1), ("robust", 0))]
    seen: list[tuple[int, int]] = []
    one = run_batch(jobs, progress=lambda done, total: seen.append((done, total)))
    two = run_batch(jobs[::-1], processes=2, store=Store(tmp_path / "kept"))
    assert one == two[::-1]
    assert seen == [(k, 3) for k in range(4)]
    assert one[0] != one[1]


def test_what_was_interrupted_goes_on(aerial: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    jobs = [Job(str(aerial), "nominal", seed) for seed in range(3)]
    store = Store(tmp_path / "kept")
    ran: list[int] = []
    # The same job has the same answer (above): each is run once.
    real = functools.cache(batch.execute)

    def counted(job: Job, **options: Any) -> Any:
        if len(ran) == 2:
            raise KeyboardInterrupt
        ran.append(job.seed)
        return real(job)

    monkeypatch.setattr(batch, "execute", counted)
    with pytest.raises(KeyboardInterrupt):
        run_batch(jobs, store=store)
    assert ran == [0, 1]
    monkeypatch.setattr(batch, "execute", lambda job, **options: (ran.append(job.seed), real(job))[1])
    whole = run_batch(jobs, store=store)
    assert ran == [0, 1, 2]
    assert whole == run_batch(jobs)
    assert ran == [0, 1, 2, 0, 1, 2]


def test_series_of_the_first_seed_are_kept(push: Path, tmp_path: Path) -> None:
    store, job = Store(tmp_path / "kept"), Job(str(push), "nominal")
    store.keep(job, *run_batch([job]))
    run_batch([replace(job, seed=1)], store=store)
    assert not list(store.folder.glob("*.npz"))
    # The document alone is not enough.
    run_batch([job], store=store)
    assert sorted(path.name for path in store.folder.glob("*.npz")) == sorted(
        [store.series(job, 1).name, store.series(job, -1).name]
    )


def test_a_changed_scenario_or_a_broken_file_is_run_anew(aerial: Path, tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text(aerial.read_text(encoding="utf-8"), encoding="utf-8")
    job, store = Job(str(path), "nominal"), Store(tmp_path / "kept")
    before = key_of(job)
    store.keep(job, {"metrics": {}})
    assert store.find(job) == {"metrics": {}}
    path.write_text(path.read_text(encoding="utf-8") + "\n# another one\n", encoding="utf-8")
    batch._scenario.cache_clear()
    controller_factory.cache_clear()
    assert key_of(job) != before and store.find(job) is None
    assert key_of(Job(str(path), "nominal", gain=3.0)) != key_of(job)


def test_runs_in_python_and_in_c_are_kept_apart(aerial: Path, tmp_path: Path) -> None:
    plan, store = {str(aerial): ["nominal"]}, Store(tmp_path / "kept")
    few, many = jobs_of(plan, 1), jobs_of(plan, 2)
    for job in few:
        store.keep(job, {"language": "Python"})
    # However many seeds the first call had: what more seeds run in C is not taken from Python, nor the other way.
    assert [store.find(job) for job in many] == [None] * 2
    for job in many:
        store.keep(job, {"language": "C"})
    assert [store.find(job) for job in few] == [{"language": "Python"}]
    assert [store.find(job) for job in jobs_of(plan, 1, "auto")] == [{"language": "Python"}]
    assert [store.find(job) for job in jobs_of(plan, 1, "always")] == [None]


@pytest.mark.parametrize("damage", ["empty", "half", "bytes", "other text", "another job's", "deep", "a folder"])
def test_a_damaged_file_is_run_anew(aerial: Path, tmp_path: Path, damage: str) -> None:
    job, store = Job(str(aerial), "nominal"), Store(tmp_path / "kept")
    store.keep(Job(str(aerial), "nominal", 1), {"status": "completed", "runs": []})
    store.keep(job, {"status": "completed", "runs": []})
    assert store.find(job) is not None
    path, other = (store._path(Job(str(aerial), "nominal", seed)) for seed in (0, 1))
    whole = path.read_bytes()
    made = {
        "empty": b"", "half": whole[: len(whole) // 2], "bytes": b"\xff\xfe\x00", "another job's": other.read_bytes(),
        "other text": whole.replace(b"completed", b"fell"), "deep": b"[" * 100_000,
    }  # fmt: skip
    path.unlink()
    if damage in made:
        path.write_bytes(made[damage])
    else:
        path.mkdir()
    assert store.find(job) is None


def test_a_store_leaves_the_files_of_others(aerial: Path, tmp_path: Path) -> None:
    job, store = Job(str(aerial), "nominal"), Store(tmp_path / "kept")
    store.keep(job, {"status": "completed", "runs": []})
    (store.folder / "notes.txt").write_text("mine")
    store.remove()
    assert [path.name for path in store.folder.iterdir()] == ["notes.txt"]
    other = Store(tmp_path / "alone")
    other.keep(job, {"status": "completed", "runs": []})
    (other.folder / ".aerial.json.99.part").write_text("half a docu")
    other.remove()
    assert not other.folder.exists()


@pytest.mark.parametrize("damage", ["missing", "half", "garbage", "flipped"])
def test_a_damaged_series_is_run_anew(
    push: Path, tmp_path: Path, damage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batch, "execute", lambda job, **options: _kept_run(str(push)))
    store, job = Store(tmp_path / "kept"), Job(str(push), "nominal")
    run_batch([job], store=store)
    path = store.series(job, -1)
    whole = path.read_bytes()
    # Nothing is run where all is well.
    monkeypatch.setattr(batch, "execute", None)
    run_batch([job], store=store)
    monkeypatch.setattr(batch, "execute", lambda job, **options: _kept_run(str(push)))
    path.unlink()
    if damage != "missing":
        middle = len(whole) // 3
        flipped = whole[:middle] + bytes(255 - b for b in whole[middle : middle + 400]) + whole[middle + 400 :]
        path.write_bytes({"half": whole[: len(whole) // 2], "garbage": b"\x00" * 500, "flipped": flipped}[damage])
    run_batch([job], store=store)
    assert path.read_bytes() == whole


@functools.cache
def _kept_run(path: str) -> Any:
    return execute(Job(path, "nominal"))


def test_a_robot_that_ran_away_is_a_result(aerial: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def away(job: Job, **options: Any) -> Any:
        raise SimulationDiverged(1.0, where="it")

    monkeypatch.setattr(batch, "execute", away)
    (found,) = run_batch([Job(str(aerial), "nominal")])
    assert (found["status"], found["seed"], found["runs"]) == ("control lost", 0, [])
    assert "the state ran away at t = 1 s" in found["events"][0]["what"] and found["events"][0]["time"] == 1.0


def test_what_is_misspelt_is_said_before_anything_runs(aerial: Path) -> None:
    with pytest.raises(ControllerNotFound, match="did you mean robust"):
        run_batch([Job(str(aerial), "nominal"), Job(str(aerial), "robsut")])
    with pytest.raises(ScenarioNotFound, match="aerial-vertical"):
        run_batch([Job("arial-vertical", "nominal")])
