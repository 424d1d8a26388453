"""What became of a run: whether its numbers say something about a controller, or the robot fell."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Literal, get_args

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.simulation.recorder import STATUSES, feet_of
from impact_posture.simulation.run import Run
from impact_posture.simulation.scenario import RepeatedContacts, Setup
from impact_posture.simulation.series import Series
from impact_posture.tsid.controller import Status

Flags = NDArray[np.bool_]
# Each graver than the one before.
Outcome = Literal["completed", "lost contact", "control lost", "fell"]
OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)


@dataclass(frozen=True)
class Event:
    """A bound that was broken.

    Attributes:
        status: What that makes of the run.
        time: When, s.
        what: In words.
    """

    status: Outcome
    time: float
    what: str

    @property
    def line(self) -> str:
        """What and when."""
        return f"{self.what} at t = {self.time:.2f} s"

    def to_dict(self) -> dict[str, object]:
        """JSON content."""
        return asdict(self)


def gravest(found: Iterable[Outcome]) -> Outcome:
    """The gravest of several statuses; ``completed`` for none."""
    return max(found, key=OUTCOMES.index, default="completed")


def judge(setup: Setup, run: Run) -> tuple[Event, ...]:
    """Hold a run against its scenario's bounds: what was broken, in the order of time; nothing for a good run."""
    found = [*_falls(setup, run.series), *_losses(setup, run), *_contacts(setup, run)]
    return tuple(sorted(found, key=lambda event: event.time))


def _falls(setup: Setup, series: Series) -> list[Event]:
    """Of a floating base: tilt, height above the surfaces, and how far it sank."""
    if not setup.robot.floating:
        return []
    bounds, built, places = setup.scenario.bounds, setup.world.built, series.q[:, :3]
    upright = pin.Quaternion(setup.q[3:7]).matrix()[2]
    tilt = np.array([pin.Quaternion(q).matrix()[2] @ upright for q in series.q[:, 3:7]])
    normal = setup.scenario.normal if isinstance(setup.scenario.task, RepeatedContacts) else np.zeros(3)
    sunk = setup.q[2] - normal[2] * series.reference - places[:, 2]
    broken = {
        f"the base tilted beyond {bounds.tilt_deg:g}°": tilt < np.cos(np.radians(bounds.tilt_deg)),
        f"the base sank by more than {bounds.sink:g} m": sunk > bounds.sink,
    }
    for name, n in built.normals.items():
        if (setup.q[:3] - built.points[name]) @ n < bounds.clearance:
            # It began there: an endless plane that the arm reaches around.
            continue
        words = f"the base came closer than {bounds.clearance:g} m to" if bounds.clearance else "the base went into"
        broken[f"{words} the surface '{name}'"] = (places - built.points[name]) @ n < bounds.clearance
    return [Event("fell", float(series.t[np.argmax(flags)]), what) for what, flags in broken.items() if flags.any()]


def _losses(setup: Setup, run: Run) -> list[Event]:
    """Of control: commands that gave way or were held, and a state that ran away."""
    bounds, series, period = setup.scenario.bounds, run.series, setup.scenario.control.period
    found = []
    relaxed = series.status == STATUSES.index(Status.RELAXED)
    if relaxed.mean() > bounds.relaxed:
        words = f"limits made tasks give way in {100 * relaxed.mean():.0f} % of all ticks, first"
        found.append(Event("control lost", float(series.t[np.argmax(relaxed)]), words))
    held = ~relaxed & (series.status != STATUSES.index(Status.SOLVED))
    begin, length = _longest(held)
    if length * period > bounds.held + 1e-9:
        words = f"no command was found for {length * period:.3g} s, the last one was held,"
        found.append(Event("control lost", float(series.t[begin]), words))
    if run.away is not None:
        found.append(Event("control lost", run.away, "the state ran away"))
    return found


def _contacts(setup: Setup, run: Run) -> list[Event]:
    """Contacts that were asked for and never made, and feet that did not stay."""
    bounds, series, period = setup.scenario.bounds, run.series, setup.scenario.control.period
    found = []
    missed = [window for window in run.impacts if not window.touched]
    if missed:
        words = f"{len(missed)} of {len(run.impacts)} contacts were never made, the first expected"
        found.append(Event("lost contact", missed[0].begin, words))
    lifted = [(*_longest(~touches.astype(bool)), foot) for foot, touches in enumerate(series.feet.T)]
    lifted = [each for each in lifted if each[1] * period > bounds.lifted + 1e-9]
    if lifted:
        # Where one foot goes others follow: the first is told.
        begin, length, foot = min(lifted)
        words = f"{feet_of(setup)[foot]} left the ground for {length * period:.3g} s"
        found.append(Event("lost contact", float(series.t[begin]), words))
    return found


def _longest(flags: Flags) -> tuple[int, int]:
    """Where the longest row of set flags begins, and how many it has."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    begins, lengths = edges[::2], edges[1::2] - edges[::2]
    if not lengths.size:
        return 0, 0
    k = int(np.argmax(lengths))
    return int(begins[k]), int(lengths[k])
