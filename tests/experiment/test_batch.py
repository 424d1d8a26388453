"""Jobs: what they answer, that they are kept, found again, and not found when anything has changed."""

from __future__ import annotations

import errno
import functools
import json
import os
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pinocchio as pin
import pytest

from impact_posture.collision.urdf_shapes import UrdfShape
from impact_posture.errors import ControllerNotFound, OutputError, ScenarioNotFound, SimulationDiverged
from impact_posture.experiment import job_store as batch
from impact_posture.experiment.experiment_folders import draw_side_by_side, store_beside
from impact_posture.experiment.job_store import Store, key_of, run_batch
from impact_posture.experiment.jobs import SCHEMA, Job, controller_factory, execute
from impact_posture.experiment.reproduction import Reproduction, jobs_of
from impact_posture.system.output_folder import whole_folder
from tests.support.command import refused
from tests.support.command import run as start


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
    run_batch([replace(job, seed=1)], store=store)
    assert not list(store.folder.glob("*.npz"))
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


@pytest.mark.parametrize("changed", ["posture", "mesh", "software"])
def test_what_a_scenario_reads_counts(
    changed: str, push: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, posture, mesh = (tmp_path / name for name in ("own.toml", "start.json", "ball.obj"))
    text, count = re.subn(r"(?m)^posture = .*", 'posture = "start.json"', push.read_text(encoding="utf-8"))
    assert count == 1
    path.write_text(text, encoding="utf-8")
    q = controller_factory(str(push)).setup.q.copy()
    posture.write_text(json.dumps({"q": q.tolist()}))
    mesh.write_text("v 0 0 0")
    described = UrdfShape("ball", "base_link", pin.SE3.Identity(), "mesh", (1.0, 1.0, 1.0), mesh)
    monkeypatch.setattr(batch, "read_urdf_shapes", lambda robot: ([described], []))
    job, store = Job(str(path), "nominal"), Store(tmp_path / "kept")
    store.keep(job, {"metrics": {}})
    if changed == "posture":
        q[-1] += 0.001
        posture.write_text(json.dumps({"q": q.tolist()}))
    elif changed == "mesh":
        mesh.write_text("v 1 0 0")
    else:
        monkeypatch.setattr(batch, "software", lambda: {"mujoco": "99"})
    batch._scenario.cache_clear()
    controller_factory.cache_clear()
    assert store.find(job) is None


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


@pytest.mark.parametrize(
    "damage", ["empty", "half", "bytes", "other text", "another job's", "deep", "a folder", "a pipe"]
)
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
        (os.mkfifo if damage == "a pipe" else os.mkdir)(path)
    assert store.find(job) is None
    with pytest.raises(OutputError, match="the run of nominal with seed 0 is gone or was changed"):
        store.finished(job)


def test_a_file_without_end_is_not_read(aerial: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job, store = Job(str(aerial), "nominal"), Store(tmp_path / "kept")
    store.keep(job, {"status": "completed", "runs": []})
    assert store.find(job) is not None
    monkeypatch.setattr("impact_posture.system.text_files.MOST_CHARACTERS", 64)
    assert store.find(job) is None


def test_nobody_but_the_user_can_seal(aerial: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever knows this package and the scenario can write everything but the seal."""
    job = Job(str(aerial), "nominal")
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(tmp_path / "theirs"))
    Store(tmp_path / "kept").keep(job, {"status": "completed", "runs": []})
    assert Store(tmp_path / "kept").find(job) is not None
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(tmp_path / "ours"))
    assert Store(tmp_path / "kept").find(job) is None


def test_a_store_leaves_the_files_of_others(aerial: Path, tmp_path: Path) -> None:
    job, store = Job(str(aerial), "nominal"), Store(tmp_path / "kept")
    store.keep(job, {"status": "completed", "runs": []})
    theirs = ["notes.json", "notes.txt", "of last year.npz", "thesis.part"]
    for name in theirs:
        (store.folder / name).write_text("mine")
    store.remove()
    assert sorted(path.name for path in store.folder.iterdir()) == theirs
    other = Store(tmp_path / "alone")
    other.keep(job, {"status": "completed", "runs": []})
    (other.folder / f".{store.series(job, -1).name}.99.part").write_text("half a series")
    other.remove()
    assert not other.folder.exists()


def test_runs_go_through_no_link(push: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batch, "execute", lambda job, **options: _kept_run(str(push)))
    store, job = Store(tmp_path / "kept"), Job(str(push), "nominal")
    store.folder.mkdir()
    (tmp_path / "thesis.txt").write_text("ten years")
    for path in (store._path(job), store.series(job, 1), store.series(job, -1)):
        path.symlink_to(tmp_path / "thesis.txt")
    run_batch([job], store=store)
    assert (tmp_path / "thesis.txt").read_text() == "ten years" and store.find(job) is not None


@pytest.mark.parametrize("damage", ["missing", "half", "garbage", "flipped", "of the other push", "of another run"])
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
    if damage == "of the other push":
        path.write_bytes(store.series(job, 1).read_bytes())
    elif damage == "of another run":
        series = _kept_run(str(push))[0][1].series
        series = replace(series, q=series.q + 0.1)
        with path.open("wb") as file:
            series.save(file)
    elif damage != "missing":
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


# ---- the folder ----------------------------------------------------------------------------------------------------


def a_file(place: Path) -> None:
    place.write_text("mine")


def a_link(place: Path) -> None:
    (place.parent / "real").mkdir()
    place.symlink_to(place.parent / "real")


def a_dangling_link(place: Path) -> None:
    place.symlink_to(place.parent / "nowhere")


def a_result(place: Path) -> None:
    with whole_folder(place, force=False, kind="result") as folder:
        (folder / "result.json").write_text("{}")


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (a_file, "is no folder"),
        (a_link, "is no folder"),
        (a_dangling_link, "is no folder"),
        (a_result, "holds results of another command"),
    ],
)
def test_a_place_that_is_not_for_runs_is_refused_at_once(
    make: Callable[[Path], None], words: str, tmp_path: Path
) -> None:
    make(tmp_path / ".both.runs")
    before = sorted(tmp_path.rglob("*"))
    done = start("compare", "aerial-lateral", "--out", "both", cwd=tmp_path)
    refused(done, 1, f".both.runs: {words}", "choose another --out")
    assert sorted(tmp_path.rglob("*")) == before


def test_two_commands_do_not_share_a_store(tmp_path: Path) -> None:
    with store_beside(tmp_path / "both") as store:
        done = start("compare", "aerial-lateral", "--out", "both", cwd=tmp_path)
        refused(done, 1, ".both.runs: another command keeps its runs there", "wait for its end")
        assert store.folder.is_dir()
    assert not list(tmp_path.iterdir())


def test_a_store_without_runs_goes_and_one_with_runs_stays(aerial: Path, tmp_path: Path) -> None:
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


def test_a_run_that_is_gone_is_not_left_out(aerial: Path, tmp_path: Path) -> None:
    """Another program may have removed it since it was run."""
    found = Reproduction(1, (), (Job(str(aerial), "nominal"),))
    with pytest.raises(OutputError, match="is gone or was changed"), store_beside(tmp_path / "both") as store:
        draw_side_by_side(found.shown, store, tmp_path, ["png"])
    assert not list(tmp_path.iterdir())


def test_a_full_disk_is_named_and_keeps_what_was_there(
    push: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, job = Store(tmp_path / "kept"), Job(str(push), "nominal")
    store.keep(replace(job, seed=1), {"runs": []})
    before = sorted(store.folder.iterdir())

    def replaced(source: Path, target: Path) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "replace", replaced)
    monkeypatch.setattr(batch, "execute", lambda job, **options: _kept_run(str(push)))
    with pytest.raises(OutputError, match="No space left on device"):
        run_batch([job], store=store)
    assert sorted(store.folder.iterdir()) == before
