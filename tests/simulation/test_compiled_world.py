"""Ticks of a world in C, beside those of the same controller in Python's world."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from impact_posture.errors import InputError
from impact_posture.simulation import compiled_world, run
from impact_posture.simulation.controllers.controller_factory import ControllerFactory
from impact_posture.simulation.metrics import measure
from impact_posture.simulation.outcome import judge
from impact_posture.simulation.scenario_file import read_scenario
from impact_posture.simulation.setup import set_up
from impact_posture.simulation.world.actuator_command import ActuatorCommand
from tests.simulation.factories import controller_factory, driven, factory, fields_of, near, needs_mujoco, shortened
from tests.support.daqp import sources_or_skip

# Largest difference of any column, relative to its largest number.  A wall amplifies rounding once an encoder counts
# one step more, so only the run until the impact is compared there.
BAND = 1e-7


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    needs_mujoco()
    sources_or_skip()
    monkeypatch.setenv("CFLAGS", "-O0")


@pytest.fixture
def in_python(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A run under the same controller in C, in Python's world."""

    def call(*arguments: Any, **options: Any) -> Any:
        with monkeypatch.context() as patch:
            patch.setattr(run, "compiled_world", lambda *_: None)
            return driven(*arguments, **options)

    yield call


def in_c(made: ControllerFactory) -> ControllerFactory:
    return replace(made, compile="always", warnings=[], _fault="")


def beside(name: str, ours: Any, theirs: Any, ticks: int | None = None) -> None:
    for column, wanted in fields_of(ours.series).items():
        wanted, found = wanted[:ticks].astype(float), fields_of(theirs.series)[column][:ticks].astype(float)
        room = BAND * np.abs(np.nan_to_num(wanted)).max(initial=1.0)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=room, err_msg=f"{name}: {column}")


@pytest.mark.parametrize(("controller", "mode"), [("nominal", "live"), ("robust", "held"), ("robust-flow", "live")])
def test_a_pushed_robot_moves_as_in_python(controller: str, mode: Any, in_python: Any) -> None:
    made = in_c(factory("solo8-push"))
    ours, theirs = (how(made, controller, mode=mode) for how in (in_python, driven))
    beside("solo8-push", ours, theirs)
    assert (theirs.waited, theirs.rested) == (ours.waited, ours.rested) and judge(made.setup, theirs) == judge(
        made.setup, ours
    )


def test_references_sensors_and_propellers_are_those_of_python(in_python: Any) -> None:
    # With noise of every sensor, vibration, encoders and a force that is felt.
    made = in_c(factory("aerial-vertical"))
    ours, theirs = (how(made, "posture") for how in (in_python, driven))
    touch = int(np.flatnonzero(ours.series.touching)[0])
    assert touch > 300 and ours.series.reference[touch] > 0.01 and ours.series.level[touch] > 0.1
    beside("aerial-vertical", ours, theirs, touch + 2)
    assert theirs.windows[0].begin == pytest.approx(ours.windows[0].begin, abs=1e-9)
    totals = [measure(made.setup, one).q_total_impact for one in (ours, theirs)]
    assert totals[1] == pytest.approx(totals[0], rel=2e-2)


@pytest.mark.parametrize("name", ["solo8-throw", "panda-tap"])
def test_balls_and_robots_without_a_floating_base_too(name: str, in_python: Any) -> None:
    scenario = read_scenario(name)
    if scenario.throw is not None:
        short: dict[str, Any] = {"throw": replace(scenario.throw, settle=0.1, patience=0.2, after=0.1)}
    else:
        assert scenario.contacts is not None
        short = {"contacts": replace(scenario.contacts, count=1, settle=0.2, dwell=0.1, pause=0.05)}
    made = in_c(controller_factory(set_up(replace(scenario, **short))))
    ours, theirs = (how(made, "nominal") for how in (in_python, driven))
    touch = int(np.flatnonzero(ours.series.peak)[0])
    beside(name, ours, theirs, touch + 2)
    assert [window.touched for window in theirs.windows] == [window.touched for window in ours.windows]


def test_a_state_that_runs_away_ends_the_run_in_c() -> None:
    made = in_c(controller_factory(shortened("solo8-push")))
    world, push = made.setup.world, made.setup.world.push

    def hard(one: Any) -> None:
        push(replace(one, force=(1e12, 0.0, 0.0)))

    world.push = hard  # type: ignore[method-assign]
    found = driven(made, "nominal")
    assert found.away is not None and found.waited < found.away < found.waited + 0.1
    assert found.series.t[-1] < found.away
    assert ("control lost", found.away) in [(e.status, e.time) for e in judge(made.setup, found)]


@pytest.mark.parametrize("name", ["solo8-push", "aerial-vertical"])
@pytest.mark.parametrize("wrong", [np.nan, np.inf, 1e300, 1e7])
def test_a_command_is_refused_or_cut_as_in_python(name: str, wrong: float) -> None:
    made = in_c(factory(name))
    driver, world = made.driver("nominal"), made.setup.world
    answer = driver.reset(made.setup.q)
    assert driver.compiled is not None
    out, rotors = driver.compiled.library._out, answer.rotor_speed.size
    for where in ("u", "rotor_speed") if rotors else ("u",):
        world.reset(made.setup.q, rotor_speed=answer.rotor_speed)
        loop = compiled_world.compiled_world(world, driver.compiled, 1)
        assert loop is not None

        @ctypes.CFUNCTYPE(ctypes.c_int, *6 * (ctypes.c_void_p,))
        def tick(*_: object, where: str = where) -> int:
            out["u"][:], out["rotor_speed"][:rotors] = answer.u, answer.rotor_speed
            out[where][-1] = wrong
            return 0

        loop._struct.tick = ctypes.cast(tick, ctypes.c_void_p)
        tick(*6 * [None])
        command = ActuatorCommand(out["u"][rotors:], out["rotor_speed"][:rotors])
        if np.isfinite(wrong):
            world.limits.within(command)
            assert loop.take(1, lambda t: None).level.size == 1
            continue
        with pytest.raises(InputError, match="command: is not finite"):
            world.limits.within(command)
        with pytest.raises(InputError, match="command: is not finite"):
            loop.take(1, lambda t: None)


def test_python_takes_the_ticks_where_c_cannot(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    made = in_c(factory("solo8-push"))
    driver, world = made.driver("nominal"), made.setup.world
    world.reset(made.setup.q)
    assert compiled_world.compiled_world(world, driver.compiled, 1) is not None
    assert compiled_world.compiled_world(world, None, 1) is None
    scenario = made.setup.scenario
    late = replace(scenario, sensors=replace(scenario.sensors, delay=0.002))
    slow = near("solo8-push")
    slow = replace(slow, world=type(slow.world)(slow.robot, late, slow.world.built))
    slow.world.reset(slow.q)
    assert compiled_world.compiled_world(slow.world, driver.compiled, 1) is None
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(tmp_path))
    monkeypatch.setenv("CC", "false")
    assert compiled_world.compiled_world(world, driver.compiled, 1) is None
