"""Read recorded hits: the CSV files of epfl-lasa/air_hockey, and short windows of them in JSON files."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from docs.studies.core import Vector
from impact_posture.errors import InputError

PERIOD = 0.005  # sampling period, s
JOINTS = 7
SOURCE = (
    "recordings: epfl-lasa/air_hockey on GitHub, folder data/airhockey_consistency_with_NS_inertia_shaping "
    "(files IIWA_7_hit_*.csv); then `make study-hits DATA=FOLDER`"
)
# Name of a quantity here → column of a CSV file, key of a window.
_QUANTITIES = {
    "q": ("JointPosition", "q"),
    "dq": ("JointVelocity", "dq"),
    "effort": ("JointEffort", "tau"),
    "command": ("TorqueCmd", "tau_cmd"),
}
# Number of rows of a CSV file that are kept before the contact.
_BEFORE = 7
# Number of rows that are kept after the contact.
_AFTER = 14
# Number of rows before the braking in which the contact is searched.
_BRAKED = 14
# Lag of the recorded velocity, in samples: it is filtered with dq[k] = 0.8 dq[k-1] + 0.2 Δq/5 ms.
_LAG = 4.0
# Variance of Δq/5 ms divided by the variance of the recorded velocity.
_WEIGHT = 9.0
# Number of intervals before the contact from which the trend is fitted.
_TREND = 6
# Number of intervals that suffice for the fit.
_ENOUGH = 3
# Box → intervals after the contact row over which the velocity is averaged.  The light box leaves the tip after about
# 10 ms, the heavy box after about 25 ms.
AVERAGED = {1: (2, 4), 2: (5, 7)}


@dataclass(frozen=True)
class Group:
    """Hits of one box in one null-space posture."""

    posture: int
    box: int

    def __str__(self) -> str:
        return f"posture {self.posture}, {'heavy' if self.box == 2 else 'light'} box"


@dataclass(frozen=True, eq=False)
class Hit:
    """Samples around one contact, one row per 5 ms.

    Attributes:
        group: Posture and box.
        contact: Index of the first row in which the contact shows, give or take one row.
        q: Joint positions, rad, shape (k, 7).
        dq: Recorded joint velocities, filtered, rad/s, shape (k, 7).
        torque: Torques that the sensors measure between drives and links, N·m, shape (k, 7), with gravity.  The sign
            convention is the same as for ``command``.
        command: Commanded torques without gravity, N·m, shape (k, 7).
    """

    name: str
    group: Group
    contact: int
    q: Vector
    dq: Vector
    torque: Vector
    command: Vector

    @property
    def velocity(self) -> Vector:
        """Joint velocities Δq/5 ms between the rows, rad/s, shape (k - 1, 7)."""
        return np.diff(self.q, axis=0) / PERIOD

    @property
    def last_before(self) -> int:
        """Index of the last row that is certainly before the contact."""
        return self.contact - 1

    def later(self) -> Hit | None:
        """Return this hit with the contact one row later; ``None`` if the recording then ends too early."""
        moved = replace(self, contact=self.contact + 1)
        return moved if moved.contact + AVERAGED[self.group.box][1] < len(self.q) else None

    def trend(self) -> tuple[Vector, Vector]:
        """Return the velocity (rad/s) in the last row before the contact, and the acceleration (rad/s²), shapes (7,).

        A straight line is fitted to the velocities before the contact.  If fewer than :data:`_TREND` rows precede
        the contact, the recorded velocity of the first row replaces the missing rows.
        """
        first = max(0, self.last_before - _TREND)
        times = np.arange(first, self.last_before) + 0.5
        rates, weights = self.velocity[first : self.last_before], np.ones(len(times))
        if len(times) < _ENOUGH:
            times, rates = np.append(times, first - 0.5 - _LAG), np.vstack([rates, self.dq[first]])
            weights = np.append(weights, _WEIGHT)
        root = np.sqrt(weights)[:, None]
        columns = np.column_stack([np.ones(len(times)), times - self.last_before])
        value, slope = np.linalg.lstsq(columns * root, rates * root, rcond=None)[0]
        return value, slope / PERIOD

    def deviation(self) -> tuple[Vector, Vector]:
        """Return the times after the contact row, s, shape (k,), and velocity minus trend, rad/s, shape (k, 7)."""
        value, slope = self.trend()
        middles = np.arange(len(self.velocity)) + 0.5
        trend = value + slope * PERIOD * (middles - self.last_before)[:, None]
        return PERIOD * (middles - self.contact), self.velocity - trend

    def mean_after(self, rates: Vector) -> Vector:
        """Return the mean of velocities after the contact, shape (7,), over the intervals :data:`AVERAGED`."""
        start, stop = AVERAGED[self.group.box]
        return np.asarray(np.mean(rates[self.contact + start : self.contact + stop], axis=0))

    def impulse(self, values: Vector, rows: int | None = None) -> Vector:
        """Return the time integral of the change of ``values`` over this number of rows from the contact.

        By default, the integral ends with the intervals :data:`AVERAGED`.
        """
        change = values - values[: self.last_before + 1].mean(axis=0)
        rows = AVERAGED[self.group.box][1] if rows is None else rows
        return np.asarray(PERIOD * change[self.contact : self.contact + rows].sum(axis=0))


def read_hits(folder: Path) -> tuple[list[Hit], list[str]]:
    """Read all recordings below a folder; return the hits, and why other recordings are left out.

    Raises:
        InputError: The folder contains no recording, or a file is damaged.
    """
    files = sorted([*folder.rglob("IIWA_7_hit_*.csv"), *folder.rglob("*hit_*.json")])
    if not files:
        raise InputError("contains no recording of a hit", where=str(folder), hint=SOURCE)
    results = [_read(path) for path in files]
    return [hit for hit in results if isinstance(hit, Hit)], [reason for reason in results if isinstance(reason, str)]


def _read(path: Path) -> Hit | str:
    """Return a hit, or the reason why the recording cannot be used."""
    try:
        if path.suffix == ".csv":
            source, contact, times, rows = _from_csv(path)
        else:
            source, contact, times, rows = _from_window(path)
    except (KeyError, TypeError, ValueError, StopIteration, csv.Error) as error:
        what = f"is not a recording of a hit ({type(error).__name__}: {error})"
        raise InputError(what, where=str(path), hint="download the file again") from None
    except OSError as error:
        raise InputError.unreadable(path, error) from None
    named = re.search(r"config_([12]).*object_([12])", PurePosixPath(source).parent.name)
    if named is None:
        return "neither posture 1 nor posture 2"
    group = Group(int(named[1]), int(named[2]))
    if contact is None or contact < 2:
        return "no contact, or begins at the contact"
    stop = contact + AVERAGED[group.box][1]
    if stop >= len(times):
        return "ends too early"
    used = slice(0, stop + 1)
    repeated = (np.abs(np.diff(rows["q"][used], axis=0)) < 1e-9).all(axis=1)
    if repeated.any() or (np.diff(times[used]) > 1.5 * PERIOD).any():
        return "skips samples"
    return Hit(path.stem, group, contact, rows["q"], rows["dq"], -rows["effort"], rows["command"])


def _from_window(path: Path) -> tuple[str, int | None, Vector, dict[str, Vector]]:
    window = json.loads(path.read_text(encoding="utf-8"))
    contact = window["contact_row_approx"] if "contact_row_approx" in window else window["impact_row"]
    contact = None if contact is None else int(contact)
    rows = _arrays({name: [row[key] for row in window["rows"]] for name, (_, key) in _QUANTITIES.items()})
    return str(window["source"]), contact, _times([row["t"] for row in window["rows"]]), rows


def _from_csv(path: Path) -> tuple[str, int | None, Vector, dict[str, Vector]]:
    with path.open(encoding="utf-8", newline="") as lines:
        table = csv.reader(lines)
        names = next(row for row in table if row and row[0] == "RobotName")
        rows = [dict(zip(names, row, strict=True)) for row in table]
    arrays = _arrays({name: [row[column].split() for row in rows] for name, (column, _) in _QUANTITIES.items()})
    times = _times([row["RosTime"] for row in rows])
    contact = contact_row(arrays["effort"], arrays["command"])
    if contact is None:
        return path.as_posix(), None, times, arrays
    first = max(0, contact - _BEFORE)
    kept = slice(first, contact + _AFTER)
    return path.as_posix(), contact - first, times[kept], {name: array[kept] for name, array in arrays.items()}


def _arrays(lists: Mapping[str, Iterable[Any]]) -> dict[str, Vector]:
    arrays = {name: np.array(list(values), dtype=float) for name, values in lists.items()}
    for name, array in arrays.items():
        if array.ndim != 2 or array.shape[1] != JOINTS or not np.isfinite(array).all():
            raise ValueError(f"{name} must have {JOINTS} finite numbers in each row")
    return arrays


def _times(values: Iterable[Any]) -> Vector:
    times = np.array(list(values), dtype=float)
    if times.ndim != 1 or not np.isfinite(times).all():
        raise ValueError("each row must have a finite time")
    return times


def contact_row(effort: Vector, command: Vector) -> int | None:
    """Return the first row in which the contact shows; ``None`` if no row shows it.

    About 45 to 60 ms after the contact, the controller brakes, and its torque on joint 1 falls at once.  The contact
    is searched in the 70 ms before the braking.  The contact row is the first row in which the effort of a joint
    changes by 4 N·m, and by 5 N·m within two rows.  Joint 2 does not count, because its large effort is noisy.  In
    the 24 windows with braking, this row differs by at most one from the row that the authors of the recordings
    state.
    """
    if len(effort) < _BRAKED:
        return None
    brake = int(np.argmin(command[2:, 0] - command[:-2, 0])) + 1
    others = np.delete(effort, 1, axis=1)
    for k in range(max(1, brake - _BRAKED), brake - 4):
        one, two = (np.abs(others[row] - others[k - 1]).max() for row in (k, k + 1))
        if one >= 4.0 and two >= 5.0:
            return k
    return None


def by_group(hits: Iterable[Hit]) -> Iterator[tuple[Group, list[Hit]]]:
    """Yield the groups of hits, posture 1 first, and in each posture the heavy box first."""
    listed = list(hits)
    for group in sorted({hit.group for hit in listed}, key=lambda group: (group.posture, -group.box)):
        yield group, [hit for hit in listed if hit.group == group]
