"""Ticks of simulated robots and random states that need the relaxation, with the Python solution."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import pytest

from impact_posture.simulation.controllers.controller_factory import ControllerFactory
from impact_posture.simulation.scenario_file import read_scenario
from impact_posture.simulation.setup import set_up
from impact_posture.simulation.world.actuator_command import Push
from impact_posture.simulation.world.world import SimulationDiverged
from impact_posture.tsid import controller, relaxation
from impact_posture.tsid.assembly import Assembly
from impact_posture.tsid.qp.daqp_solver import DaqpSolver
from impact_posture.tsid.qp.hierarchy import Level

# Scenario, force (N) that acts on the frame from 0.2 s to 0.6 s, and simulated time (s).
RUNS = {
    "tilthex_arm": ("aerial-vertical", "ee", (0.0, 60.0, 40.0), 2.0),
    "solo8": ("solo8-push", "base_link", (150.0, 80.0, 0.0), 2.0),
    "talos": ("talos-push", "torso_2_link", (150.0, 60.0, 0.0), 2.0),
    "g1": ("g1-strike", "torso_link", (60.0, 40.0, 0.0), 2.0),
}


@dataclass(frozen=True, eq=False)
class RelaxedTick:
    """Program of a tick that must be relaxed, with the solution of the Python controller.

    Attributes:
        H: Cost matrix, shape (n, n).
        g: Cost vector, shape (n,).
        A: Constraint matrix, shape (m, n).
        lower: Lower bounds of ``[z; A z]``, shape (n + m,).
        upper: Upper bounds of ``[z; A z]``, shape (n + m,).
        level: Level of a bound, shape (n + m,): 0 for hard constraints, 1 for joint limits, then the strict levels.
        unit: Scale of each variable, the value that corresponds to an acceleration of 1, shape (n,).
        z: Solution of the Python controller, shape (n,); NaN if this controller has no solution.
    """

    H: np.ndarray
    g: np.ndarray
    A: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    level: np.ndarray
    unit: np.ndarray
    z: np.ndarray


def problem_of(assembly: Assembly, z: np.ndarray | None) -> RelaxedTick:
    """Return the optimization program that the relaxation of an assembly solves."""
    qp = assembly.rank.qp.copy()
    level = np.zeros(qp.n + qp.m, dtype=np.intc)
    level[assembly.limits] = 1
    for k, (_, rows) in enumerate(assembly.levels):
        level[qp.n + rows.start : qp.n + rows.stop] = 2 + k
    unit = assembly.rank.units.copy()
    answer = np.full(qp.n, np.nan) if z is None else z
    return RelaxedTick(qp.H, qp.g, qp.A, qp.lower, qp.upper, level, unit, answer)


@contextmanager
def recording() -> Iterator[list[RelaxedTick]]:
    """Record each relaxed tick of all controllers inside the ``with`` block."""
    ticks, relaxed = list[RelaxedTick](), list[Assembly]()
    solve, hierarchy = relaxation.solve, relaxation._hierarchy

    def noted(assembly: Assembly) -> list[Level]:
        relaxed.append(assembly)
        return hierarchy(assembly)

    def recorded(assembly: Assembly, solver: DaqpSolver) -> relaxation.Outcome:
        relaxed.clear()
        outcome = solve(assembly, solver)
        if relaxed:
            ticks.append(problem_of(assembly, None if outcome.solved is None else outcome.solved.z))
        return outcome

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(relaxation, "_hierarchy", noted)
        patch.setattr(controller, "solve", recorded)
        yield ticks


def pushed(name: str) -> tuple[list[RelaxedTick], int]:
    """Push a simulated robot that runs its nominal controller.

    Returns:
        The relaxed ticks, and how many of them precede the fall (base a third lower than at the start).
    """
    scenario, frame, force, seconds = RUNS[name]
    setup = set_up(read_scenario(scenario))
    driver, world, period = ControllerFactory(setup).driver("nominal"), setup.world, setup.scenario.control.period
    standing = None
    with recording() as ticks:
        command = driver.reset(setup.q)
        world.reset(setup.q, seed=0, rotor_speed=command.rotor_speed)
        for k in range(round(seconds / period)):
            if k == round(0.2 / period):
                world.push(Push(frame, force, 0.4))
            reading = world.read()
            if standing is None and setup.scenario.control.footing and reading.q[2] < setup.q[2] * 2 / 3:
                standing = len(ticks)
            command = driver.tick(reading, None)
            try:
                world.step(command, round(period / world.timestep))
            except SimulationDiverged:
                break
    return ticks, len(ticks) if standing is None else standing
