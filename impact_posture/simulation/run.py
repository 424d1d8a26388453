"""One run: a controller in a scenario, from the start to the end, with a record of all that happened."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from impact_posture.errors import InputError, SimulationDiverged
from impact_posture.processes import fork_call
from impact_posture.progress import tell
from impact_posture.simulation.actuator_command import ActuatorCommand
from impact_posture.simulation.controller_factory import ControllerFactory, Mode
from impact_posture.simulation.driver import Driver
from impact_posture.simulation.recorder import Recorder
from impact_posture.simulation.reference import Reference
from impact_posture.simulation.scenario import RepeatedContacts, SinglePush
from impact_posture.simulation.scenario_objective import interpreted
from impact_posture.simulation.series import RECOVERY, Series, Window
from impact_posture.tsid.controller import Command

Array = NDArray[np.float64]

# When controllers begin to prepare, s: after the first reaction of sensors and motors.
_BRACE = 0.1
# Ticks from one word about the progress to the next.
_TELL = 100


@dataclass(frozen=True, eq=False)
class Run:
    """What came of a run.

    Attributes:
        series: Tick by tick.
        windows: What counts as impact, one for each contact or push; then, for contacts, the dwell windows.
        sign: Of the push; 1 for contacts.
        waited: Seconds until the robot was pushed; NaN for contacts.
        rested: Whether it had come to rest by then; one that does not within the scenario's patience is pushed all
            the same, and what is measured holds its own motion.
        away: When the state ran away, which ended the run, s.
    """

    series: Series
    windows: tuple[Window, ...]
    sign: int = 1
    waited: float = float("nan")
    rested: bool = True
    away: float | None = None

    @property
    def impacts(self) -> tuple[Window, ...]:
        """The windows that count as impact."""
        return tuple(w for w in self.windows if w.kind == "impact")


def run(factory: ControllerFactory, controller: str, *, seed: int = 0, mode: Mode = "live", gain: float | None = None,
        only: int | None = None) -> tuple[Run, ...]:  # fmt: skip
    """Let a controller live through a scenario: one run, or one for each sign of the push.

    Args:
        factory: The scenario and its parts.
        controller: Its name.
        seed: Of the sensors' noise.
        mode: ``live``: the term stays on; ``held``: the reached posture is held before the first impact.
        gain: K instead of the scenario's, 1/s².
        only: That sign of the push alone.

    Raises:
        SimulationDiverged: The robot ran away at once; one that does so later has a run that ends there.
        ControllerNotFound: No such controller.
        InputError: Ticks that are no multiple of the physics' steps, or a sign that is none.
    """
    driver = factory.driver(controller, mode, gain)
    task = factory.setup.scenario.task
    if isinstance(task, RepeatedContacts):
        return (_contacts(factory, driver, task, seed, mode),)
    if only not in (None, 1, -1):
        raise InputError(f"{only} is no sign of a push", where=factory.setup.scenario.source, hint="give 1 or -1")
    return _pushes(factory, driver, task, task.signs if only is None else (only,), seed, mode)


class _Loop:
    """Controller and world, tick by tick."""

    def __init__(self, factory: ControllerFactory, driver: Driver, seed: int) -> None:
        setup = factory.setup
        self.setup, self.driver, self.world = setup, driver, setup.world
        self.period = setup.scenario.control.period
        self.count = round(self.period / self.world.timestep)
        if self.count < 1 or abs(self.count * self.world.timestep - self.period) > 1e-9:
            raise InputError(
                f"a tick of {self.period:g} s is no multiple of the physics' {self.world.timestep:g} s",
                where=setup.scenario.source,
                hint="change control.period or physics.timestep",
            )
        command = driver.reset(setup.q)
        self.world.reset(setup.q, seed=seed, rotor_speed=command.rotor_speed)
        tell("building the expressions")
        self.recorder = Recorder(setup, interpreted(factory.objective()))
        self.away: float | None = None

    @property
    def t(self) -> float:
        return self.world.time

    def tick(self, reference: Reference | None = None) -> bool:
        """Go on by a tick; whether the state is still one."""
        point = None if reference is None else reference.at(self.t)
        command: Command = self.driver.tick(self.world.read(), point)
        try:
            self.world.step(ActuatorCommand(command.torque, command.rotor_speed), self.count)
        except SimulationDiverged as error:
            # A picture needs two ticks.
            if self.recorder.ticks < 2:
                raise
            self.away = error.time
            return False
        distance = 0.0 if point is None else point.distance
        self.recorder.take(self.world.truth(), command, self.driver.level, distance)
        if not self.recorder.ticks % _TELL:
            tell(f"simulating, t = {self.t:.1f} s", None if reference is None else self.t / reference.total)
        return True


def _contacts(factory: ControllerFactory, driver: Driver, task: RepeatedContacts, seed: int, mode: Mode) -> Run:
    loop = _Loop(factory, driver, seed)
    reference = Reference(task, factory.setup.gap)
    # Where the way in crosses the surface: what follows is braking behind it.
    crossing = reference.inward - 2 * task.beyond / task.speed
    impacts = [reference.start(k) + crossing for k in range(task.count)]
    ramp = factory.setup.scenario.control.robust.ramp
    events = [(_BRACE, driver.brace)]
    if mode == "held":
        events.append((max(_BRACE, reference.start(0) - 2 * ramp), driver.hold))
    expected = list(impacts)
    for _ in range(round(reference.total / loop.period)):
        while events and loop.t >= events[0][0] - 1e-9:
            events.pop(0)[1]()
        # The way in begins long before: from there on the next impact is the one that is expected.
        if expected and loop.t >= expected[0] - crossing - 1e-9:
            driver.expect(expected.pop(0))
        if not loop.tick(reference):
            break
    series, first = loop.recorder.series(), []
    for k, impact in enumerate(impacts):
        begin, end = reference.start(k), reference.start(k) + reference.cycle
        touch = loop.recorder.first_touch(begin, end)
        leaves = begin + reference.inward + task.dwell
        at = impact if touch is None else touch
        first.append(Window("impact", k, at, at + task.window, touch is not None))
        first.append(Window("dwell", k, at, max(leaves, at), touch is not None))
        first.append(Window("recovery", k, at, min(at + RECOVERY, end), touch is not None))
    return Run(series, tuple(sorted(first, key=lambda w: w.kind != "impact")), away=loop.away)


def _pushes(
    factory: ControllerFactory, driver: Driver, task: SinglePush, signs: Sequence[int], seed: int, mode: Mode
) -> tuple[Run, ...]:
    """Settle once, and push each way from there: the other ways in copies of this process."""
    loop = _Loop(factory, driver, seed)
    ramp, brace = factory.setup.scenario.control.robust.ramp, [driver.brace]
    # Whatever the scenario's patience: all controllers begin to prepare before a push.
    rested = _settle(loop, task, max(task.settle, _BRACE + loop.period), brace)
    if mode == "held":
        # What was reached is held, and comes to rest once more without the term.
        driver.hold()
        rested = _settle(loop, task, loop.t + 2 * ramp, []) and rested
    if loop.away is not None:
        return tuple(Run(loop.recorder.series(), (), sign, rested=False, away=loop.away) for sign in signs)
    first, *others = (partial(_push, loop, task, sign, rested) for sign in signs)
    with ExitStack() as copies:
        waiting = [copies.enter_context(fork_call(other)) for other in others]
        return (first(), *(collect() for collect in waiting))


def _push(loop: _Loop, task: SinglePush, sign: int, rested: bool) -> Run:
    begin = loop.t
    loop.driver.expect(begin)
    push = task.push(sign)
    loop.world.push(push)
    loop.recorder.pushed(np.array(push.force), begin, begin + task.duration)
    for _ in range(round((task.duration + task.after) / loop.period)):
        if not loop.tick():
            break
    ends = {"impact": task.duration, "recovery": min(RECOVERY, task.duration + task.after)}
    windows = tuple(Window(kind, 0, begin, begin + length, True) for kind, length in ends.items())
    return Run(loop.recorder.series(), windows, sign, begin, rested, loop.away)


def _settle(loop: _Loop, task: SinglePush, least: float, brace: list[Callable[[], None]]) -> bool:
    """Go on until ``least`` and until the robot has been quiet for long enough; whether it has."""
    still, end = 0.0, max(least, loop.t) + task.patience
    while loop.t < least - 1e-9 or still < task.still - 1e-9:
        if loop.t > end or loop.away is not None:
            return False
        if brace and loop.t >= _BRACE - 1e-9:
            brace.pop()()
        loop.tick()
        still = still + loop.period if loop.recorder.speed < task.quiet else 0.0
    return True
