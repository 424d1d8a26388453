"""Means, intervals, reductions, targets and texts, computed from synthetic documents."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from impact_posture.config.json_block import jsonable
from impact_posture.errors import InputError
from impact_posture.experiment.jobs import Job, combined, parse_controller
from impact_posture.experiment.reproduction import (
    PAPER,
    RECOMMENDED,
    Reproduction,
    best_of,
    controllers_of,
    gather,
    jobs_of,
    missed_targets,
)
from impact_posture.experiment.reproduction_summary import advice, remarks, scenario_table, summary, table_one
from impact_posture.experiment.seed_statistics import QUANTITIES, Interval, fate, headline, row_of, statistic
from impact_posture.impact.evaluation.impact_effect import ImpactLoad, WorstJoint
from impact_posture.simulation.controllers.controller_factory import CONTROLLERS, MEANING
from impact_posture.simulation.metrics import Metrics
from impact_posture.simulation.outcome import gravest
from impact_posture.simulation.scenario_file import known_scenarios

ELBOW = WorstJoint("elbow", 2.0, "rad/s", 0.4)
METRICS = Metrics(
    1.0, 0.5, 0.8, 2.0, 2.5, 3.0, 3.5, 3.0, 100.0, 0.1, 0.2, 0.05, 7, 0, 0.01, (), 5, 5,
    base_linear=0.2, base_angular=1.0, joint=ELBOW, impulse=0.5,
)  # fmt: skip


def document(controller: str, seed: int, q: float, **changed: Any) -> dict[str, Any]:
    values = {**vars(METRICS), "q_total_impact": q, "q_total_recovery": 2 * q, **changed}
    prediction = {"H": 10.0 * q, "ratio": 1.2, "coulomb": 2.5, "approach": 0.5}
    return {"scenario": "aerial-vertical", "controller": controller, "seed": seed, "status": "completed",
            "events": [], "runs": [{"sign": 1}], "metrics": jsonable(Metrics(**values).to_dict()),
            "prediction": prediction}  # fmt: skip


NOMINAL = [document("nominal", k, 2.0 + 0.1 * k) for k in range(4)]


def test_interval_follows_students_t() -> None:
    samples = [1.0, 2.0, 4.0, 4.5]
    interval = Interval.of(samples)
    assert interval.shown == interval.half_width and Interval.of(samples[:2]).shown is None
    low, high = stats.t.interval(0.95, 3, loc=np.mean(samples), scale=stats.sem(samples))
    assert interval.mean - interval.half_width == pytest.approx(low)
    assert interval.mean + interval.half_width == pytest.approx(high)
    assert Interval.of([3.0]) == Interval(3.0, None, 1)
    # Runs without sensor noise differ only by rounding, as these three values do.
    same = Interval.of([0.1 + 0.2, 0.3, 0.3])
    assert same.alike and same.shown is None and not interval.alike
    assert statistic(3, [same, same]) == "means of 3 seeds, all alike, because the scenario has no noise"
    assert statistic(3, [same, interval]) == "means of 3 seeds ± half of the 95 % confidence interval"
    assert statistic(2, []) == "means of 2 seeds (intervals from 3 seeds on)" and statistic(1, []).startswith(
        "one seed"
    )


def test_reductions_are_paired_by_seed() -> None:
    # The value of each seed is half of the nominal value of this seed; seed 9 has no nominal run.
    documents = [document("robust", k, (2.0 + 0.1 * k) / 2) for k in (3, 1, 0, 2)] + [document("robust", 9, 50.0)]
    row = row_of("aerial-vertical", "robust", documents, NOMINAL)
    assert row.reduction is not None
    assert row.reduction.mean == pytest.approx(0.5) and row.reduction.half_width == pytest.approx(0, abs=1e-12)
    assert row.reduction.samples == 4
    assert row.metrics["q_total_impact"].samples == 5
    assert set(row.metrics) == set(QUANTITIES)


def failed(controller: str, seed: int, *statuses: str) -> dict[str, Any]:
    events = [{"status": s, "time": 1.5 + k, "what": f"broke bound {k}", "sign": 1} for k, s in enumerate(statuses)]
    return {"scenario": "aerial-vertical", "controller": controller, "seed": seed, "status": statuses[-1],
            "events": events, "runs": [{"sign": 1}], "metrics": None, "prediction": None}  # fmt: skip


def test_failed_runs_are_reported_and_left_out() -> None:
    documents = [document("robust", 0, 1.0), failed("robust", 1, "lost contact", "fell")]
    row = row_of("aerial-vertical", "robust", documents, NOMINAL)
    assert (row.status, row.completed, row.runs) == ("fell", 1, 2)
    assert row.failed == ("seed 1: fell: broke bound 1 at t = 2.50 s",) and row.metrics["peak_jump"].samples == 1
    # If the robot fell with either controller, the text contains no comparison.
    assert row.reduction is None and row.recovery is None and not row.change and missed_targets(row) is None
    against = row_of("aerial-vertical", "robust", [document("robust", 0, 1.0)], [failed("nominal", 0, "fell")])
    assert against.status == "completed" and against.reduction is None
    assert jsonable(row)["reduction"] is None and jsonable(row)["completed"] == 1
    nothing = row_of("aerial-vertical", "robust", documents[1:], NOMINAL)
    assert nothing.reduction is None and missed_targets(nothing) is None and not nothing.metrics
    assert "| robust | fell, 0 of 1 completed |" in scenario_table([nothing])
    results = Reproduction(2, (row_of("aerial-vertical", "nominal", NOMINAL[:2], NOMINAL[:2]), row))
    assert best_of(results.rows) is None and "nothing was better" in advice(results)[0]
    assert "robust`: seed 1: fell" in summary(results)


def test_the_gravest_event_of_two_pushes_is_reported() -> None:
    both = {**failed("robust", 0, "control lost", "fell"), "runs": [{"sign": 1}, {"sign": -1}]}
    assert fate(both) == "fell: broke bound 1 at t = 2.50 s (push +1)"
    assert [gravest(s) for s in ((), ("completed", "lost contact"), ("fell", "control lost"))] == [
        "completed", "lost contact", "fell"
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("changed", "missed"),
    [
        ({}, ()),
        ({"q": 1.1}, ("reduction",)),
        # If a controller delays motion during the impact window, the motion follows in the recovery.
        ({"q_total_recovery": 4.7}, ("recovery",)),
        ({"q_total_recovery": 4.2}, ()),
        ({"peak_recovery": 3.1}, ("peak_recovery",)),
        ({"peak_jump": 3.1}, ("peak_jump",)),
        ({"saturation_inside": 0.11}, ("saturation",)),
        ({"saturation_outside": 0.21}, ("saturation_outside",)),
        ({"stops": ("elbow",)}, ("stops",)),
        ({"rested": False}, ("rested",)),
    ],
)
def test_targets(changed: dict[str, Any], missed: tuple[str, ...]) -> None:
    documents = [document("robust", k, **{"q": 0.9, **changed}) for k in range(4)]
    targets = missed_targets(row_of("aerial-vertical", "robust", documents, NOMINAL))
    assert targets is not None and tuple(targets) == missed and all(targets.values())


def rows() -> list[Any]:
    good = [document("posture", k, 0.5) for k in range(4)]
    less = [document("robust", k, 0.4, peak_jump=4.0) for k in range(4)]
    restless = [document("walker", k, 0.1, rested=False) for k in range(4)]
    return gather("aerial-vertical", ["nominal", "robust", "posture", "walker"], [*NOMINAL, *less, *good, *restless])


def test_the_best_row_meets_the_targets_or_else_moves_least() -> None:
    best = best_of(rows())
    assert best is not None and best.controller == "posture"
    # Without the controller `posture`, no controller meets all targets.  The controller `walker` moves least, but did
    # not come to rest.
    best = best_of([row for row in rows() if row.controller != "posture"])
    assert best is not None and best.controller == "robust"
    assert best_of(rows()[:1]) is None


def test_the_summary_begins_with_advice_and_names_faults() -> None:
    results = Reproduction(4, tuple(rows()))
    lines = advice(results)
    assert len(lines) == 1 and "`posture`" in lines[0] and "meets every target." in lines[0]
    assert "a higher peak jump than nominal" in lines[0]
    text = summary(results)
    assert text.index("What to choose") < text.index("Table I")
    assert "does not come to rest" in "\n".join(remarks(results, "aerial-vertical"))
    cells = re.findall(r"^\| aerial-vertical \|.*$", table_one(results), re.MULTILINE)[0]
    assert "10.4" in cells and "5.1" in cells and "51.0 %" in cells and "posture" in cells
    json_rows = results.to_dict()["rows"]
    assert [row["best"] for row in json_rows] == [False, False, True, False]
    assert json_rows[0]["paper"] == {"nominal": 10.4, "robust": 5.1, "reduction": 0.51}


def test_the_summary_of_one_seed_has_no_intervals() -> None:
    single = gather("aerial-vertical", ["nominal", "robust"], [NOMINAL[0], document("robust", 0, 1)])
    text = summary(Reproduction(1, tuple(single)))
    assert "±" not in text and "no intervals" in text


def test_the_held_posture_separates_stiffness_from_posture() -> None:
    for held, word in ((1.9, "stiffness"), (0.6, "Most of the reduction comes from the posture")):
        parts = [
            *NOMINAL,
            *[document("robust", k, 0.5) for k in range(4)],
            *[document("robust", k, held) for k in range(4)],
        ]
        held_rows = gather("aerial-vertical", ["nominal", "robust", "robust:held"], parts)
        assert word in "\n".join(remarks(Reproduction(4, tuple(held_rows)), "aerial-vertical"))


def test_names_of_controllers() -> None:
    assert parse_controller("robust") == ("robust", "live", False)
    assert parse_controller(" robust:held:free ") == ("robust", "held", True)
    with pytest.raises(InputError, match="no variant 'hold'"):
        parse_controller("robust:hold")
    assert [job.label for job in jobs_of({"solo8-push": ["nominal", "robust:held"]}, 2)] == [
        "nominal", "nominal", "robust:held", "robust:held"
    ]  # fmt: skip
    assert Job("a/b.toml", "robust", 3, "held").name == "a_b.toml-robust-held-3"


def test_values_of_the_paper_fit_the_scenarios() -> None:
    assert set(PAPER) == set(RECOMMENDED) < set(known_scenarios())
    assert set(MEANING) == set(CONTROLLERS)
    for name, row in PAPER.items():
        # The percentages in the text are computed from the rounded numbers of the table.
        assert row.reduction == pytest.approx(1 - row.robust / row.nominal, abs=6e-3)
        assert controllers_of(name, False)[:2] == ("nominal", "robust")
        assert set(CONTROLLERS) < set(controllers_of(name, True))


def test_recommendations_match_the_page_of_the_envelope() -> None:
    page = (Path(__file__).parents[2] / "docs" / "generated" / "envelope.md").read_text(encoding="utf-8")
    assert dict(re.findall(r"^- \*\*([\w-]+)\*\*: .*?(?:Take|The best is) `([\w-]+)`", page, re.M)) == RECOMMENDED


def test_metrics_of_both_signs() -> None:
    other = Metrics(
        **{**METRICS.__dict__, "q_total_impact": 3.0, "peak_jump_max": 9.0, "stops": ("knee",), "rested": False}
    )
    both = combined([METRICS, other])
    assert (both.q_total_impact, both.peak_jump_max, both.relaxed_ticks) == (2.0, 9.0, 14)
    assert both.stops == ("knee",) and not both.rested
    assert combined([METRICS]) is METRICS

    wrist = WorstJoint("wrist", 1.0, "rad/s", 0.5)
    pushed = replace(METRICS, base_linear=0.4, base_angular=3.0, joint=wrist, impulse=1.5, peak_force=150.0)
    both = combined([METRICS, pushed])
    assert both.load == ImpactLoad(pytest.approx(0.3), 2.0, wrist, 1.0, 150.0, 3.0)
    fixed = combined([replace(METRICS, base_linear=None, base_angular=None)] * 2)
    assert (fixed.base_linear, fixed.base_angular, fixed.joint) == (None, None, ELBOW)


def compared(*, seeds: int = 4, noise: float = 0.0, **changed: Any) -> tuple[Any, Any]:
    """Return the rows of a controller with changed metrics, and of nominal."""
    wobble = [noise * (-1) ** k for k in range(seeds)]
    joint = changed.pop("share", 0.4)
    parts = [document("nominal", k, 2.0) for k in range(seeds)]
    for k in range(seeds):
        factors = {key: getattr(METRICS, key) * (factor + wobble[k]) for key, factor in changed.items()}
        worst = replace(ELBOW, velocity=2.0 * joint / 0.4, share=joint)
        parts.append(document("robust", k, 1.0, **factors, joint=worst))
    nominal, row = gather("aerial-vertical", ["nominal", "robust"], parts)
    return jsonable(row), jsonable(nominal)


def test_the_headline_says_for_whom_the_impact_is_better() -> None:
    row, nominal = compared(share=0.3, peak_jump=1.2, peak_force=2.0, base_linear=1.5)
    assert headline(row, nominal) == (
        "robust moves 50% less; peak jump +20%, peak force × 2; "
        "the impact itself is better for the joints at the price of base and force"
    )
    assert headline(*compared(share=0.3, base_angular=1.02)).endswith("the impact itself is better")
    assert headline(*compared(impulse=1.1)).endswith("the impact itself is worse")
    # A change of 30 % with an interval of 57 % is not significant, and the text says so.
    doubtful = compared(base_linear=1.3, noise=0.5)
    assert doubtful[0]["change"]["base_linear"]["half_width"] > 0.06
    assert headline(*doubtful).endswith("the impact itself is no better beyond the intervals")
    assert headline(*compared(base_linear=1.3, noise=0.5, seeds=2)).endswith("the impact itself is worse")
    # A change of the base of less than 1 % of the approach speed (0.5 m/s) is negligible.
    slight = compared(base_linear=1.07)
    for part in slight:
        part["metrics"]["base_linear"]["mean"] /= 10
        part["change"]["base_linear"]["mean"] /= 10
    assert headline(*slight).endswith("the impact itself is no better")
    # Results of older versions have no impulse.
    del row["change"]["impulse"]
    assert headline(row, nominal) == "robust moves 50% less; peak jump +20%, peak force × 2"


def test_the_worst_joint_of_a_row_is_the_worst_of_any_seed() -> None:
    wrist = WorstJoint("wrist", 3.0, "rad/s", 0.6)
    documents = [document("robust", 0, 1.0), document("robust", 1, 1.0, joint=wrist)]
    row = row_of("aerial-vertical", "robust", documents, NOMINAL[:2])
    assert row.joint == wrist and row.approach == pytest.approx(0.5)
    assert row.metrics["joint_share"].mean == pytest.approx(0.5) and row.change["joint_velocity"].mean == 0.5
    assert "wrist 2.5 rad/s, 50 %" in scenario_table([row])
    # A fixed robot without velocity limits.
    changed = {"base_linear": None, "base_angular": None, "joint": replace(ELBOW, share=None)}
    bare = [document(name, 0, 1.0, **changed) for name in ("nominal", "robust")]
    nominal, row = gather("aerial-vertical", ["nominal", "robust"], bare)
    assert {*QUANTITIES} - {*row.metrics} == {"base_linear", "base_angular", "joint_share"}
    assert "| elbow 2 rad/s |" in scenario_table([row]) and headline(jsonable(row), jsonable(nominal))


def test_documents_have_no_infinities() -> None:
    assert jsonable({"a": [1.0, float("inf")], "b": (float("nan"), "x", None, 3)}) == {
        "a": [1.0, None],
        "b": [None, "x", None, 3],
    }
