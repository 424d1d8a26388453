"""Short scenarios, controller factories and runs that tests share, and synthetic time series."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from impact_posture.simulation.controllers.controller_factory import ControllerFactory, Mode
from impact_posture.simulation.recorder import feet_of
from impact_posture.simulation.run import Run, run
from impact_posture.simulation.scenario_file import read_scenario
from impact_posture.simulation.scenario_objective import interpreted
from impact_posture.simulation.series import Series
from impact_posture.simulation.setup import Setup, set_up

AERIAL = ("aerial-vertical", "aerial-lateral")
PUSHES = ("solo8-push", "talos-push")
SHIPPED = (*AERIAL, *PUSHES)
# Scenario of a contact with a table; ``more`` may state the start posture.
HIT = """
name = "mine"
robot = "{robot}"
{more}

[physics]
timestep = 0.001

[[surfaces]]
name = "table"
normal = [0, 0, 1]
gap = 0.04

[[shapes]]
frame = "{frame}"
size = [0.01]

[contacts]
frame = "{frame}"
surface = "table"
speed = 0.2
count = 1
settle = 0.2
dwell = 0.1
pause = 0.05

[control]
period = 0.002

[control.end_effector]
kp = 100

[control.posture]
kp = 10

[control.robust]
gain = 20
"""


def needs_mujoco() -> None:
    pytest.importorskip("mujoco", reason="mujoco is not installed (the extra 'sim')")


def shortened(source: str | Path, slower: int = 1, **changes: Any) -> Setup:
    """Set up a scenario with a single contact or a short wait, slower rates and changed task settings."""
    scenario = read_scenario(source)
    if scenario.contacts:
        short: dict[str, Any] = {"count": 1, "settle": 0.3, "dwell": 0.2, "pause": 0.05}
    else:
        short = {"settle": 0.1, "patience": 0.3, "duration": 0.2, "after": 0.05}
    key = "contacts" if scenario.contacts else "push"
    physics = replace(scenario.physics, timestep=slower * scenario.physics.timestep)
    control = replace(scenario.control, period=slower * scenario.control.period)
    task = replace(scenario.task, **{**short, **changes})
    return set_up(replace(scenario, physics=physics, control=control, **{key: task}))


def controller_factory(setup: Setup, free: bool = False) -> ControllerFactory:
    """Return a factory with interpreted gradients, whose offline optimum uses few starts."""
    return ControllerFactory(setup, free=free, gradient_of=interpreted, starts=2)


def near(name: str, slower: int = 2, **changes: Any) -> Setup:
    """Set up a short variant of a shipped scenario with slower rates and surfaces that are 5 cm nearer."""
    setup = shortened(name, slower, **changes)
    if name in PUSHES:
        return setup
    scenario = setup.scenario
    surfaces = tuple(replace(s, gap=s.gap - 0.05) for s in scenario.surfaces)
    return set_up(replace(scenario, surfaces=surfaces))


@functools.cache
def shared_setup(name: str) -> Setup:
    """Return the setup of a scenario from :func:`near`, with the rates of the scenario."""
    return near(name, slower=1)


@functools.cache
def shared_factory(name: str, settle: float | None = None) -> ControllerFactory:
    """Return the factory of a scenario from :func:`near`, shared by all tests of a process."""
    return controller_factory(near(name) if settle is None else near(name, settle=settle))


def driven(factory: ControllerFactory, controller: str, *, mode: Mode = "live", seed: int = 0) -> Run:
    """Run contacts (or a push with sign 1) and optimize offline postures from one start."""
    factory.starts = 1
    return run(factory, controller, mode=mode, seed=seed, only=1)[0]


@functools.cache
def lived(name: str, controller: str, mode: Mode, settle: float | None) -> Run:
    """Return a cached run of :func:`shared_factory`; without default arguments, equal calls share a cache entry."""
    return driven(shared_factory(name, settle), controller, mode=mode)


def by_hand(setup: Setup, n: int, period: float = 1e-3, begin: float = 0.0, **columns: Any) -> Series:
    """Return a time series of n ticks at rest; ``columns`` replaces some values."""
    robot, propulsion = setup.robot, setup.robot.spec.propulsion
    joints = robot.nv - robot.first_joint
    rotors = 0 if propulsion is None else len(propulsion.rotors)
    middle = 0.0 if propulsion is None else (propulsion.speed_min + propulsion.speed_max) / 2
    nothing: dict[str, Any] = {
        "t": begin + period * np.arange(1, n + 1), "q": np.tile(setup.q, (n, 1)), "v": np.zeros((n, robot.nv)),
        "torque": np.zeros((n, joints)), "rotor_command": np.full((n, rotors), middle),
        "rotor_speed": np.full((n, rotors), middle), "force": np.zeros((n, 3)), "peak": np.zeros(n),
        "impulse": np.zeros((n, 3)), "slip": np.zeros(n), "touching": np.zeros(n, int),
        "feet": np.ones((n, len(feet_of(setup))), bool), "objective": np.full(n, np.nan), "level": np.zeros(n),
        "status": np.zeros(n, int), "at_stop": np.zeros((n, robot.nv), bool), "reference": np.zeros(n),
    }  # fmt: skip
    return Series(**{**nothing, **columns})


def fields_of(series: Series) -> dict[str, np.ndarray[Any, Any]]:
    """Return the columns of the series by name."""
    return {name: getattr(series, name) for name in series.__dataclass_fields__}
