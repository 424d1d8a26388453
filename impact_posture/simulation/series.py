"""Time series of a run, and its windows."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from impact_posture.errors import SpecError
from impact_posture.system.npz_files import read_arrays
from impact_posture.tsid.controller import Status

Array = NDArray[Any]
Flags = NDArray[np.bool_]

STATUSES: tuple[Status, ...] = tuple(Status)
# Times that differ by less count as equal, because sums of time steps are not exact, s.
SAME = 1e-9
# Length of the recovery from the begin of an impact, in which a delayed motion may appear, s.
RECOVERY = 1.0


@dataclass(frozen=True, eq=False)
class Window:
    """Time window of a run.

    Attributes:
        kind: ``impact``, ``dwell`` (from the first touch until the reference leaves), or ``recovery`` (until
            :data:`RECOVERY` after the begin of the impact, the next approach, or the end of the run).
        contact: Number of the contact or push, from 0.
        begin: Begin, s.
        end: End, s.
        touched: Whether the impact happened.  If not, the window begins at the expected time.
    """

    kind: str
    contact: int
    begin: float
    end: float
    touched: bool


@dataclass(frozen=True, eq=False)
class Series:
    """True states at the end of each of the n ticks of a run, after the command of the tick.

    Attributes:
        t: Time, s, shape (n,).
        q: Configuration, shape (n, nq).
        v: ν, shape (n, nv).
        torque: Commanded joint torques, within the limits, shape (n, joints).
        rotor_command: Commanded rotor speeds, within the limits, shape (n, rotors).
        rotor_speed: True rotor speeds, shape (n, rotors).
        force: Force on the shape of the task, or of the push, world, N, shape (n, 3).
        peak: Largest normal force on this shape within the tick, N, shape (n,).
        slip: Tangential speed of this shape, or of the fastest foot, in contact, m/s, shape (n,).
        touching: Number of shapes in contact, shape (n,).
        feet: Whether each supporting foot is in contact, shape (n, feet).
        objective: H of the impact, shape (n,), NaN in ticks without an evaluation.
        level: Level of the term that prepares for the impact, shape (n,).
        status: Index into :data:`STATUSES`, shape (n,).
        at_stop: Whether a joint is at a position limit, shape (n, nv).
        reference: Distance of the reference along its approach, m, shape (n,), zero for pushes.
    """

    t: Array
    q: Array
    v: Array
    torque: Array
    rotor_command: Array
    rotor_speed: Array
    force: Array
    peak: Array
    slip: Array
    touching: Array
    feet: Array
    objective: Array
    level: Array
    status: Array
    at_stop: Array
    reference: Array

    @property
    def relaxed(self) -> Flags:
        """Ticks in which a level gave way, shape (n,)."""
        return np.asarray(self.status == STATUSES.index(Status.RELAXED))

    @property
    def held(self) -> Flags:
        """Ticks without a new command, which held the last one, shape (n,)."""
        return np.asarray(~self.relaxed & (self.status != STATUSES.index(Status.SOLVED)))

    def slice(self, begin: float, end: float) -> slice:
        """Return the ticks in ``(begin, end]``, except for rounding of the times."""
        first, last = np.searchsorted(self.t, [begin + SAME, end + SAME], side="right")
        return slice(int(first), int(last))

    def save(self, file: Path | BinaryIO) -> None:
        """Write as NPZ."""
        np.savez_compressed(file, **vars(self))

    @staticmethod
    def load(path: Path) -> Series:
        """Read a file of :meth:`save`.

        Raises:
            SpecError: The file cannot be read, or is not a time series.
        """
        try:
            arrays = read_arrays(path)
            columns = {f.name: arrays[f.name] for f in fields(Series)}
            if len({column.shape[0] for column in columns.values()}) != 1:
                raise ValueError("columns of different lengths")
            return Series(**columns)
        except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
            raise SpecError(f"is not a time series ({error})", where=str(path), hint="run simulate again") from None
