"""Short runs of the robustness study: random draws, failures, interruption, statistics, and its page."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

pytest.importorskip("mujoco", reason="mujoco is not installed (the extra 'sim')")

from docs.studies.core import STUDIES, page_of
from docs.studies.robustness import envelope, outcomes, statistics
from docs.studies.robustness.draws import Draw, draw, prepare
from docs.studies.robustness.envelope import percent
from docs.studies.robustness.outcomes import ATTEMPTS, COMPARED, NOMINAL, NotAdmissible, Record, is_complete, point
from docs.studies.robustness.page import MARK, page, range_table
from docs.studies.robustness.statistics import change, rank, summarize
from docs.studies.robustness.study import Store, study
from docs.studies.robustness.variations import RANGES, SHIPPED, VARIATIONS
from impact_posture.config.json_block import jsonable
from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import Infeasible, SimulationDiverged
from impact_posture.experiment.jobs import Job, execute
from impact_posture.impact.impact_contact import point_on
from impact_posture.robot.robot_loader import load_robot
from impact_posture.simulation.controllers.controller_factory import ControllerFactory
from impact_posture.simulation.metrics import Metrics
from impact_posture.simulation.run import Run
from impact_posture.simulation.scenario_file import RepeatedContacts, SinglePush, read_scenario
from impact_posture.simulation.setup import Setup, set_up

DOCS = Path(__file__).parents[2] / "docs"
AERIAL, STANDING = "aerial-vertical", "solo8-push"


@pytest.mark.parametrize("scenario", list(RANGES))
def test_draws_are_the_same_every_time_and_within_their_ranges(scenario: str) -> None:
    first = len(VARIATIONS[scenario])
    draws = [draw(scenario, first + k) for k in range(300)]
    assert draws[:3] == [draw(scenario, first + k) for k in range(3)]
    assert len({str(d.values) for d in (*draws[:2], draw(scenario, first, 1), draw(scenario, first, seed=1))}) == 4
    for each in RANGES[scenario]:
        values = np.array([d.values[each.name] for d in draws])
        assert each.low <= values.min() <= values.max() <= each.high
        middle = math.sqrt(each.low * each.high) if each.scale == "log" else (each.low + each.high) / 2
        assert (values < middle).mean() == pytest.approx(0.5, abs=0.1)
        if each.scale == "sign":
            assert set(values) == {each.low, each.high}


@pytest.mark.parametrize("scenario", ["aerial-vertical", "aerial-lateral"])
def test_an_aerial_draw_looks_at_its_surface_from_where_it_is_mounted(scenario: str) -> None:
    chosen = draw(scenario, len(VARIATIONS[scenario]) + 3)
    setup, v = prepare(chosen), chosen.values
    numeric = Numeric(setup.robot.model).at(setup.q)
    tool = -numeric.placement(point_on(setup.robot, "ee")).rotation[:, 2]
    off = math.degrees(math.acos(min(1.0, abs(float(tool @ setup.scenario.normal)))))
    assert off <= math.hypot(v["tilt"], v["roll"]) + 1e-6
    model = setup.robot.model
    data = model.createData()
    pin.forwardKinematics(model, data, setup.q)
    place = data.oMi[model.getJointId("shoulder_pitch")].translation - setup.q[:3]
    np.testing.assert_allclose(place, [v["x"], 0.0, v["z"]], atol=1e-9)
    shipped = read_scenario(scenario)
    own = load_robot(shipped.robot, shipped).model.armature[6:]
    np.testing.assert_allclose(setup.robot.model.armature[6:], v["armature"] * own)
    assert setup.scenario.control.robust.gain == pytest.approx(v["gain"] * shipped.control.robust.gain)
    assert isinstance(setup.scenario.task, RepeatedContacts)
    assert setup.scenario.task.speed == v["speed"]
    assert setup.gap == pytest.approx(shipped.surface.gap)


@pytest.mark.parametrize("scenario", ["solo8-push", "talos-push"])
def test_a_standing_draw_stands_where_the_robot_stood(scenario: str) -> None:
    chosen = draw(scenario, len(VARIATIONS[scenario]) + 2)
    setup, shipped = prepare(chosen), set_up(read_scenario(scenario))
    here, there = (Numeric(s.robot.model).at(s.q) for s in (setup, shipped))
    for shape in setup.scenario.shapes:
        point = point_on(setup.robot, shape.frame, shape.center or (0.0, 0.0, 0.0))
        feet = [n.placement(point).translation for n in (here, there)]
        # The support is the point below a foot, so the center of the foot may roll a little.
        np.testing.assert_allclose(feet[0], feet[1], atol=2e-2)
        gap = setup.world.built.gaps["ground", shape.frame]
        assert gap == pytest.approx(0, abs=2e-3)
    assert np.abs(pin.difference(setup.robot.model, shipped.q, setup.q)[6:]).max() > 0.01
    task, shipped_task = setup.scenario.task, shipped.scenario.task
    assert isinstance(task, SinglePush) and isinstance(shipped_task, SinglePush)
    np.testing.assert_allclose(task.force, chosen.values["force"] * np.array(shipped_task.force))
    armature = np.asarray(shipped.robot.model.armature)
    np.testing.assert_allclose(setup.robot.model.armature, chosen.values["armature"] * armature)


def short(chosen: Draw) -> Setup:
    """Build the setup of a draw with one contact that begins at once."""
    scenario = prepare(chosen).scenario
    assert isinstance(scenario.task, RepeatedContacts)
    brief = replace(scenario.task, count=1, settle=0.2, speed=0.5, dwell=0.3, pause=0.1)
    surfaces = tuple(replace(s, gap=0.1) for s in scenario.surfaces)
    return set_up(replace(scenario, contacts=brief, surfaces=surfaces))


@pytest.mark.long(but=("aerial-vertical", "talos-push"))
@pytest.mark.parametrize("scenario", list(VARIATIONS))
def test_a_variation_changes_one_thing(scenario: str) -> None:
    named = list(VARIATIONS[scenario])
    assert named[0] == SHIPPED
    chosen = {name: prepare(draw(scenario, k)) for k, name in enumerate(named) if scenario != "talos-push" or k < 3}
    shipped = chosen.pop(SHIPPED)
    own = read_scenario(scenario)
    assert shipped.robot.model_sha256 == set_up(own).robot.model_sha256
    np.testing.assert_allclose(shipped.q, set_up(own).q)
    assert shipped.scenario.control == own.control and shipped.scenario.surfaces == own.surfaces
    for name, setup in chosen.items():
        changed = {
            "gain": setup.scenario.control.robust != own.control.robust,
            "surface": setup.scenario.surfaces != own.surfaces,
            "task": setup.scenario.task != shipped.scenario.task,
            "posture": setup.scenario.control.posture != own.control.posture,
            "start": np.abs(setup.q - shipped.q).max() > 1e-6,
            "model": setup.robot.model_sha256 != shipped.robot.model_sha256,
        }
        # The gap to the surface is constant, so another mounting also changes the start of the base.
        what = {key for key, differs in changed.items() if differs} - ({"start"} if "mount" in name else set())
        assert len(what) == 1, (name, what)


def test_both_aerial_scenarios_use_one_robot() -> None:
    vertical, lateral = (read_scenario(name) for name in ("aerial-vertical", "aerial-lateral"))
    assert set_up(vertical).robot.model_sha256 == set_up(lateral).robot.model_sha256
    own = load_robot("tilthex_arm")
    np.testing.assert_array_equal(set_up(vertical).robot.model.armature, own.model.armature)
    for scenario in (vertical, lateral):
        setup = prepare(draw(scenario.name, list(VARIATIONS[scenario.name]).index("mounted as in the URDF")))
        assert setup.robot.model_sha256 == own.model_sha256


def test_a_failure_is_an_outcome(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first start is invalid.  In the second draw, one controller diverges and another has no optimum."""
    monkeypatch.setattr(outcomes, "prepare", short)
    tried: list[str] = []
    ran: list[tuple[tuple[Run, ...], dict[str, Any]]] = []

    def play(job: Job, factory: ControllerFactory) -> tuple[tuple[Run, ...], dict[str, Any]]:
        tried.append(job.controller)
        if tried == [NOMINAL] or job.controller == "robust":
            raise SimulationDiverged(1.0)
        if job.controller == "posture":
            raise Infeasible({"none": 1.0})
        if not ran:
            ran.append(execute(replace(job, controller=NOMINAL), factory))
        return ran[0]

    number = len(VARIATIONS[AERIAL])
    record = point(AERIAL, number, 0, play=play)
    assert tried == [NOMINAL, *COMPARED]
    assert record.rejected == ("nominal control lost",)
    assert record.draw == draw(AERIAL, number, attempt=1)
    assert {c for c in COMPARED if record.failure(c)} == {"robust", "posture"}
    assert all(record.missed(c) == {"completed": "no completed run"} for c in ("robust", "posture"))
    # The record contains the run of `nominal` also as the run of `stiff`.
    assert record.documents["stiff"]["metrics"] == record.documents[NOMINAL]["metrics"]
    assert record.documents[NOMINAL]["metrics"]["contacts"] == 1
    assert record.documents[NOMINAL]["offset"] is not None
    assert change(record, "robust") == math.inf
    assert change(record, "stiff") == 0
    assert {"reduction", "recovery"} <= set(record.missed("stiff"))
    again = Record.from_json(record.to_json())
    assert again is not None and again.to_json() == record.to_json() and is_complete(again)
    text = "\n".join(page({AERIAL: [record]}, 0))
    assert "control lost 1" in text
    assert "nominal control lost: 1" in text
    assert f"- `robust` fails in `{AERIAL}` number {number}" in text
    # If a record lacks one controller, the study runs only the missing controller.
    tried.clear()
    known = replace(record, documents={c: d for c, d in record.documents.items() if c != "stiff"})
    assert not is_complete(known)
    assert point(AERIAL, number, 0, known, play).documents["stiff"]["metrics"] == record.documents["stiff"]["metrics"]
    assert tried == ["stiff"]


def test_a_point_without_an_admissible_draw_says_why() -> None:
    def play(job: Job, factory: ControllerFactory) -> tuple[tuple[Run, ...], dict[str, Any]]:
        raise SimulationDiverged(1.0)

    number = len(VARIATIONS[AERIAL]) + 5
    with pytest.raises(NotAdmissible, match=rf"{AERIAL} {number}: none of {ATTEMPTS} draws .*nominal control lost"):
        point(AERIAL, number, 0, play=play)
    # If a listed variation is not admissible, the study does not draw another one in its place.
    record = point(AERIAL, 1, 0, play=play)
    assert record.rejected == ("nominal control lost",) and not record.documents and is_complete(record)
    assert "K × 0.5 (nominal control lost)" in "\n".join(envelope.page({AERIAL: [record, *five()]}))


METRICS = Metrics(1.0, 0.5, 0.8, 2.0, 1.0, 1.0, 1.0, 1.0, 100.0, 0.0, 0.0, 0.0, 0, 0, 0.01, (), 5, 5)


def make_record(scenario: str, number: int, of: dict[str, tuple[float, float] | str], **more: float) -> Record:
    """Return a synthetic record of a random draw, with (motion, jump) or the failure of each controller."""
    documents = {}
    number += len(VARIATIONS[scenario])
    for name in COMPARED:
        result = of.get(name, (1.0, 1.0))
        document: dict[str, Any] = {"scenario": scenario, "controller": name, "seed": 0, "runs": [], "events": []}
        document |= {"duration": 1.0, "offset": 0.01 * number}
        if isinstance(result, str):
            events = [{"status": result, "time": 1.0, "what": "made", "sign": 1}]
            documents[name] = document | {"status": result, "metrics": None, "prediction": None, "events": events}
            continue
        metrics = replace(
            METRICS, q_total_impact=result[0], q_total_recovery=2 * result[0], peak_jump=result[1],
            peak_recovery=result[1], saturation_inside=result[0] / 10,
        )  # fmt: skip
        H, S = (more.get(f"{key}_{name}", 4.0) for key in "HS")
        jumps = {"frictionless": 1.0, "sticking": S, "coulomb": S}
        prediction = {"H": H, "ratio": 1.0, "impacts": 5, "approach": 1.0, **jumps}
        documents[name] = document | {
            "status": "completed", "metrics": jsonable(metrics.to_dict()), "prediction": prediction,
        }  # fmt: skip
    return Record(draw(scenario, number), (), (0.0,), documents)


def five() -> list[Record]:
    """Return five synthetic records: the motion is half, a quarter less, equal, half more, or the run failed."""
    return [
        make_record(AERIAL, 0, {NOMINAL: (2.0, 4.0), "robust": (0.9, 5.0)}, H_robust=1.0, S_robust=5.0),
        make_record(AERIAL, 1, {NOMINAL: (2.0, 4.0), "robust": (1.5, 3.0)}, H_robust=2.0, S_robust=3.0),
        make_record(AERIAL, 2, {NOMINAL: (2.0, 4.0), "robust": (2.0, 2.0)}, H_robust=3.0, S_robust=2.0),
        make_record(AERIAL, 3, {NOMINAL: (2.0, 4.0), "robust": (3.0, 6.0)}, H_robust=8.0, S_robust=6.0),
        make_record(AERIAL, 4, {NOMINAL: (2.0, 4.0), "robust": "fell"}),
    ]


def test_statistics_by_hand() -> None:
    records = five()
    summary = summarize(records, "robust")
    assert (summary.count, summary.helps, summary.gentler) == (5, 2, 2)
    # Changes of the motion are −0.55, −0.25, 0, 0.5, failed; the quartiles are the second and the fourth value.
    assert summary.motion == summary.recovery == pytest.approx((-0.25, 0.0, 0.5))
    # Changes of the jump are 0.25, −0.25, −0.5, 0.5, failed.
    assert summary.jump == pytest.approx(0.25)
    assert summary.force == pytest.approx((1.0, 1.0))
    assert summary.failures == Counter(fell=1)
    assert summary.saturation == pytest.approx((0.74, 0.0))
    assert summarize(records, NOMINAL).saturation == pytest.approx((1.0, 0.0))
    # The first record has the reduction reported in the paper, but a higher jump.
    missed = [set(record.missed("robust")) for record in records[:4]]
    assert missed[:3] == [{"peak_jump", "peak_recovery"}, {"reduction"}, {"reduction", "recovery"}]
    assert missed[3] == {"reduction", "recovery", "peak_jump", "peak_recovery", "saturation"}
    assert summary.kept == 0 and summary.missed["reduction"] == 3 and summary.missed["completed"] == 1
    assert statistics.quantile([0.0, 1.0, math.inf], 0.75) == math.inf
    assert statistics.quantile([0.0, 1.0], 0.5) == 0.5
    assert (percent(-0.254), percent(math.inf)) == ("−25 %", "fails")


def test_correlations_and_splits_by_hand() -> None:
    records = five()
    # In the records, a larger decrease of H comes with a smaller motion.  The rank correlation with a constant is
    # undefined.
    assert rank(records, "robust", lambda r: -(r.documents["robust"]["prediction"]["H"])) == pytest.approx(1)
    assert rank(records, "robust", lambda r: float(r.draw.number)) == pytest.approx(-1)
    assert math.isnan(rank(records, "robust", lambda r: 1.0))
    first = len(VARIATIONS[AERIAL])
    chosen, others = statistics.split(records, "robust", lambda r: r.draw.number < first + 2)
    assert (chosen.count, chosen.helps, chosen.median) == (2, 2, pytest.approx(-0.4))
    assert (others.count, others.helps, others.median) == (3, 0, pytest.approx(0.5))
    # H decreased in the first three records and increased in the fourth.  The signs of the changes of motion and H
    # differ in one record, and so do the signs of jump and H.
    for metric in ("q_total_impact", "peak_jump"):
        assert statistics.agreement(records, ["robust"], "H", metric) == (3, 4)
    # In these records, S correlates perfectly with the jump of `robust`.
    alone = [replace(r, documents={"robust": r.documents["robust"]}) for r in records]
    assert statistics.ranks_of_jumps(alone, ("H", "V", "S")) == pytest.approx(
        {"n": 4, "H": 0.2, "V": math.nan, "S": 1.0}, nan_ok=True
    )
    assert statistics.worst(records, "robust") is records[3]
    # In three records, H decreased.  In one of three records with lower H, the jump increased.
    assert statistics.misled(records, "robust") is records[0]
    text = "\n".join(page({AERIAL: records}, 0))
    assert f"`robust` moves the robot most, compared with nominal, in `{AERIAL}` number {first + 3}" in text
    assert f"The jump rises although H falls most in `{AERIAL}` number {first}" in text
    assert "motion −55 %, jump +25 %, √H 2 → 1, v√S 4 → 5" in text


def test_the_advice_follows_the_numbers() -> None:
    good = [make_record(AERIAL, k, {"robust": (0.9, 1.0), "posture": (0.4, 0.5)}) for k in range(4)]
    poor = [make_record(AERIAL, k, {"robust": (1.1, 1.0), "posture": "fell"}) for k in range(4)]
    advice = "\n".join(page({AERIAL: good}, 0)).partition(MARK)[0]
    assert "Take `posture`" in advice and "It keeps every target at 4 of 4 points" in advice
    assert "−60 % at the median" in advice
    advice = "\n".join(page({AERIAL: poor}, 0)).partition(MARK)[0]
    assert "No controller keeps its targets reliably" in advice and "Take" not in advice
    assert f"**What failed:** `posture` in `{AERIAL}` at 4 of 4 points (fell 4)." in advice
    stiff = {"robust": (0.7, 1.0), "stiff": (0.6, 1.0), "posture": (1.0, 1.0)}
    text = "\n".join(page({STANDING: [make_record(STANDING, k, stiff) for k in range(4)]}, 0))
    assert "the median motion changes by −40 % with `stiff` and by +0 % with `posture`: the stiffness" in text
    kept, missed = ("\n".join(envelope.page({AERIAL: records})) for records in (good, poor))
    assert "Take `posture`" in kept and "failed 4" in missed
    assert "0 variations one at a time and 4 random draws" in kept and "Its effect is not known" in kept


def test_an_interrupted_study_continues_with_the_same_page(tmp_path: Path) -> None:
    scenarios, ran = [AERIAL, STANDING], []

    def runner(limit: int) -> Callable[..., Record]:
        def run(scenario: str, number: int, seed: int, known: Record | None) -> Record:
            if len(ran) == limit:
                raise KeyboardInterrupt
            ran.append((scenario, number))
            record = make_record(scenario, number, {"robust": (0.5 + 0.2 * number, 0.9), "posture": "fell"})
            return replace(record, draw=draw(scenario, number))

        return run

    counts = dict.fromkeys(scenarios, 3)
    whole, parts = (Store(tmp_path / name, 0) for name in ("whole", "parts"))
    study(counts, 0, 1, whole, run=runner(6))
    first, ran = ran, []
    with pytest.raises(KeyboardInterrupt):
        study(counts, 0, 1, parts, run=runner(4))
    # After an interruption, all scenarios have equally many complete points, with every controller.
    assert [len(own) for own in parts.complete(scenarios).values()] == [2, 2]
    said: list[str] = []
    study(counts, 0, 1, parts, run=runner(9), tell=said.append)
    assert ran == first
    assert len(said) == 2
    assert "\n".join(page(parts.complete(scenarios), 0)) == "\n".join(page(whole.complete(scenarios), 0))
    # Records with another seed or other parameter ranges are ignored.
    assert Store(tmp_path / "parts", 1).get(AERIAL, 0) is None
    [file] = (tmp_path / "parts").rglob(f"{AERIAL}/000.json")
    file.write_text(file.read_text(encoding="utf-8").replace("'speed', 0.25", "'speed', 0.3"), encoding="utf-8")
    assert Store(tmp_path / "parts", 0).get(AERIAL, 0) is None


def test_the_page_has_every_range_and_controller_and_the_prose_no_numbers() -> None:
    written = page_of("robustness").read_text(encoding="utf-8")
    assert written.startswith(STUDIES["robustness"].head)
    assert MARK in written
    for line in range_table(list(RANGES)):
        assert line in written, f"make study-robustness: {line}"
    for scenario in RANGES:
        for controller in COMPARED:
            assert f"| `{scenario}` | `{controller}` |" in written
    targets = page_of("envelope").read_text(encoding="utf-8")
    assert targets.startswith(STUDIES["envelope"].head)
    # Only the first variations are required, because the study may have been stopped early.
    for scenario, variations in VARIATIONS.items():
        rows = targets.partition(f"`{scenario}`:\n")[2].partition("\n\n`")[0]
        for name in list(variations)[:3]:
            assert f"| {name} |" in rows, f"make study-robustness: {name}"
    prose = (DOCS / "where-bracing-helps.md").read_text(encoding="utf-8")
    words = re.sub(r"\$[^$]*\$|\]\([^)]*\)|`[^`]*`|\{include\}.*", "", prose)
    assert not re.findall(r"\d", words)
    assert prose.index(":end-before:") < prose.index(":start-after:")
