"""The commands ``simulate``, ``compare`` and ``reproduce``."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from impact_posture.errors import InputError
from impact_posture.experiment import jobs, reproduction
from impact_posture.simulation import scenario_file
from impact_posture.simulation.series import Series
from impact_posture_cli.commands.simulate import _rigid, _show
from impact_posture_cli.output import Page
from tests.experiment.conftest import shortened
from tests.support.command import on_terminal
from tests.support.command import run as start


def document(*arguments: str, cwd: Path, prepare: Callable[[], None] | None = None) -> dict[str, Any]:
    done = start(*arguments, "--json", cwd=cwd, prepare=prepare)
    assert (done.returncode, done.stderr) == (0, "")
    content = json.loads(done.stdout)
    assert isinstance(content, dict)
    return content


def versions_of_runs(folder: Path) -> object:
    first, *others = (json.loads(path.read_text())["versions"] for path in (folder / "runs").glob("*.json"))
    assert "mujoco" in first and all(other == first for other in others)
    return first


def test_export_world(aerial: Path, tmp_path: Path) -> None:
    result = document("simulate", str(aerial), "--export-world", "world", cwd=tmp_path)
    assert result == {"schema": "impact-posture/world/1", "folder": "world"}
    assert (tmp_path / "world" / "world.xml").is_file()


def test_simulate(aerial: Path, tmp_path: Path) -> None:
    command = ("simulate", str(aerial), *"--controller robust --seed 3 --out run --format png".split())
    result = document(*command, cwd=tmp_path)
    assert (result["scenario"], result["controller"], result["seed"]) == ("aerial-lateral", "robust", 3)
    for key in ("q_total_impact", "q_total_dwell", "peak_jump", "peak_force", "relaxed_ticks"):
        assert isinstance(result["metrics"][key], int | float)
    assert json.loads((tmp_path / "run" / "run.json").read_text()) == result
    measured, predicted = (result["prediction"][key] for key in ("measured_impact", "predicted_impact"))
    # The wall of the scenario has the restitution 0.125.
    assert 0.1 < result["prediction"]["restitution"] < 0.15
    for key in ("base_linear", "base_angular", "joint", "impulse"):
        assert measured[key] == result["metrics"][key] and type(predicted[key]) is type(measured[key])
    assert 0.3 < measured["impulse"] / predicted["impulse"] < 3 and measured["joint"]["share"] > 0
    assert start("report", "run", cwd=tmp_path).returncode == 0
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert (
        "rigid prediction" in page
        and f"prediction with the restitution {result['prediction']['restitution']:.3g} of the contact law" in page
        and f"{measured['joint']['name']}: {measured['joint']['velocity']:.3g} rad/s" in page
    )
    series = Series.load(tmp_path / "run" / "series.npz")
    window = result["windows"][0]
    speed = np.linalg.norm(series.v[series.slice(window["begin"], window["end"])], axis=1)
    assert speed.sum() * 2e-3 == pytest.approx(result["metrics"]["q_total_impact"])
    assert list((tmp_path / "run").glob("*.png")) and not list((tmp_path / "run").glob("*.pdf"))
    # Replacing an existing folder requires --force.  The same command gives the same result.
    refused = start("simulate", str(aerial), "--controller", "robust", "--out", "run", cwd=tmp_path)
    assert refused.returncode == 1 and "--force" in refused.stderr
    assert document(*command, "--force", cwd=tmp_path) == result
    # Runs of older versions have neither impulses nor effects on base and joints.
    (tmp_path / "old").mkdir()
    older = json.loads(json.dumps(result))
    for block in (older["prediction"], *(part["prediction"][0] for part in older["runs"])):
        del block["measured_impact"], block["predicted_impact"]
    for key in ("base_linear", "base_angular", "joint", "impulse"):
        del older["metrics"][key]
    (tmp_path / "old" / "run.json").write_text(json.dumps(older))
    np.savez(tmp_path / "old" / "series.npz", **{k: column for k, column in vars(series).items() if k != "impulse"})
    assert start("report", "old", cwd=tmp_path).returncode == 0
    assert "rigid prediction" not in (tmp_path / "old" / "report.html").read_text(encoding="utf-8")
    # A time series whose time does not increase cannot be reported.
    columns = vars(series) | {"t": np.zeros_like(series.t)}
    Series(**columns).save(tmp_path / "run" / "series.npz")
    refused = start("report", "run", cwd=tmp_path)
    assert refused.returncode == 1 and "run: contains no complete run" in refused.stderr


def test_simulate_without_a_compiler(aerial: Path, tmp_path: Path) -> None:
    """The user gets one warning, and the numbers equal the results with the compiled gradient."""
    command = ("simulate", aerial, "--controller", "robust", "--format", "png", "--out")
    bare = {"PATH": str(tmp_path), "CC": "", "IMPACT_POSTURE_CACHE": str(tmp_path / "cache")}
    done = start(*command, "bare", cwd=tmp_path, env=bare)
    assert done.returncode == 0
    line, *others = done.stderr.splitlines()
    assert all("of the impact windows" in other for other in others)
    assert line.startswith("warning: the gradient is interpreted, not compiled, which is slower: ")
    assert "no C compiler found" in line
    assert start(*command, "quiet", "--quiet", cwd=tmp_path, env=bare).stderr == ""
    assert start(*command, "whole", cwd=tmp_path).returncode == 0
    totals = []
    for folder, warnings in (("bare", 1), ("quiet", 1), ("whole", 0)):
        result = json.loads((tmp_path / folder / "run.json").read_text())
        assert len([w for w in result["warnings"] if "of the impact windows" not in w]) == warnings
        totals.append(result["metrics"]["q_total_impact"])
    assert totals[0] == totals[1] == pytest.approx(totals[2], rel=1e-3)


def test_simulate_prints_a_summary(push: Path, tmp_path: Path) -> None:
    done = start("simulate", str(push), "--controller", "robust", "--mode", "held", "--format", "png", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "solo8-push, robust:held" in done.stdout and "pushed after" in done.stdout
    run = json.loads((tmp_path / "solo8-push-robust-held" / "run.json").read_text())
    assert run["metrics"]["impulse"] == pytest.approx(6.5 * 0.4)
    words = " ".join(done.stdout.split())
    assert "measured rigid prediction unit" in words and "impulse 2.6 2.6 N·s" in words
    assert f"{run['metrics']['joint']['name']}: {run['metrics']['joint']['velocity']:.3g} rad/s" in words
    assert max(len(line) for line in done.stdout.splitlines()) <= 80
    assert (tmp_path / "solo8-push-robust-held" / "series-minus.npz").is_file()


@pytest.fixture(scope="session")
def falls(push: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scenario with a push so strong that the robot falls with every controller."""
    path = tmp_path_factory.mktemp("scenarios") / "falls.toml"
    text, count = re.subn(r"(?m)^force = \[6.5, 0, 0\]", "force = [60, 0, 0]", push.read_text(encoding="utf-8"))
    assert count == 1
    path.write_text(text, encoding="utf-8")
    return path


def test_simulate_a_robot_that_falls(falls: Path, tmp_path: Path) -> None:
    done = start("simulate", str(falls), *"--sign +1 --out fell --format png".split(), cwd=tmp_path)
    assert done.returncode == 4 and len(done.stderr.splitlines()) == 1
    assert "solo8-push, nominal: fell: the base" in done.stderr and "at t = " in done.stderr
    assert "q_total" not in done.stdout and "peak jump" not in done.stdout
    assert "limits made a task give way" in done.stdout and "the last command was kept" in done.stdout
    assert max(len(line) for line in done.stdout.splitlines()) <= 80
    assert list((tmp_path / "fell").glob("*.png")) and (tmp_path / "fell" / "series.npz").is_file()
    again = start("simulate", str(falls), *"--sign +1 --out fell --format png --force --json".split(), cwd=tmp_path)
    result = json.loads(again.stdout)
    assert again.returncode == 4 and result == json.loads((tmp_path / "fell" / "run.json").read_text())
    assert (result["status"], result["metrics"], result["prediction"]) == ("fell", None, None)
    assert {"status", "time", "what", "sign"} == set(result["events"][0])


def test_a_flying_robot_without_a_tilt_task_is_a_warning_before_the_run(aerial: Path, tmp_path: Path) -> None:
    def stop() -> None:
        def execute(*arguments: object, **options: object) -> None:
            raise InputError("the run starts")

        jobs.execute = reproduction.reproduce = execute

    text, count = re.subn(r"(?m)^\[control.tilt\][^\[]*", "", aerial.read_text(encoding="utf-8"))
    assert count == 1
    (tmp_path / "tumbles.toml").write_text(text, encoding="utf-8")
    for command in ("simulate", "compare"):
        done = start(command, "tumbles.toml", cwd=tmp_path, prepare=stop)
        warning, error = done.stderr.splitlines()
        assert warning.startswith("warning: no task keeps the base of tilthex_arm level, so the robot may tilt")
        assert error == "error: the run starts"
        assert start(command, str(aerial), cwd=tmp_path, prepare=stop).stderr.splitlines() == [error]
    done = start("simulate", "tumbles.toml", "--out", "run", cwd=tmp_path)
    assert done.stderr.splitlines().count(warning) == 1
    notes = json.loads((tmp_path / "run" / "run.json").read_text())["warnings"]
    assert [f"warning: {note}" for note in notes[:1]] == [warning]


@pytest.mark.long
def test_compare_robots_that_fall(falls: Path, tmp_path: Path) -> None:
    options = "--controllers nominal,stiff --seeds 1 --out both --format png --quiet --no-report".split()
    done = start("compare", str(falls), *options, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    rows = [line.split() for line in done.stdout.splitlines()]
    assert ["nominal", "fell", "1/1"] in rows and ["stiff", "fell", "1/1"] in rows
    assert "no reduction if a run of either controller did not complete" in done.stdout
    assert "seed 0: fell: the base" in done.stdout
    for row in json.loads((tmp_path / "both" / "comparison.json").read_text())["rows"]:
        assert (row["status"], row["runs"], row["completed"]) == ("fell", 1, 0)
        assert row["metrics"] == {} and row["reduction"] is None and len(row["failed"]) == 1
    # The command `report` can write the report later.
    assert not (tmp_path / "both" / "report.html").exists()
    done = start("report", "both", "--quiet", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "") and "(fell)" in (tmp_path / "both" / "report.html").read_text()
    for path in (tmp_path / "both" / "runs").iterdir():
        path.unlink()
    done = start("report", "both", cwd=tmp_path)
    assert done.returncode == 1 and "both: contains no run that can be shown" in done.stderr


def test_simulate_prints_made_and_expected_contacts(capsys: pytest.CaptureFixture[str]) -> None:
    numbers = {"relaxed_ticks": 7, "failed_ticks": 2, "contacts": 3, "contacts_asked": 5}
    event = {"status": "lost contact", "time": 1.25, "what": "2 of 5 contacts were never made", "sign": 1}
    result = {"scenario": "mine", "seed": 0, "status": "lost contact", "metrics": None, "events": [event],
              "windows": [{"kind": "dwell"}], "runs": [{"ticks": 900, "metrics": numbers}], "prediction": None,
              "offline": None, "path": None, "warnings": []}  # fmt: skip
    _show(Page(), result, "nominal", Path("there"), [])
    text = " ".join(capsys.readouterr().out.split())
    assert "contacts 3 of 5" in text and "relaxed 7 of 900 ticks" in text and "held 2 ticks" in text
    assert "t = 1.25 s: lost contact: 2 of 5 contacts were never made" in text and "q_total" not in text


def test_only_pushes_are_predicted_without_a_controller() -> None:
    """If S does not exist, a contact has no sticking jump, but its jump is not the jump of a push."""
    contact = {"frictionless": 2.0, "coulomb": 3.0, "sticking": None}
    assert _rigid(contact) == "2 without friction, 3 with the friction of the surface, – sticking"
    assert _rigid(contact | {"coulomb": None}) == "2 without a controller"


def test_progress_is_for_terminals(aerial: Path, tmp_path: Path) -> None:
    command = ("simulate", str(aerial), "--out", "run", "--force", "--format", "png", "--no-report")
    text = on_terminal(*command, cwd=tmp_path)
    for words in ("loading", "building the expressions", "simulating, t = ", "drawing"):
        assert words in text, words
    assert on_terminal(*command, "--quiet", cwd=tmp_path) == ""


def test_compare(aerial: Path, tmp_path: Path) -> None:
    done = start("compare", str(aerial), "--controllers", "nominal,robust", "--seeds", "1", "--quiet", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert max(len(line) for line in done.stdout.splitlines()) <= 80
    assert "worst joint, % of its limit" in done.stdout and "the impact itself is" in " ".join(done.stdout.split())
    assert not list(tmp_path.iterdir())
    options = "--controllers nominal,robust --seeds 2 --out both --format png".split()
    result = document("compare", str(aerial), *options, cwd=tmp_path)
    assert [row["controller"] for row in result["rows"]] == ["nominal", "robust"]
    nominal, robust = (row["metrics"]["q_total_impact"] for row in result["rows"])
    assert nominal["samples"] == 2 and nominal["half_width"] > 0
    assert result["rows"][1]["reduction"]["mean"] == pytest.approx(1 - robust["mean"] / nominal["mean"], abs=0.05)
    assert json.loads((tmp_path / "both" / "comparison.json").read_text()) == result
    for row in result["rows"]:
        assert row["metrics"]["base_linear"]["samples"] == row["metrics"]["joint_share"]["samples"] == 2
        assert row["approach"] > 0 and row["joint"]["share"] >= row["metrics"]["joint_share"]["mean"]
        assert set(row["change"]) == set(row["metrics"])
    assert result["versions"] == versions_of_runs(tmp_path / "both")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["both"], "the store is removed"
    # The report shows both runs, read from the files of the folder.
    assert start("report", "both", "--quiet", cwd=tmp_path).returncode == 0
    page = (tmp_path / "both" / "report.html").read_text()
    assert "default-src 'none'" in page and len(page) < 2e6
    assert all(f'<option value="{k}">{name}</option>' in page for k, name in enumerate(("nominal", "robust")))
    assert "Means of 2 seeds (intervals from 3 seeds on)</caption>" in page and "±" not in page, (
        "intervals need 3 seeds, as on the terminal"
    )


def test_reproduce(tmp_path: Path) -> None:
    pytest.importorskip("mujoco", reason="mujoco is not installed (the extra 'sim')")
    # A shipped scenario with a short wait and a short recovery.
    shipped = tmp_path / "scenarios"
    shipped.mkdir()
    (shipped / "solo8-push.toml").write_text(
        shortened("solo8-push", settle=1.0, patience=1.0, after=0.1, timestep=0.001, period=0.002)
    )
    command = "reproduce --scenario solo8-push --seeds 1 --out all --format png".split()
    result = document(*command, cwd=tmp_path, prepare=lambda: setattr(scenario_file, "SHIPPED", shipped))
    rows = {row["controller"]: row for row in result["rows"]}
    assert {"nominal", "robust"} < set(rows) and all(row["scenario"] == "solo8-push" for row in result["rows"])
    assert rows["robust"]["paper"] == {"nominal": 0.411, "robust": 0.342, "reduction": 0.168}
    assert rows["robust"]["reduction"]["mean"] > 0
    assert sum(row["best"] for row in result["rows"]) == 1
    text = (tmp_path / "all" / "SUMMARY.md").read_text()
    assert text == result["summary"] and "## What to choose" in text
    assert len(list((tmp_path / "all" / "runs").glob("*.json"))) == len(rows)
    assert result["versions"] == versions_of_runs(tmp_path / "all")
    assert list((tmp_path / "all").rglob("*.png"))


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (("simulate", "aerial-vertcal"), 1, "did you mean aerial-vertical"),
        (("simulate", "solo8-push", "--controller", "robst"), 1, "did you mean robust"),
        (("simulate", "solo8-push", "--controller", "nominal", "--mode", "held"), 1, "has no mode held"),
        (("simulate", "solo8-push", "--controller", "robust-flow", "--gain", "5"), 1, "'robust-flow' has no gain"),
        (("simulate", "aerial-lateral", "--sign", "-1"), 1, "omit --sign"),
        (("simulate", "solo8-push", "--gain", "-1"), 2, "above zero"),
        (("compare", "solo8-push", "--controllers", "nominal,robust:hold"), 1, "no variant 'hold'"),
        (("compare", "solo8-push", "--controllers", " , "), 2, "at least one"),
        (("reproduce", "--scenario", "mine.toml"), 1, "simulate and compare"),
        (("simulate", "missing.toml"), 1, "missing.toml"),
    ],
)
def test_a_wrong_command_is_refused_in_one_line(
    arguments: tuple[str, ...], code: int, words: str, tmp_path: Path
) -> None:
    pytest.importorskip("mujoco", reason="mujoco is not installed (the extra 'sim')")
    done = start(*arguments, cwd=tmp_path)
    assert done.returncode == code
    assert words in " ".join(done.stderr.replace("│", " ").split())
    assert "Traceback" not in done.stderr and not list(tmp_path.iterdir())
    if code == 1:
        assert len(done.stderr.strip().splitlines()) == 1
