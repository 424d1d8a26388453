"""Ticks that need the relaxation, as Python solves them: recorded from simulated robots and from random states.

``python -m tests.relaxed_ticks FOLDER`` records the runs of :data:`RUNS` into ``FOLDER/<robot>.npz``.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from impact_posture.simulation.actuator_command import Push
from impact_posture.simulation.controller_factory import ControllerFactory
from impact_posture.simulation.scenario import set_up
from impact_posture.simulation.scenario_file import read_scenario
from impact_posture.tsid import relaxation
from impact_posture.tsid.assembly import Assembly
from impact_posture.tsid.qp import Solver

# Scenario, force (N) on the frame of the push from 0.2 s to 0.6 s, seconds.
RUNS = {
    "tilthex_arm": ("aerial-vertical", "ee", (0.0, 60.0, 40.0), 2.0),
    "solo8": ("solo8-push", "base_link", (25.0, 15.0, 0.0), 2.0),
    "talos": ("talos-push", "torso_2_link", (150.0, 60.0, 0.0), 2.0),
    "g1": ("g1-strike", "torso_link", (60.0, 40.0, 0.0), 2.0),
}


@dataclass(frozen=True, eq=False)
class RelaxedTick:
    """Program of a tick, with Python's answer.

    Attributes:
        H: Shape (n, n).
        g: Shape (n,).
        A: Shape (m, n).
        lower: Shape (n + m,).
        upper: Shape (n + m,).
        level: 0 for what always holds, 1 for joint limits, then the strict levels, shape (n + m,).
        unit: Value of each variable that compares with an acceleration of 1, shape (n,).
        z: Python's answer, shape (n,); NaN where it has none.
        tick: Number of the tick in its run.
    """

    H: np.ndarray
    g: np.ndarray
    A: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    level: np.ndarray
    unit: np.ndarray
    z: np.ndarray
    tick: np.ndarray


def problem_of(assembly: Assembly, z: np.ndarray | None, tick: int = 0) -> RelaxedTick:
    """Return the program that the relaxation of an assembly solves."""
    qp = assembly.rank.qp.copy()
    level = np.zeros(qp.n + qp.m, dtype=np.intc)
    level[assembly.limits] = 1
    for k, (_, rows) in enumerate(assembly.levels):
        level[qp.n + rows.start : qp.n + rows.stop] = 2 + k
    unit = assembly.rank._units.copy()
    answer = np.full(qp.n, np.nan) if z is None else z
    return RelaxedTick(qp.H, qp.g, qp.A, qp.lower, qp.upper, level, unit, answer, np.array(tick))


@contextmanager
def recording() -> Iterator[list[RelaxedTick]]:
    """Record each relaxed tick of any controller."""
    found, relax = list[RelaxedTick](), relaxation._relax

    def recorded(assembly: Assembly, solver: Solver) -> relaxation.Outcome:
        outcome = relax(assembly, solver)
        found.append(problem_of(assembly, None if outcome.solved is None else outcome.solved.z, clock[0]))
        return outcome

    clock = [0]
    relaxation._relax = recorded
    try:
        yield found
    finally:
        relaxation._relax = relax


def pushed(name: str) -> list[RelaxedTick]:
    """Push a simulated robot with its nominal controller, and return its relaxed ticks."""
    scenario, frame, force, seconds = RUNS[name]
    setup = set_up(read_scenario(scenario))
    driver, world, period = ControllerFactory(setup).driver("nominal"), setup.world, setup.scenario.control.period
    with recording() as found:
        command = driver.reset(setup.q)
        world.reset(setup.q, seed=0, rotor_speed=command.rotor_speed)
        count = round(period / world.timestep)
        for k in range(round(seconds / period)):
            if k == round(0.2 / period):
                world.push(Push(frame, force, 0.4))
            before = len(found)
            command = driver.tick(world.read(), None)
            for i in range(before, len(found)):
                found[i] = RelaxedTick(
                    **{f.name: getattr(found[i], f.name) for f in fields(RelaxedTick)} | {"tick": np.array(k)}
                )
            try:
                world.step(command, count)
            except Exception as error:
                print(name, "ended at tick", k, error)
                break
    return found


def save(path: Path, ticks: list[RelaxedTick]) -> None:
    """Save ticks of one size."""
    np.savez_compressed(path, **{f.name: np.array([getattr(t, f.name) for t in ticks]) for f in fields(RelaxedTick)})


def load(path: Path) -> list[RelaxedTick]:
    """Load what :func:`save` wrote."""
    with np.load(path) as file:
        columns = [file[f.name] for f in fields(RelaxedTick)]
    return [RelaxedTick(*values) for values in zip(*columns, strict=True)]


if __name__ == "__main__":
    for robot_name in sys.argv[2:] or RUNS:
        recorded_ticks = pushed(robot_name)
        print(
            robot_name,
            len(recorded_ticks),
            "relaxed",
            [int(t.tick) for t in recorded_ticks[:: max(1, len(recorded_ticks) // 20)]],
            flush=True,
        )
        if recorded_ticks:
            save(Path(sys.argv[1]) / f"{robot_name}.npz", recorded_ticks)
