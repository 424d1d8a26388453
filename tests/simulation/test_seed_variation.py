"""Seeds that change the start, the speed or force, and the friction of a scenario."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import InputError
from impact_posture.experiment.jobs import controller_factory
from impact_posture.impact.impact_contact import point_on
from impact_posture.simulation.scenario_file import Spread, read_scenario
from impact_posture.simulation.seed_variation import set_up_with

VARIED = ("aerial-vertical", "aerial-lateral", "solo8-push", "talos-push")


@pytest.mark.parametrize("name", VARIED)
def test_a_seed_changes_the_stated_values_within_their_limits(name: str) -> None:
    scenario = read_scenario(name)
    spread, stated, first = scenario.spread, set_up_with(scenario, 0), set_up_with(scenario, 1)
    assert stated.scenario == scenario
    np.testing.assert_array_equal(first.q, set_up_with(scenario, 1).q)
    assert np.abs(first.q - set_up_with(scenario, 2).q).max() > 1e-4
    change = np.abs(pin.difference(stated.robot.model, stated.q, first.q))
    assert 1e-4 < change.max() <= (1.001 if scenario.contacts else 3) * spread.joints
    sizes = [
        np.linalg.norm(s.scenario.push.force) if s.scenario.push else s.scenario.contacts.speed  # type: ignore[union-attr]
        for s in (stated, first)
    ]
    frictions = [s.scenario.surfaces[0].friction for s in (stated, first)]
    for (old, new), limit in ((sizes, spread.speed), (frictions, spread.friction)):
        assert 1e-3 < abs(new / old - 1) <= limit


@pytest.mark.parametrize("name", ("solo8-push", "talos-push"))
def test_standing_feet_keep_their_places(name: str) -> None:
    scenario = read_scenario(name)
    places = []
    for seed in (0, 1, 2):
        setup = set_up_with(scenario, seed)
        numeric = Numeric(setup.robot.model).at(setup.q)
        feet = [point_on(setup.robot, s.frame, s.offset) for s in setup.robot.spec.supports]
        places.append([numeric.placement(foot).translation for foot in feet])
    np.testing.assert_allclose(places[1], places[0], atol=1e-7)
    np.testing.assert_allclose(places[2], places[0], atol=1e-7)


def test_a_flying_base_stays_and_every_controller_gets_the_same_start() -> None:
    stated, first = (controller_factory("aerial-vertical", False, seed).setup for seed in (0, 1))
    np.testing.assert_allclose(first.q[:7], stated.q[:7], atol=1e-12)
    np.testing.assert_array_equal(first.q, controller_factory("aerial-vertical", True, 1).setup.q)


def test_without_spread_a_seed_changes_only_the_noise() -> None:
    scenario = replace(read_scenario("aerial-vertical"), spread=Spread())
    np.testing.assert_array_equal(set_up_with(scenario, 3).q, set_up_with(scenario, 0).q)
    assert set_up_with(scenario, 3).scenario == scenario


def test_controllers_do_not_know_where_the_surface_is() -> None:
    scenario = replace(read_scenario("panda-tap"), spread=Spread(normal=5, gap=0.005))
    stated, first, second = (set_up_with(scenario, seed) for seed in (0, 1, 2))
    assert first.scenario == scenario and first.gap == stated.gap == pytest.approx(0.1)
    tilts, shifts = [], []
    for setup in (first, second):
        normal, point = setup.world.built.normals["table"], setup.world.built.points["table"]
        tilts.append(np.degrees(np.arccos(normal @ scenario.normal)))
        shifts.append(scenario.normal @ (stated.world.built.points["table"] - point))
    assert 0.01 < abs(tilts[0] - tilts[1]) and max(tilts) < 5
    assert 1e-5 < abs(shifts[0] - shifts[1]) and np.abs(shifts).max() < 0.005


def test_the_surface_of_a_push_cannot_vary() -> None:
    with pytest.raises(InputError, match=r"no \[contacts\]"):
        replace(read_scenario("solo8-push"), spread=Spread(gap=0.005))
