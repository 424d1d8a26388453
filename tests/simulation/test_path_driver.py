"""Controllers that follow a path to the offline optimum."""

from __future__ import annotations

import functools

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.errors import InputError
from impact_posture.path import posture_path as module
from impact_posture.simulation.controllers.controller_factory import ControllerFactory
from impact_posture.simulation.controllers.driver import PathDriver
from impact_posture.simulation.world.sensor_noise import Reading
from impact_posture.tsid.tasks.body_tasks import CenterOfMass
from tests.simulation.factories import controller_factory, driven, near

pytest.importorskip("toppra", reason="toppra is not installed (the extra 'path')")


@functools.cache
def _made(name: str) -> ControllerFactory:
    factory = controller_factory(near(name))
    # One start is enough for tests of the path.
    factory.starts = 1
    return factory


@pytest.mark.long(but=("aerial-vertical",))
@pytest.mark.parametrize("name", ["aerial-vertical", "solo8-push"])
def test_the_robot_follows_the_path_to_its_end(name: str) -> None:
    factory = _made(name)
    driver, model = factory.driver("path"), factory.setup.robot.model
    assert isinstance(driver, PathDriver)
    path = driver.path
    assert path.found
    assert path.duration > 0.1
    q, v, period = factory.setup.q.copy(), np.zeros(model.nv), driver.controller.period
    first = driver.reset(q).u.copy()
    # The path begins at the start posture, projected onto the constraints.
    off = float(np.linalg.norm(pin.difference(model, q, path.q[0])))
    assert driver.level == 0
    driver.brace()
    for k in range(round(path.duration / period) + 100):
        v = v + period * driver.tick(Reading(k * period, q, v, None)).acceleration
        q = np.asarray(pin.integrate(model, q, period * v))
        assert np.abs(pin.difference(model, q, driver.posture.target)[6:]).max() < 0.01 + off
    assert driver.level == 1
    np.testing.assert_allclose(driver.posture.target, path.q[-1], atol=1e-12)
    for task in driver.controller.formulation.weighted:
        if isinstance(task, CenterOfMass):
            center = pin.centerOfMass(model, model.createData(), path.q[-1])
            np.testing.assert_allclose(task.target, center, atol=1e-12)
    np.testing.assert_array_equal(driver.reset(factory.setup.q).u, first)
    assert driver.level == 0


def test_a_run_follows_the_path() -> None:
    level = driven(_made("solo8-push"), "path").series.level
    assert level[0] == 0
    assert 0 < level[-1] <= 1
    assert np.all(np.diff(level) >= 0)


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "find_spec", lambda name: None)
    with pytest.raises(InputError, match="toppra"):
        controller_factory(near("solo8-push")).driver("path")
