"""C controllers in simulations: comparison with Python controllers, and conditions under which they are built."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from impact_posture.errors import CompilerError, InputError
from impact_posture.experiment.jobs import Job, execute, worth_compiling
from impact_posture.simulation.controllers.compiled_tick import CompiledTick
from impact_posture.simulation.controllers.controller_factory import ControllerFactory
from impact_posture.simulation.metrics import measure
from impact_posture.simulation.scenario_file import read_scenario
from impact_posture.simulation.scenario_objective import interpreted
from impact_posture.simulation.setup import set_up
from impact_posture.simulation.world.sensor_noise import Reading
from impact_posture.system.libraries import cache_path
from tests.simulation.factories import driven, shared_factory

pytestmark = pytest.mark.usefixtures("quick_builds")

# Tolerated relative differences between Python and C, larger for a wall, because its contact amplifies rounding.
BANDS = {"solo8-push": 1e-6, "aerial-vertical": 2e-2}


def in_c(name: str, **options: Any) -> ControllerFactory:
    return replace(shared_factory(name), **{"compile": "always", "warnings": [], "_fault": "", **options})


@pytest.mark.long(but=("solo8-push-robust-held",))
@pytest.mark.parametrize(
    ("name", "controller", "mode"), [("solo8-push", "robust", "held"), ("aerial-vertical", "nominal", "live")]
)
def test_a_run_in_c_agrees_with_python(name: str, controller: str, mode: Any) -> None:
    factory = in_c(name)
    assert isinstance(factory.driver(controller, mode).compiled, CompiledTick)
    ours, theirs = driven(shared_factory(name), controller, mode=mode), driven(factory, controller, mode=mode)
    wanted, compiled = (measure(factory.setup, record) for record in (ours, theirs))
    assert compiled.q_total_impact == pytest.approx(wanted.q_total_impact, rel=BANDS[name])
    assert compiled.peak_jump == pytest.approx(wanted.peak_jump, rel=BANDS[name])
    assert (compiled.contacts, compiled.failed_ticks) == (wanted.contacts, wanted.failed_ticks)
    np.testing.assert_array_equal(ours.series.level, theirs.series.level)
    # Before the impact, the runs differ only by rounding.
    calm = slice(0, 300)
    np.testing.assert_allclose(theirs.series.q[calm], ours.series.q[calm], rtol=0, atol=1e-9)
    np.testing.assert_allclose(theirs.series.torque[calm], ours.series.torque[calm], rtol=0, atol=1e-7)


def test_robots_that_differ_in_armature_and_mounting_share_the_library() -> None:
    scenario = read_scenario("aerial-vertical")
    x, y, z = scenario.mounting["shoulder_roll"]
    other = replace(
        scenario,
        armature={"shoulder_pitch": 0.01, "elbow_pitch": 0.02},
        mounting={"shoulder_roll": (x + 0.01, y, z + 0.02)},
    )
    factories = [in_c("aerial-vertical"), ControllerFactory(set_up(other), compile="always", gradient_of=interpreted)]
    folders: list[set[Path]] = []
    values: list[float] = []
    for each in factories:
        driver = each.driver("robust")
        assert driver.compiled is not None
        folders.append(set((cache_path() / "controllers").iterdir()))
        q, v = each.setup.q, np.full(each.setup.robot.nv, 0.01)
        driver.reset(q)
        driver.brace()
        driver.posture.brace()
        for t in 0.001 * np.arange(6):
            wanted, command = driver.controller.tick(t, q, v), driver.compiled.tick(Reading(t, q, v, None))
            np.testing.assert_allclose(command.u, wanted.u, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(command.acceleration, wanted.acceleration, rtol=1e-9, atol=1e-9)
        values.append(driver.compiled.library.report().objective)
        assert values[-1] == pytest.approx(driver.posture.value, rel=1e-12)
    assert values[0] != pytest.approx(values[1], rel=0.1)
    assert folders[0] == folders[1]


def test_auto_compiles_from_two_runs_on() -> None:
    assert [worth_compiling("auto", runs) for runs in (1, 2, 3)] == ["never", "auto", "auto"]
    assert (worth_compiling("always", 1), worth_compiling("never", 9)) == ("always", "never")
    assert in_c("solo8-push", compile="never").driver("robust").compiled is None
    factory = in_c("solo8-push", compile="auto")
    assert factory.driver("robust").compiled is not None and factory.in_c
    # `walker` reads the internal state of its controller, so `walker` runs in Python.
    assert factory.driver("walker").compiled is None and not factory.in_c


def test_the_document_names_the_language() -> None:
    _, document = execute(Job("solo8-push", "robust", sign=1, compile="always"), in_c("solo8-push"))
    assert document["language"] == "C"


def test_controllers_that_cannot_run_in_c(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="'walker' has no C code"):
        in_c("solo8-push").driver("walker")
    with pytest.raises(InputError, match="no mode 'sometimes'"):
        in_c("solo8-push", compile="sometimes").driver("nominal")
    monkeypatch.setenv("CC", "false")
    with pytest.raises(CompilerError):
        in_c("solo8-push").driver("nominal")
    factory = in_c("solo8-push", compile="auto")
    assert factory.driver("nominal").compiled is None
    (warning,) = factory.warnings
    assert warning.startswith("the controller runs in Python")
    # The second controller does not repeat the failed build.
    assert factory.driver("nominal").compiled is None
    assert factory.warnings == []
