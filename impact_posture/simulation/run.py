"""Run a controller through a scenario and record every tick."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial

import numpy as np

from impact_posture.errors import InputError, SimulationDiverged
from impact_posture.simulation.compiled_world import compiled_world
from impact_posture.simulation.controllers.contact_reference import Reference
from impact_posture.simulation.controllers.controller_factory import ControllerFactory, Mode
from impact_posture.simulation.controllers.driver import Driver
from impact_posture.simulation.recorder import Recorder
from impact_posture.simulation.scenario_file import RepeatedContacts, SinglePush
from impact_posture.simulation.series import RECOVERY, SAME, Series, Window
from impact_posture.simulation.world.throw import FLIGHT, Throw
from impact_posture.system.arrays import Array
from impact_posture.system.processes import fork_call
from impact_posture.system.progress import tell

# Controllers start to prepare for the impact at this time, s.  At this time, transients of sensors and motors are
# over.
BRACE = 0.1
# Number of ticks between two progress messages: ``_TELL`` for the loop in Python, ``_TELL_IN_C`` for the loop in C.
_TELL, _TELL_IN_C = 100, 1000
# Maximum number of ticks in a run, nearly three hours at 1 kHz.  The record of a tick of an arm takes about a
# kilobyte.
_MOST = 10**7
# Maximum number of physics steps in a tick.  A tick must be short, because a signal cannot interrupt it.
_MOST_STEPS = 10**5


@dataclass(frozen=True, eq=False)
class Run:
    """Record of a run.

    Attributes:
        series: Time series of all ticks.
        windows: Impact windows of all contacts or pushes, then the dwell and recovery windows.
        sign: Sign of the push or throw; 1 for contacts.
        waited: Start of the impact window of the push or throw, s; NaN for contacts.
        rested: Whether the robot was at rest before the push.  If the robot does not come to rest, the push starts
            after the time ``patience`` of the scenario, and the metrics contain the motion before the push.
        away: Time at which the state diverged and the run ended, s; ``None`` if the state did not diverge.
    """

    series: Series
    windows: tuple[Window, ...]
    sign: int = 1
    waited: float = float("nan")
    rested: bool = True
    away: float | None = None

    def of(self, kind: str) -> tuple[Window, ...]:
        """Return the windows with this ``kind``: ``impact``, ``dwell`` or ``recovery``."""
        return tuple(window for window in self.windows if window.kind == kind)


def run(factory: ControllerFactory, controller: str, *, seed: int = 0, mode: Mode = "live", gain: float | None = None,
        only: int | None = None) -> tuple[Run, ...]:  # fmt: skip
    """Run a controller through a scenario: one run for contacts, or one run for each sign of a push or throw.

    Args:
        factory: Factory of the scenario's controllers.
        controller: Name of the controller.
        seed: Seed of the sensor noise.
        mode: ``live`` keeps the impact-robust term on.  ``held`` switches the term off before the first impact and
            holds the posture that the robot has reached.
        gain: K of the impact-robust term, 1/s², which replaces the value in the scenario.
        only: Sign of the push to run; by default, every sign of the scenario.

    Raises:
        SimulationDiverged: The state diverged within two ticks.  If the state diverges later, the run ends without an
            error.
        ControllerNotFound: The controller is unknown.
        InputError: A tick is not a multiple of the physics step, a tick or the run is too long, or ``only`` is not 1
            or -1.
    """
    scenario = factory.setup.scenario
    if only not in (None, 1, -1) and not scenario.contacts:
        raise InputError(f"{only} is not a sign of a push", where=scenario.source, hint="give 1 or -1")
    driver = factory.driver(controller, mode, gain)
    with factory.errors_named(controller):
        loop, task = _Loop(factory, driver, seed), scenario.task
        if isinstance(task, RepeatedContacts):
            return (_contacts(loop, task, mode),)
        return _pushes(loop, task, task.signs if only is None else (only,), mode)


class _Loop:
    """Loop of controller and world: in C if both have C code and the posture reference rests, else in Python."""

    def __init__(self, factory: ControllerFactory, driver: Driver, seed: int) -> None:
        setup = factory.setup
        self.setup, self.driver, self.world = setup, driver, setup.world
        self.period, self.ramp = setup.scenario.control.period, setup.scenario.control.robust.ramp
        self.count = round(self.period / self.world.timestep)
        if not 1 <= self.count <= _MOST_STEPS or abs(self.count * self.world.timestep - self.period) > 1e-9:
            fault = "not a multiple of" if self.count <= _MOST_STEPS else f"more than {_MOST_STEPS:.0e} times"
            what = f"a tick of {self.period:g} s is {fault} the physics' {self.world.timestep:g} s"
            raise InputError(what, where=setup.scenario.source, hint="change control.period or physics.timestep")
        command = driver.reset(driver.start)
        self.world.reset(driver.start, seed=seed, rotor_speed=command.rotor_speed)
        # The loop in C needs all targets before the first tick, and does not support references of the posture task.
        in_c = None if driver.leads_posture else driver.compiled
        self.compiled = compiled_world(self.world, in_c, self.count)
        self.recorder = Recorder(setup, factory.metric)
        self.away: float | None = None

    @property
    def t(self) -> float:
        return self.world.time

    def ticks(self, n: int, reference: Reference | None = None) -> Array:
        """Run n ticks and return ``‖ν‖`` after each tick.

        If the state diverges, run fewer ticks and set :attr:`away` to the time.
        """
        take, most = (self._in_python, _TELL) if self.compiled is None else (self._in_c, _TELL_IN_C)
        speeds = np.zeros(0)
        while speeds.size < n:
            count = min(most, n - speeds.size)
            new = take(count, reference)
            speeds = np.concatenate([speeds, new])
            if new.size < count:
                # Without two ticks, there is nothing to show in figures.
                if self.recorder.ticks < 2:
                    raise SimulationDiverged(self.t, where=self.setup.robot.name)
                self.away = self.t
                break
            tell(f"simulating, t = {self.t:.1f} s", None if reference is None else self.t / reference.total)
        return speeds

    def check_length(self, t: float) -> None:
        """Raise an InputError if a run of duration ``t`` (s) has fewer than two or more than :data:`_MOST` ticks."""
        if not 2 * self.period <= t <= _MOST * self.period:
            fault, hint = f"more than {_MOST:.0e}", "make contacts fewer or shorter, or raise control.period"
            if t < 2 * self.period:
                fault, hint = "fewer than two", "lower control.period"
            what = f"a run of {t:g} s has {fault} ticks of {self.period:g} s"
            raise InputError(what, where=self.setup.scenario.source, hint=hint)

    def until(self, t: float) -> int:
        """Return the number of ticks until time ``t`` (s), at least one."""
        return max(1, math.ceil((t - SAME - self.t) / self.period))

    def _in_python(self, n: int, reference: Reference | None) -> Array:
        speeds = []
        for _ in range(n):
            point = None if reference is None else reference.at(self.t)
            command = self.driver.tick(self.world.read(), point)
            try:
                self.world.step(command, self.count)
            except SimulationDiverged:
                break
            self.recorder.take(command, self.driver.level, 0.0 if point is None else point.distance)
            speeds.append(self.world.speed)
        return np.array(speeds)

    def _in_c(self, n: int, reference: Reference | None) -> Array:
        assert self.compiled is not None  # noqa: S101 (the caller has checked it)
        distances: list[float] = []
        levels: list[float] = []
        # If a driver overrides `level`, its level does not come from the C controller, so read it before each tick.
        overrides = type(self.driver).level is not Driver.level

        def lead(t: float) -> None:
            point = None if reference is None else reference.at(t)
            self.driver.lead(t, point)
            distances.append(0.0 if point is None else point.distance)
            if overrides:
                levels.append(self.driver.level)

        ticks = self.compiled.take(n, lead)
        done = ticks.level.size
        level = np.array(levels[:done]) if overrides else ticks.level
        self.recorder.take_all(ticks.trace, ticks.rotor_speed, level, ticks.status, np.array(distances[:done]))
        return np.asarray(np.linalg.norm(ticks.trace.v, axis=1))


def _contacts(loop: _Loop, task: RepeatedContacts, mode: Mode) -> Run:
    driver, reference = loop.driver, Reference(task, loop.setup.gap)
    loop.check_length(reference.total)
    starts = [reference.start(k) for k in range(task.count)]
    events = [(0.0 if loop.setup.scenario.falls else BRACE, driver.brace)]
    if mode == "held":
        events.append((max(BRACE, starts[0] - 2 * loop.ramp), driver.hold))
    # At the start of each approach, or earlier if needed, tell the controller the expected time of the impact.
    for start in starts:
        due = start + reference.crossing
        events.append((min(start, max(BRACE, due - driver.ahead)), partial(driver.expect, due)))
    events.sort(key=lambda event: event[0])
    left = round(reference.total / loop.period)
    while left and loop.away is None:
        while events and loop.t >= events[0][0] - SAME:
            events.pop(0)[1]()
        n = min(left, loop.until(events[0][0])) if events else left
        loop.ticks(n, reference)
        left -= n
    windows = []
    for k, start in enumerate(starts):
        end = start + reference.cycle
        touches = loop.recorder.first_touches(start, end)
        begin = touches[0] if touches else start + reference.crossing
        landed = max((touch - begin for touch in touches if touch <= begin + task.window), default=0.0)
        leaves = start + reference.inward + task.dwell
        ends = {"impact": begin + task.window, "dwell": max(leaves, begin), "recovery": min(begin + RECOVERY, end)}
        windows += [Window(kind, k, begin, until, bool(touches), landed) for kind, until in ends.items()]
    windows.sort(key=lambda window: window.kind != "impact")
    return Run(loop.recorder.series(), tuple(windows), away=loop.away)


def _pushes(loop: _Loop, task: SinglePush | Throw, signs: Sequence[int], mode: Mode) -> tuple[Run, ...]:
    """Let the robot come to rest once, then push it with each sign.  The second sign runs in a forked process."""
    length = task.window if isinstance(task, Throw) else task.duration
    loop.check_length(task.settle + task.patience + length + task.after)
    # All controllers begin to prepare for the push at the time BRACE, so the push must be later.
    rested = _settle(loop, task, max(task.settle, BRACE + loop.period), [loop.driver.brace])
    if mode == "held":
        # Hold the reached posture without the term, and wait until the robot comes to rest again.
        loop.driver.hold()
        rested = _settle(loop, task, loop.t + 2 * loop.ramp, []) and rested
    if loop.away is not None:
        return tuple(Run(loop.recorder.series(), (), sign, rested=False, away=loop.away) for sign in signs)
    first, *others = (partial(_push, loop, task, sign, rested) for sign in signs)
    with ExitStack() as copies:
        waiting = [copies.enter_context(fork_call(other)) for other in others]
        return (first(), *(collect() for collect in waiting))


def _push(loop: _Loop, task: SinglePush | Throw, sign: int, rested: bool) -> Run:
    begin = expected = loop.t
    if isinstance(task, Throw):
        expected, length = begin + FLIGHT, task.window
        loop.world.throw(sign)
    else:
        push, length = task.push(sign), task.duration
        loop.world.push(push)
        loop.recorder.pushed(np.array(push.force), begin, begin + length)
    loop.driver.expect(expected)
    loop.ticks(round((expected - begin + length + task.after) / loop.period))
    touches = loop.recorder.first_touches(begin, np.inf) if isinstance(task, Throw) else [begin]
    hit = touches[0] if touches else expected
    ends = {"impact": length, "recovery": min(RECOVERY, length + task.after)}
    windows = tuple(Window(kind, 0, hit, hit + end, bool(touches)) for kind, end in ends.items())
    return Run(loop.recorder.series(), windows, sign, hit, rested, loop.away)


def _settle(loop: _Loop, task: SinglePush | Throw, least: float, brace: list[Callable[[], None]]) -> bool:
    """Run until time ``least`` (s), and until the robot has been at rest for the time ``task.still``.

    ``brace`` contains the callback that prepares the controller.  Return false if the robot does not come to rest
    within ``task.patience``.
    """
    still, end = 0.0, max(least, loop.t) + task.patience
    while loop.t < least - SAME or still < task.still - SAME:
        if loop.t > end or loop.away is not None:
            return False
        if brace and loop.t >= BRACE - SAME:
            brace.pop()()
        # Run all ticks until the earliest time in ``waits`` in one call, because nothing can change before this time.
        waits = [max(least, loop.t + task.still - still), end, *([BRACE] if brace else [])]
        for speed in loop.ticks(min(map(loop.until, waits))):
            still = still + loop.period if speed < task.quiet else 0.0
    return True
