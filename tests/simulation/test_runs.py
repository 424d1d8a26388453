"""Short runs: every controller completes, runs are reproducible, and time windows are correct."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from impact_posture.errors import ControllerNotFound, InputError
from impact_posture.simulation.controllers.contact_reference import Reference
from impact_posture.simulation.controllers.controller_factory import CONTROLLERS, Mode
from impact_posture.simulation.metrics import measure
from impact_posture.simulation.outcome import judge
from impact_posture.simulation.prediction import predict
from impact_posture.simulation.run import run
from impact_posture.simulation.scenario_file import RepeatedContacts, SinglePush, read_scenario
from impact_posture.simulation.setup import set_up
from impact_posture.simulation.world.world import build_world
from tests.simulation.factories import (
    AERIAL,
    PUSHES,
    SHIPPED,
    controller_factory,
    driven,
    fields_of,
    lived,
    near,
    shared_factory,
    shortened,
)

# In scenarios without an approach, `reference-spreading` and `impact-aware` equal the nominal controller.
APPROACH = ("reference-spreading", "impact-aware")
# Controllers with separate tests.
PATHS = ("path", "strike")
ALL = [("aerial-vertical", name, "live") for name in CONTROLLERS if name not in PATHS]
ALL += [("solo8-push", name, "live") for name in CONTROLLERS if name not in (*PATHS, *APPROACH)]
FEW = ("nominal", "robust", "robust-flow", "walker", "invariant")
ALL += [(name, few, "live") for name in ("aerial-lateral", "talos-push") for few in FEW]
ALL += [("aerial-lateral", "reference-spreading", "live"), ("talos-push", "posture", "live")]
ALL += [(name, "robust", "held") for name in SHIPPED]
ALL += [(name, "walker", "held") for name in ("aerial-vertical", "solo8-push")]


# ---- completion ---------------------------------------------------------------------------------------------------


@pytest.mark.long(
    but=(
        "aerial-vertical-nominal-live",
        "aerial-vertical-robust-live",
        "aerial-vertical-robust-sticking-live",
        "aerial-vertical-robust-release-live",
        "aerial-vertical-invariant-live",
        "aerial-vertical-walker-live",
        "aerial-vertical-posture-stiff-live",
        "aerial-vertical-reference-spreading-live",
        "aerial-vertical-impact-aware-live",
        "solo8-push-robust-speed-live",
        "solo8-push-robust-flow-live",
        "solo8-push-posture-live",
        "solo8-push-posture-sticking-live",
        "solo8-push-stiff-live",
        "solo8-push-nominal-live",
        "solo8-push-robust-flow-sticking-live",
        "solo8-push-walker-held",
        "talos-push-nominal-live",
        "talos-push-robust-live",
        "talos-push-robust-held",
        "aerial-lateral-robust-held",
        "aerial-lateral-reference-spreading-live",
    )
)
@pytest.mark.parametrize(("name", "controller", "mode"), ALL)
def test_every_controller_completes(name: str, controller: str, mode: Mode) -> None:
    # The robot must reach a posture before it can hold the posture.
    settle = 1.0 if mode == "held" and name in AERIAL else None
    factory, record = shared_factory(name, settle), lived(name, controller, mode, settle)
    series, setup = record.series, factory.setup
    for key, column in fields_of(series).items():
        assert key == "objective" or np.isfinite(column).all(), key
    assert np.isfinite(series.objective[::10]).all() and np.isnan(series.objective[1::10]).all()
    np.testing.assert_allclose(np.diff(series.t), setup.scenario.control.period, atol=1e-9)
    metrics = measure(setup, record)
    assert judge(setup, record) == ()
    assert metrics.failed_ticks == 0 and metrics.contacts == metrics.contacts_asked == 1
    assert metrics.relaxed_ticks < series.t.size / 4
    assert 0 < metrics.q_total_impact < 3 and 0 < metrics.peak_jump < 30
    # The robot neither falls nor drifts away.
    tilt = 2 * np.arccos(np.clip(np.abs(series.q[:, 6]), 0, 1))
    assert tilt.max() < 0.3 and np.linalg.norm(series.q[:, :3] - setup.q[:3], axis=1).max() < 0.6
    prepares = controller not in ("nominal", "stiff", "invariant", *APPROACH)
    # The transition to an offline posture takes a second.
    assert (series.level.max() > (0.1 if controller.startswith("posture") else 0.7)) == prepares
    assert mode == "live" or series.level[-1] == 0.0
    (prediction,) = predict(setup, factory.objective(), record)
    assert prediction.measured == metrics.peak_jump > 0 and min(prediction.H, prediction.V) > 0


def test_runs_with_both_signs_mirror_each_other_roughly() -> None:
    factory = shared_factory("solo8-push")
    runs = run(factory, "nominal")
    assert [record.sign for record in runs] == [1, -1]
    for record in runs:
        (window,) = record.of("impact")
        part = record.series.slice(window.begin, window.end)
        assert record.sign * (record.series.q[part.stop, 0] - factory.setup.q[0]) > 0.002
        np.testing.assert_array_equal(record.series.force[part], np.tile([record.sign * 6.5, 0, 0], (100, 1)))
        assert not record.series.force[: part.start].any() and not record.series.force[part.stop :].any()


def test_a_run_does_not_depend_on_the_other_sign() -> None:
    factory = shared_factory("solo8-push")
    second = run(factory, "robust", mode="held")[1]
    alone = run(factory, "robust", mode="held", only=-1)[0]
    for key, column in fields_of(alone.series).items():
        np.testing.assert_array_equal(getattr(second.series, key), column, err_msg=key)


# ---- reproducible runs --------------------------------------------------------------------------------------------


@pytest.mark.long(but=("solo8-push",))
@pytest.mark.parametrize("name", ["aerial-vertical", "solo8-push"])
def test_the_seed_determines_a_run(name: str) -> None:
    setup, first = shared_factory(name).setup, lived(name, "robust", "live", None)
    again = driven(controller_factory(near(name)), "robust")
    other = driven(shared_factory(name), "robust", seed=4)
    assert list(map(vars, first.windows)) == list(map(vars, again.windows))
    for key, column in fields_of(first.series).items():
        np.testing.assert_array_equal(column, getattr(again.series, key), err_msg=key)
    size = min(first.series.t.size, other.series.t.size)
    assert not np.array_equal(first.series.v[:size], other.series.v[:size])
    assert measure(setup, first).q_total_impact != measure(setup, other).q_total_impact


def test_a_run_does_not_depend_on_earlier_runs() -> None:
    factory = shared_factory("aerial-vertical")
    first = lived("aerial-vertical", "walker", "live", None)
    driven(factory, "invariant", seed=2)
    np.testing.assert_array_equal(first.series.q, driven(factory, "walker").series.q)


# ---- windows ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", AERIAL)
def test_windows_begin_at_the_first_touch(name: str) -> None:
    setup = shared_factory(name).setup
    task = setup.scenario.task
    assert isinstance(task, RepeatedContacts)
    reference = Reference(task, setup.gap)
    leaves = task.settle + reference.inward + task.dwell
    for controller in ("nominal", "robust", "invariant", "walker"):
        record = lived(name, controller, "live", None)
        impact, dwell, recovery = record.windows
        series = record.series
        assert (impact.kind, dwell.kind, recovery.kind, impact.touched) == ("impact", "dwell", "recovery", True)
        # The recovery lasts one second, or less if the reference ends earlier.
        assert recovery.begin == impact.begin
        assert recovery.end == pytest.approx(min(impact.begin + 1, reference.total))
        first = int(np.argmax(series.touching > 0))
        assert series.t[first] - 2e-3 - 1e-9 <= impact.begin <= series.t[first]
        assert impact.end - impact.begin == pytest.approx(task.window)
        assert (dwell.begin, dwell.end) == (impact.begin, pytest.approx(leaves))
        part = series.slice(impact.begin, impact.end)
        assert part.stop - part.start == 150
        # The contact is never earlier than the reference, but may be late while the robot still reconfigures.
        crossing = task.settle + reference.crossing
        assert crossing - 0.03 < impact.begin < (crossing + 0.03 if controller == "nominal" else leaves)


@pytest.mark.parametrize("name", PUSHES)
def test_the_window_of_a_push_begins_after_rest(name: str) -> None:
    setup = shared_factory(name).setup
    task = setup.scenario.task
    assert isinstance(task, SinglePush)
    record = lived(name, "nominal", "live", None)
    window, recovery = record.windows
    assert recovery.begin == window.begin == record.waited
    assert recovery.end - recovery.begin == pytest.approx(task.duration + task.after)
    assert window.end - window.begin == pytest.approx(task.duration)
    before = record.series.slice(window.begin - task.still, window.begin)
    quiet = np.linalg.norm(record.series.v[before], axis=1).max() < task.quiet
    assert measure(setup, record).rested == record.rested == quiet
    if not record.rested:
        assert record.waited == pytest.approx(task.settle + task.patience, abs=5e-3)


def test_the_window_of_a_missed_contact_begins_at_the_expected_time(monkeypatch: pytest.MonkeyPatch) -> None:
    factory = controller_factory(shortened("aerial-vertical", beyond=0.0, window=0.1))
    # The reference motion ends in front of the surface.
    for key in factory.setup.world.built.gaps:
        monkeypatch.setitem(factory.setup.world.built.gaps, key, 0.14)  # type: ignore[arg-type]
    record = driven(factory, "nominal")
    impact, *_ = record.windows
    assert not impact.touched and not record.series.touching.any()
    metrics = measure(factory.setup, record)
    assert (metrics.contacts, metrics.peak_jump, metrics.peak_force) == (0, 0.0, 0.0)
    assert metrics.contacts_asked == 1
    (event,) = judge(factory.setup, record)
    assert event.status == "lost contact" and "1 of 1 contacts were never made" in event.what
    assert event.time == impact.begin
    assert predict(factory.setup, factory.objective(), record) == ()


def test_tight_limits_relax_the_tasks() -> None:
    # The conflict from the paper: 1 m/s into the surface, with weak motors.
    setup = shortened("aerial-vertical", speed=1.0, acceleration=4.0)
    weak = setup.robot.model.effortLimit.copy()
    weak[6:] /= 3
    setup.robot.model.effortLimit = weak
    factory = controller_factory(replace(setup, world=build_world(setup.robot, setup.scenario, setup.q)))
    record = driven(factory, "nominal")
    metrics = measure(factory.setup, record)
    assert metrics.relaxed_ticks > 20 and metrics.failed_ticks == 0
    assert metrics.saturation_inside + metrics.saturation_outside > 0.01
    for name, column in fields_of(record.series).items():
        assert name == "objective" or np.isfinite(column).all(), name


# ---- invalid input ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ({"controller": "robsut"}, ControllerNotFound, "did you mean robust"),
        ({"controller": "nominal", "mode": "held"}, InputError, "has no mode held"),
        ({"controller": "robust", "mode": "frozen"}, InputError, "there is no mode 'frozen'"),
        ({"controller": "robust", "gain": -1.0}, InputError, "K: is -1.0"),
        ({"controller": "stiff", "gain": float("nan")}, InputError, "K: is nan"),
        ({"controller": "nominal", "only": 3}, InputError, "not a sign of a push"),
    ],
)
def test_wrong_arguments_are_refused(arguments: dict[str, Any], error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words) as caught:
        run(shared_factory("solo8-push"), **arguments)
    assert "\n" not in str(caught.value)


def test_a_tick_must_be_a_multiple_of_the_physics_step() -> None:
    scenario = read_scenario("aerial-vertical")
    odd = set_up(replace(scenario, control=replace(scenario.control, period=1.1e-3)))
    with pytest.raises(InputError, match="not a multiple of the physics"):
        run(controller_factory(odd), "nominal")
