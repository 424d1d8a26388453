"""Simulations with the world in C, compared with simulations of the same controller with the world in Python."""

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
from tests.simulation.factories import controller_factory, driven, fields_of, near, shared_factory, shortened
from tests.support.daqp import sources_or_skip

# Largest tolerated difference of a column, relative to its largest number.  In the scenario with a wall, the
# comparison ends at the impact, because the contact amplifies rounding as soon as an encoder reading differs.
BAND = 1e-7


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    sources_or_skip()
    monkeypatch.setenv("CFLAGS", "-O0")


@pytest.fixture
def in_python(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Return a function that simulates the controller in C with the world in Python."""

    def call(*arguments: Any, **options: Any) -> Any:
        with monkeypatch.context() as patch:
            patch.setattr(run, "compiled_world", lambda *_: None)
            return driven(*arguments, **options)

    yield call


def in_c(factory: ControllerFactory) -> ControllerFactory:
    return replace(factory, compile="always", warnings=[], _fault="")


def assert_same(name: str, ours: Any, theirs: Any, ticks: int | None = None) -> None:
    for column, wanted in fields_of(ours.series).items():
        wanted, actual = wanted[:ticks].astype(float), fields_of(theirs.series)[column][:ticks].astype(float)
        room = BAND * np.abs(np.nan_to_num(wanted)).max(initial=1.0)
        np.testing.assert_allclose(actual, wanted, rtol=0, atol=room, err_msg=f"{name}: {column}")


@pytest.mark.long(but=("robust-held",))
@pytest.mark.parametrize(("controller", "mode"), [("nominal", "live"), ("robust", "held"), ("robust-flow", "live")])
def test_a_pushed_robot_moves_as_in_python(controller: str, mode: Any, in_python: Any) -> None:
    factory = in_c(shared_factory("solo8-push"))
    ours, theirs = (how(factory, controller, mode=mode) for how in (in_python, driven))
    assert_same("solo8-push", ours, theirs)
    assert (theirs.waited, theirs.rested) == (ours.waited, ours.rested) and judge(factory.setup, theirs) == judge(
        factory.setup, ours
    )


def test_references_sensors_and_propellers_agree_with_python(in_python: Any) -> None:
    # This scenario uses noise of all sensors, vibration, encoders and a force sensor.
    factory = in_c(shared_factory("aerial-vertical"))
    ours, theirs = (how(factory, "posture") for how in (in_python, driven))
    touch = int(np.flatnonzero(ours.series.touching)[0])
    assert touch > 300 and ours.series.reference[touch] > 0.01 and ours.series.level[touch] > 0.1
    assert_same("aerial-vertical", ours, theirs, touch + 2)
    assert theirs.windows[0].begin == pytest.approx(ours.windows[0].begin, abs=1e-9)
    totals = [measure(factory.setup, record).q_total_impact for record in (ours, theirs)]
    assert totals[1] == pytest.approx(totals[0], rel=2e-2)


@pytest.mark.parametrize("name", ["solo8-throw", "panda-tap"])
def test_balls_and_fixed_bases_agree_with_python(name: str, in_python: Any) -> None:
    scenario = read_scenario(name)
    if scenario.throw is not None:
        short: dict[str, Any] = {"throw": replace(scenario.throw, settle=0.1, patience=0.2, after=0.1)}
    else:
        assert scenario.contacts is not None
        short = {"contacts": replace(scenario.contacts, count=1, settle=0.2, dwell=0.1, pause=0.05)}
    factory = in_c(controller_factory(set_up(replace(scenario, **short))))
    ours, theirs = (how(factory, "nominal") for how in (in_python, driven))
    touch = int(np.flatnonzero(ours.series.peak)[0])
    assert_same(name, ours, theirs, touch + 2)
    assert [window.touched for window in theirs.windows] == [window.touched for window in ours.windows]


def test_a_diverged_state_ends_the_run_in_c() -> None:
    factory = in_c(controller_factory(shortened("solo8-push")))
    world, push = factory.setup.world, factory.setup.world.push

    def hard(request: Any) -> None:
        push(replace(request, force=(1e12, 0.0, 0.0)))

    world.push = hard  # type: ignore[method-assign]
    record = driven(factory, "nominal")
    assert record.away is not None and record.waited < record.away < record.waited + 0.1
    assert record.series.t[-1] < record.away
    assert ("control lost", record.away) in [(e.status, e.time) for e in judge(factory.setup, record)]


@pytest.mark.parametrize("name", ["solo8-push", "aerial-vertical"])
@pytest.mark.parametrize("wrong", [np.nan, 1e300])
def test_a_command_is_refused_or_clipped_as_in_python(name: str, wrong: float) -> None:
    factory = in_c(shared_factory(name))
    driver, world = factory.driver("nominal"), factory.setup.world
    answer = driver.reset(factory.setup.q)
    assert driver.compiled is not None
    out, rotors = driver.compiled.library._out, answer.rotor_speed.size
    for where in ("u", "rotor_speed") if rotors else ("u",):
        world.reset(factory.setup.q, rotor_speed=answer.rotor_speed)
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


def test_python_runs_the_worlds_that_c_cannot_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    factory = in_c(shared_factory("solo8-push"))
    driver, world = factory.driver("nominal"), factory.setup.world
    world.reset(factory.setup.q)
    assert compiled_world.compiled_world(world, driver.compiled, 1) is not None
    assert compiled_world.compiled_world(world, None, 1) is None
    scenario = factory.setup.scenario
    late = replace(scenario, sensors=replace(scenario.sensors, delay=0.002))
    slow = near("solo8-push")
    slow = replace(slow, world=type(slow.world)(slow.robot, late, slow.world.built))
    slow.world.reset(slow.q)
    assert compiled_world.compiled_world(slow.world, driver.compiled, 1) is None
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(tmp_path))
    monkeypatch.setenv("CC", "false")
    assert compiled_world.compiled_world(world, driver.compiled, 1) is None
