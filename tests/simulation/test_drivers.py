"""Drivers of the controllers before an impact, while they hold a posture, and after a reset."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.errors import SpecError
from impact_posture.path.row_interpolation import RowInterpolation
from impact_posture.simulation.controller_gains import EndEffectorGains, Gains
from impact_posture.simulation.controllers.contact_reference import ReferencePoint
from impact_posture.simulation.controllers.controller_factory import CONTROLLERS, ControllerFactory, Mode
from impact_posture.simulation.controllers.driver import MOVE, Driver, PostureDriver
from impact_posture.simulation.controllers.task_formulations import nominal_posture
from impact_posture.simulation.world.actuator_command import ActuatorCommand
from impact_posture.tsid.tasks.body_tasks import BaseOrientation, CenterOfMass
from impact_posture.tsid.tasks.frame_tasks import FramePose
from tests.simulation.factories import AERIAL, PUSHES, SHIPPED, shared_factory


class Stage:
    """Driver with its simulated world, but without reference and recorder."""

    def __init__(self, factory: ControllerFactory, driver: Driver, seed: int = 0) -> None:
        setup = factory.setup
        self.factory, self.driver, self.world = factory, driver, setup.world
        command = driver.reset(setup.q)
        self.world.reset(setup.q, seed=seed, rotor_speed=command.rotor_speed)
        self.count = round(setup.scenario.control.period / self.world.timestep)

    def go(self, seconds: float) -> Any:
        for _ in range(round(seconds / (self.count * self.world.timestep))):
            command = self.driver.tick(self.world.read())
            self.world.step(ActuatorCommand(command.torque, command.rotor_speed), self.count)
        return self.world.truth()

    def moved(self, q: Any) -> float:
        """Return the largest deviation of a joint from its start."""
        return float(np.abs(pin.difference(self.factory.setup.robot.model, self.factory.setup.q, q)[6:]).max())

    def H(self) -> float:
        return self.factory.objective().value(self.world.truth().q)


def stage(name: str, controller: str, mode: Mode = "live") -> Stage:
    factory = shared_factory(name)
    return Stage(factory, factory.driver(controller, mode))


# ---- before the impact --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SHIPPED)
def test_nominal_holds_its_posture_after_brace(name: str) -> None:
    play = stage(name, "nominal")
    play.go(0.1)
    play.driver.brace()
    truth = play.go(0.4)
    assert play.moved(truth.q) < 0.02 and play.driver.level == 0
    assert np.linalg.norm(truth.v) < 0.2


@pytest.mark.long(but=("talos-push", "aerial-vertical"))
@pytest.mark.parametrize("name", SHIPPED)
def test_robust_lowers_the_metric_after_brace_only(name: str) -> None:
    off = stage(name, "robust")
    still = off.go(0.5).q
    assert off.driver.level == 0 and off.moved(still) < 0.02
    idle = off.H()
    on = stage(name, "robust")
    on.go(0.05)
    on.driver.brace()
    on.go(0.45)
    assert on.driver.level == 1
    # How far the joints move in the first half second differs between robots.
    assert on.H() < idle * (1 - 2e-3)


def test_robust_equals_nominal_before_brace() -> None:
    for name in ("aerial-vertical", "solo8-push"):
        a, b = stage(name, "nominal").go(0.1), stage(name, "robust").go(0.1)
        np.testing.assert_array_equal(a.q, b.q)
        np.testing.assert_array_equal(a.torques, b.torques)


@pytest.mark.parametrize("controller", ["robust-speed", "robust-sticking"])
def test_other_gradients_lower_their_metrics(controller: str) -> None:
    kind: Any = controller.removeprefix("robust-")
    play = stage("aerial-vertical", controller)
    objective = play.factory.objective(kind)
    before = objective.value(play.factory.setup.q)
    play.go(0.1)
    play.driver.brace()
    assert objective.value(play.go(1.0).q) < 0.9 * before


def test_all_controllers_share_gains_tasks_and_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("aerial-lateral", "talos-push"):
        factory = shared_factory(name)
        # Formulations do not depend on the offline optimum or the path, so both are replaced.
        monkeypatch.setitem(vars(factory), "_optimum", lambda name, q=factory.setup.q: SimpleNamespace(q=q))
        rest = np.zeros((2, factory.setup.robot.nv))
        still = RowInterpolation(
            factory.setup.robot.model, np.array([0.0, 1.0]), np.tile(factory.setup.q, (2, 1)), rest, rest
        )
        monkeypatch.setitem(vars(factory), "path", SimpleNamespace(strike=None, duration=0.0, at=still.at))
        strike = SimpleNamespace(follow_through=None, rest_s=0.0, run_up_s=0.0, contact_s=0.0)
        struck = SimpleNamespace(strike=strike, duration=0.0, at=still.at, **vars(still))
        monkeypatch.setitem(vars(factory), "strike", struck)
        nominal = factory.driver("nominal").controller.formulation
        for controller in CONTROLLERS:
            formulation = factory.driver(controller).controller.formulation
            assert [t.name for t in formulation.tasks[:-1]] == [t.name for t in nominal.tasks[:-1]]
            for task, other in zip(formulation.tasks, nominal.tasks, strict=True):
                np.testing.assert_array_equal(task.kp, other.kp)
                np.testing.assert_array_equal(task.weight, other.weight)
                # The controllers named `stiff` have other damping, because their stiffness differs.
                if "stiff" not in controller or task is not formulation.posture:
                    np.testing.assert_array_equal(task.kd, other.kd)
            assert [c.friction for c in formulation.contacts] == [c.friction for c in nominal.contacts]


# ---- held ---------------------------------------------------------------------------------------------------------


@pytest.mark.long(but=("talos-push-robust", "aerial-vertical-walker", "solo8-push-robust"))
@pytest.mark.parametrize("controller", ["robust", "walker"])
@pytest.mark.parametrize("name", ["aerial-vertical", *PUSHES])
def test_held_freezes_posture_center_of_mass_and_base(name: str, controller: str) -> None:
    play = stage(name, controller, "held")
    play.go(0.1)
    play.driver.brace()
    play.go(0.4)
    driver = play.driver
    driver.hold()
    reached = play.world.truth().q
    state = driver.controller.state
    for task in driver.controller.formulation.weighted:
        if isinstance(task, CenterOfMass):
            np.testing.assert_array_equal(task.target, state.center_of_mass()[0])
        if isinstance(task, BaseOrientation):
            np.testing.assert_array_equal(task.target, state.base_rotation)
    play.go(0.4)
    assert driver.level == 0
    target = driver.posture.target
    moved = pin.difference(play.factory.setup.robot.model, reached, target)[6:]
    # The driver holds the posture that was measured one tick earlier.
    assert np.abs(moved).max() < 0.01
    wanted = [np.array(t.target) for t in driver.controller.formulation.weighted]  # type: ignore[attr-defined]
    last = play.go(1.8 if name in AERIAL else 0.8).q
    np.testing.assert_array_equal(driver.posture.target, target)
    for task, kept in zip(driver.controller.formulation.weighted, wanted, strict=True):
        np.testing.assert_array_equal(task.target, kept)  # type: ignore[attr-defined]
    assert np.abs(pin.difference(play.factory.setup.robot.model, last, target)[6:]).max() < 0.04


@pytest.mark.parametrize("controller", ["robust", "walker", "posture"])
def test_reset_clears_an_earlier_run(controller: str) -> None:
    factory = shared_factory("solo8-push")
    goal = np.array(pin.integrate(factory.setup.robot.model, factory.setup.q, 0.05 * np.ones(14)))
    driver: Driver
    if controller == "posture":
        driver = PostureDriver(factory.setup, nominal_posture(factory.setup), goal)
    else:
        driver = factory.driver(controller, "held")
    first = Stage(factory, driver).go(0.05)
    used = Stage(factory, driver)
    used.go(0.05)
    driver.brace()
    used.go(0.3)
    driver.hold()
    used.go(0.05)
    again = Stage(factory, driver).go(0.05)
    np.testing.assert_array_equal(first.q, again.q)
    np.testing.assert_array_equal(first.torques, again.torques)
    assert driver.level == 0


def test_reset_clears_the_reference_of_the_end_effector() -> None:
    factory = shared_factory("aerial-vertical")
    driver = factory.driver("nominal")
    fresh = driver.reset(factory.setup.q)
    factory.setup.world.reset(factory.setup.q)
    driver.tick(factory.setup.world.read(), ReferencePoint(0.05, 0.5, 1.0))
    again = driver.reset(factory.setup.q)
    np.testing.assert_array_equal(fresh.u, again.u)


def test_the_end_effector_follows_its_reference_into_the_surface() -> None:
    factory = shared_factory("aerial-lateral")
    driver = factory.driver("nominal")
    driver.reset(factory.setup.q)
    factory.setup.world.reset(factory.setup.q)
    (hand,) = [t for t in driver.controller.formulation.tasks if isinstance(t, FramePose)]
    assert hand.target is not None
    home = hand.target.translation.copy()
    driver.tick(factory.setup.world.read(), ReferencePoint(0.1, 0.3, 0.8))
    # The robot moves against the normal of the wall, which is −x.
    np.testing.assert_allclose(hand.target.translation - home, [0.1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(hand.target_velocity, [0.3, 0, 0, 0, 0, 0])
    np.testing.assert_allclose(hand.target_acceleration, [0.8, 0, 0, 0, 0, 0])


# ---- the offline posture ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["aerial-lateral", "solo8-push"])
def test_the_posture_driver_reaches_its_goal(name: str) -> None:
    factory = shared_factory(name)
    robot = factory.setup.robot
    goal = factory.setup.q.copy()
    if name in AERIAL:
        goal[-1] += 0.1
    else:
        # All legs bend by 10 % more: the base moves down and the feet do not move.
        goal[7:] *= 1.1
        data = robot.model.createData()
        pin.framesForwardKinematics(robot.model, data, factory.setup.q)
        foot = robot.frame_id("FL_FOOT")
        before = data.oMf[foot].translation.copy()
        pin.framesForwardKinematics(robot.model, data, goal)
        goal[:3] += before - data.oMf[foot].translation
    play = Stage(factory, PostureDriver(factory.setup, nominal_posture(factory.setup), goal))
    play.go(0.1)
    assert play.driver.level == 0
    play.driver.brace()
    play.go(MOVE / 2)
    assert 0.4 < play.driver.level < 0.6
    reached = play.go(MOVE / 2 + 0.8).q
    assert play.driver.level == 1
    np.testing.assert_array_equal(play.driver.posture.target, goal)
    if name in PUSHES:
        assert np.abs(pin.difference(robot.model, reached, goal)[6:]).max() < 0.02
        (center,) = [t for t in play.driver.controller.formulation.weighted if isinstance(t, CenterOfMass)]
        data = robot.model.createData()
        np.testing.assert_allclose(center.target, pin.centerOfMass(robot.model, data, goal), atol=1e-12)


# ---- invalid input ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("aerial-vertical", {"end_effector": None}, r"no gains for the end effector.*\[control.end_effector\]"),
        ("aerial-vertical", {"center_of_mass": Gains(10)}, r"has \[control.center_of_mass\], but no"),
        ("aerial-vertical", {"base": Gains(10)}, r"has \[control.base\], but no \[control.footing\]"),
        ("solo8-push", {"tilt": Gains(10)}, r"has \[control.tilt\], but feet"),
        ("solo8-push", {"end_effector": EndEffectorGains(10)}, r"has \[control.end_effector\], but a push"),
        ("solo8-push", {"footing": None}, r"but no \[control.footing\]"),
    ],
)
def test_gains_without_a_task_are_refused(name: str, change: dict[str, Any], words: str) -> None:
    setup = shared_factory(name).setup
    control = replace(setup.scenario.control, **change)
    with pytest.raises(SpecError, match=words) as caught:
        ControllerFactory(replace(setup, scenario=replace(setup.scenario, control=control))).driver("nominal")
    assert "\n" not in caught.value.line and name in caught.value.line
