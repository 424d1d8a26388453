"""The robustness study in short: draws, what goes wrong, going on where it was, statistics; and its page."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

pytest.importorskip("mujoco", reason="mujoco is not installed (the extra 'sim')")

from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import InputError, SimulationDiverged
from impact_posture.impact.contact import point_on
from impact_posture.robot.robot_loader import load_robot
from impact_posture.simulation.controller_factory import ControllerFactory
from impact_posture.simulation.run import Run
from impact_posture.simulation.scenario import RepeatedContacts, Setup, SinglePush, set_up
from impact_posture.simulation.scenario_file import read_scenario
from tests.benchmarks.core import STUDIES, page_of
from tests.benchmarks.robustness import outcomes
from tests.benchmarks.robustness.draws import RANGES, Draw, draw, prepare
from tests.benchmarks.robustness.outcomes import (
    ATTEMPTS,
    HELD,
    NOMINAL,
    NotAdmissible,
    Outcome,
    Record,
    configuration,
    controllers,
    play,
)
from tests.benchmarks.robustness.page import MARK, page, percent, range_table
from tests.benchmarks.robustness.statistics import agreement, change, misled, quantile, rank, split, summarize, worst
from tests.benchmarks.robustness.study import Store, study

DOCS = Path(__file__).parents[1] / "docs"
AERIAL, STANDING = "aerial-vertical", "solo8-push"


@pytest.mark.parametrize("scenario", list(RANGES))
def test_draws_are_the_same_every_time_and_within_their_ranges(scenario: str) -> None:
    draws = [draw(scenario, k) for k in range(300)]
    assert draws[:3] == [draw(scenario, k) for k in range(3)]
    for other in (draw(scenario, 1), draw(scenario, 0, attempt=1), draw(scenario, 0, seed=1)):
        assert other.values != draws[0].values
    for each in RANGES[scenario]:
        values = np.array([d.values[each.name] for d in draws])
        assert each.low <= values.min() <= values.max() <= each.high
        middle = math.sqrt(each.low * each.high) if each.scale == "log" else (each.low + each.high) / 2
        assert (values < middle).mean() == pytest.approx(0.5, abs=0.1)
        if each.scale == "sign":
            assert set(values) == {each.low, each.high}


@pytest.mark.parametrize("scenario", ["aerial-vertical", "aerial-lateral"])
def test_an_aerial_draw_looks_at_its_surface_from_where_it_is_mounted(scenario: str) -> None:
    chosen = draw(scenario, 3)
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
    chosen = draw(scenario, 2)
    setup, shipped = prepare(chosen), set_up(read_scenario(scenario))
    here, there = (Numeric(s.robot.model).at(s.q) for s in (setup, shipped))
    for shape in setup.scenario.shapes:
        point = point_on(setup.robot, shape.frame, shape.center or (0.0, 0.0, 0.0))
        feet = [n.placement(point).translation for n in (here, there)]
        # A foot is held at the point under it: its center may roll by that.
        np.testing.assert_allclose(feet[0], feet[1], atol=2e-2)
        gap = setup.world.built.gaps["ground", shape.frame]
        assert gap == pytest.approx(0, abs=2e-3)
    assert np.abs(pin.difference(setup.robot.model, shipped.q, setup.q)[6:]).max() > 0.01
    task, own = setup.scenario.task, shipped.scenario.task
    assert isinstance(task, SinglePush)
    assert isinstance(own, SinglePush)
    np.testing.assert_allclose(task.force, chosen.values["force"] * np.array(own.force))
    assert task.signs == (int(chosen.values["sign"]),)
    bare = np.asarray(shipped.robot.model.armature)
    np.testing.assert_allclose(setup.robot.model.armature, chosen.values["armature"] * bare)


def short(chosen: Draw) -> Setup:
    """The draw with one contact, at once."""
    scenario = prepare(chosen).scenario
    assert isinstance(scenario.task, RepeatedContacts)
    brief = replace(scenario.task, count=1, settle=0.2, speed=0.5, dwell=0.3, pause=0.1)
    surfaces = tuple(replace(s, gap=0.1) for s in scenario.surfaces)
    return set_up(replace(scenario, contacts=brief, surfaces=surfaces))


def test_what_goes_wrong_is_an_outcome(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first draw is not admissible; in the second one controller runs away, another has no optimum."""
    monkeypatch.setattr(outcomes, "prepare", short)
    tried: list[str] = []

    def runs(factory: ControllerFactory, controller: str) -> tuple[Run, ...]:
        tried.append(controller)
        if tried == [NOMINAL] or controller == "robust":
            raise SimulationDiverged(1.0)
        if controller == "posture":
            raise InputError("none")
        return play(factory, NOMINAL)

    record = configuration(AERIAL, 0, 0, runs)
    assert tried == [NOMINAL, NOMINAL, "robust", "robust-speed", "posture"]
    assert record.rejected == ("nominal diverged",)
    assert record.draw == draw(AERIAL, 0, attempt=1)
    assert {c: o.failure for c, o in record.outcomes.items()} == {
        NOMINAL: "", "robust": "diverged", "robust-speed": "", "posture": "raised InputError",
    }  # fmt: skip
    # The same run as nominal's.
    assert record.outcomes["robust-speed"] == record.outcomes[NOMINAL]
    assert record.outcomes[NOMINAL].metrics["contacts"] == 1
    assert record.outcomes[NOMINAL].offset is not None
    assert change(record, "robust") == math.inf
    assert change(record, "robust-speed") == 0
    assert Record.from_json(record.to_json()) == record
    text = "\n".join(page({AERIAL: [record]}, 0))
    assert "diverged 1" in text
    assert "nominal diverged: 1" in text
    assert f"- Failed, diverged: `{AERIAL}` number 0" in text


def test_a_configuration_that_never_works_says_why() -> None:
    def runs(factory: ControllerFactory, controller: str) -> tuple[Run, ...]:
        raise SimulationDiverged(1.0)

    with pytest.raises(NotAdmissible, match=rf"{AERIAL} 5: none of {ATTEMPTS} draws .*nominal diverged"):
        configuration(AERIAL, 5, 0, runs)


def made(scenario: str, number: int, of: dict[str, tuple[float, float] | str], **more: float) -> Record:
    """A record with (motion, jump) of each controller, or its failure."""
    found = {}
    for name in controllers(scenario):
        given = of.get(name, (1.0, 1.0))
        if isinstance(given, str):
            found[name] = Outcome(given)
            continue
        saturation = {"saturation_inside": given[0] / 10, "saturation_outside": 0.0}
        found[name] = Outcome(
            "", {"q_total_impact": given[0], "peak_jump": given[1], **saturation}, (), more.get(f"H_{name}", 4.0),
            more.get(f"V_{name}", 4.0), 0.01 * (number + 1),
        )  # fmt: skip
    return Record(draw(scenario, number), (), (0.0,), found)


def five() -> list[Record]:
    """Motion against nominal's 2.0: halved, a quarter less, the same, half more, failed."""
    return [
        made(AERIAL, 0, {NOMINAL: (2.0, 4.0), "robust": (1.0, 5.0)}, H_robust=1.0),
        made(AERIAL, 1, {NOMINAL: (2.0, 4.0), "robust": (1.5, 3.0)}, H_robust=2.0),
        made(AERIAL, 2, {NOMINAL: (2.0, 4.0), "robust": (2.0, 2.0)}, H_robust=3.0),
        made(AERIAL, 3, {NOMINAL: (2.0, 4.0), "robust": (3.0, 6.0)}, H_robust=8.0),
        made(AERIAL, 4, {NOMINAL: (2.0, 4.0), "robust": "fell"}),
    ]


def test_statistics_by_hand() -> None:
    records = five()
    found = summarize(records, "robust")
    assert (found.count, found.helps, found.gentler, found.both, found.freer) == (5, 2, 2, 1, 3)
    # Changes −0.5, −0.25, 0, 0.5, failed: the quartiles are the second and the fourth.
    assert found.quartiles == pytest.approx((-0.25, 0.0, 0.5))
    # Of the jump 0.25, −0.25, −0.5, 0.5, failed.
    assert found.jump == pytest.approx(0.25)
    assert found.failures == Counter(fell=1)
    assert found.saturation == pytest.approx((0.75, 0.0))
    assert summarize(records, NOMINAL).saturation == pytest.approx((1.0, 0.0))
    assert quantile([0.0, 1.0, math.inf], 0.75) == math.inf
    assert quantile([0.0, 1.0], 0.5) == 0.5
    assert (percent(-0.254), percent(math.inf)) == ("−25 %", "fails")


def test_what_goes_with_success_by_hand() -> None:
    records = five()
    # The more H fell, the less motion; what is constant has no rank.
    assert rank(records, "robust", lambda r: -(r.outcomes["robust"].H or 0)) == pytest.approx(1)
    assert rank(records, "robust", lambda r: float(r.draw.number)) == pytest.approx(-1)
    assert math.isnan(rank(records, "robust", lambda r: 1.0))
    chosen, others = split(records, "robust", lambda r: r.draw.number < 2)
    assert (chosen.count, chosen.helps, chosen.median) == (2, 2, pytest.approx(-0.375))
    assert (others.count, others.helps, others.median) == (3, 0, pytest.approx(0.5))
    # H fell in the first three and rose in the fourth: the motion went with it but in the third, the jump but in the
    # first.
    assert agreement(records, ["robust"], "H", "q_total_impact") == (3, 4)
    assert agreement(records, ["robust"], "H", "peak_jump") == (3, 4)
    bad, wrong = worst(records, "robust"), misled(records, "robust")
    assert bad is records[3]
    # H fell in three; in the first of them the jump rose.
    assert wrong is records[0]
    text = "\n".join(page({AERIAL: records}, 0))
    assert f"Worst motion: `{AERIAL}` number 3" in text
    assert f"H fell most and the jump rose: `{AERIAL}` number 0" in text
    assert "motion −50 %, jump +25 %, H 4 → 1" in text


def test_the_advice_follows_the_numbers() -> None:
    good = [made(AERIAL, k, {"robust": (0.9, 1.0), "posture": (0.5, 0.5)}) for k in range(4)]
    poor = [made(AERIAL, k, {"robust": (1.1, 1.0), "posture": "fell"}) for k in range(4)]
    advice = "\n".join(page({AERIAL: good}, 0)).partition(MARK)[0]
    assert "take `posture`: it moved the robot less than the nominal controller in 4 of 4" in advice
    assert "median −50 %" in advice
    advice = "\n".join(page({AERIAL: poor}, 0)).partition(MARK)[0]
    assert "nothing helps reliably" in advice
    assert "take" not in advice
    assert f"**What failed:** `posture` in `{AERIAL}` (fell in 4 of 4)." in advice
    live = [made(STANDING, k, {"robust": (0.7, 1.0), HELD: (0.99, 1.0)}) for k in range(4)]
    assert f"`{STANDING}` −30 % live, −1 % held: stiffness" in "\n".join(page({STANDING: live}, 0))


def test_an_interrupted_study_goes_on_and_says_the_same(tmp_path: Path) -> None:
    scenarios, ran = [AERIAL, STANDING], []

    def runner(limit: int) -> Callable[[str, int, int], Record]:
        def run(scenario: str, number: int, seed: int) -> Record:
            if len(ran) == limit:
                raise KeyboardInterrupt
            ran.append((scenario, number))
            return made(scenario, number, {"robust": (0.5 + 0.2 * number, 0.9), "posture": "fell"})

        return run

    whole = study(scenarios, 3, 0, 1, Store(tmp_path / "whole", 0), run=runner(6))
    first, ran = ran, []
    with pytest.raises(KeyboardInterrupt):
        study(scenarios, 3, 0, 1, Store(tmp_path / "parts", 0), run=runner(4))
    said: list[str] = []
    parts = study(scenarios, 3, 0, 1, Store(tmp_path / "parts", 0), run=runner(9), tell=said.append)
    assert ran == first
    assert len(said) == 2
    assert "\n".join(page(parts, 0)) == "\n".join(page(whole, 0))
    # Another seed, and records of a study with other ranges, are other studies.
    assert Store(tmp_path / "parts", 1).get(AERIAL, 0) is None
    [file] = (tmp_path / "parts").rglob(f"{AERIAL}/000.json")
    file.write_text(file.read_text(encoding="utf-8").replace("'speed', 0.25", "'speed', 0.3"), encoding="utf-8")
    assert Store(tmp_path / "parts", 0).get(AERIAL, 0) is None


def test_the_page_is_the_studys_and_the_prose_has_no_numbers_of_its_own() -> None:
    written = page_of("robustness").read_text(encoding="utf-8")
    assert written.startswith(STUDIES["robustness"].head)
    assert MARK in written
    for line in range_table(list(RANGES)):
        assert line in written, f"make study-robustness: {line}"
    for scenario in RANGES:
        for controller in controllers(scenario):
            assert f"| `{scenario}` | `{controller}` |" in written
    prose = (DOCS / "where-bracing-helps.md").read_text(encoding="utf-8")
    words = re.sub(r"\$[^$]*\$|\]\([^)]*\)|`[^`]*`|\{include\}.*", "", prose)
    assert not re.findall(r"\d", words)
    assert prose.index(":end-before:") < prose.index(":start-after:")
