"""Time series of a run, and time windows of a run."""

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
# Times that differ by less than this are treated as equal, because sums of time steps have rounding errors, s.
SAME = 1e-9
# Maximum duration of the recovery window, s.  The window starts with the impact and is long enough for delayed
# motions.
RECOVERY = 1.0


@dataclass(frozen=True, eq=False)
class Window:
    """Time window of a run.

    Attributes:
        kind: ``impact``, ``dwell`` or ``recovery``.  All windows start at the first touch.  A dwell window ends when
            the reference leaves the surface.  A recovery window ends after :data:`RECOVERY`, at the next approach, or
            at the end of the run.
        contact: Number of the contact or push, starting at 0.
        begin: Start of the window, s.
        end: End of the window, s.
        touched: Whether the impact happened.  Without an impact, the window begins at the expected time of the
            impact.
        landing: Time from ``begin`` until each of several contacts has touched for the first time, s.  Only touches
            within an impact window count.  The time is zero for a single contact.
    """

    kind: str
    contact: int
    begin: float
    end: float
    touched: bool
    landing: float = 0.0


@dataclass(frozen=True, eq=False)
class Series:
    """Time series of the n ticks of a run, recorded at the end of each tick.

    Attributes:
        t: Time, s, shape (n,).
        q: True configuration, shape (n, nq).
        v: True generalized velocity ν, shape (n, nv).
        torque: Commanded joint torques after clipping to the limits, shape (n, joints).
        rotor_command: Commanded rotor speeds after clipping to the limits, shape (n, rotors).
        rotor_speed: True rotor speeds, shape (n, rotors).
        force: Force on the shape of the task, or force of the push, world, N, shape (n, 3).
        peak: Largest normal force on the shape of the task within the tick, N, shape (n,).
        impulse: Impulse of ``force`` since the start, world, N·s, shape (n, 3); NaN in files of older versions.
        slip: Sliding speed of the shape of the task, m/s, shape (n,).  For pushes: sliding speed of the fastest foot.
        touching: Number of shapes in contact, shape (n,).
        feet: Whether each supporting foot is in contact, shape (n, feet).
        objective: H of the impact, shape (n,); NaN in ticks in which H was not evaluated.
        level: Activation level with which the controller prepares for an impact, 0 to 1, shape (n,).
        status: Status of the controller as an index into :data:`STATUSES`, shape (n,).
        at_stop: Whether each joint is at a position limit, shape (n, nv).
        reference: Distance of the reference along its approach, m, shape (n,); zero for pushes.
    """

    t: Array
    q: Array
    v: Array
    torque: Array
    rotor_command: Array
    rotor_speed: Array
    force: Array
    peak: Array
    impulse: Array
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
        """Whether the controller relaxed a strict level, for each tick, shape (n,)."""
        return np.asarray(self.status == STATUSES.index(Status.RELAXED))

    @property
    def held(self) -> Flags:
        """Whether the controller repeated the last command, for each tick, shape (n,)."""
        return np.asarray(~self.relaxed & (self.status != STATUSES.index(Status.SOLVED)))

    def slice(self, begin: float, end: float) -> slice:
        """Return the slice of the ticks with times in ``(begin, end]``, up to rounding errors."""
        first, last = np.searchsorted(self.t, [begin + SAME, end + SAME], side="right")
        return slice(int(first), int(last))

    def save(self, file: Path | BinaryIO) -> None:
        """Write the time series to an NPZ file."""
        np.savez_compressed(file, **vars(self))

    @staticmethod
    def load(path: Path) -> Series:
        """Read a file that :meth:`save` has written.

        Raises:
            SpecError: The file cannot be read or does not contain a time series.
        """
        try:
            arrays = read_arrays(path)
            arrays.setdefault("impulse", np.full((len(arrays["t"]), 3), np.nan))
            columns = {f.name: arrays[f.name] for f in fields(Series)}
            if len({column.shape[0] for column in columns.values()}) != 1:
                raise ValueError("columns of different lengths")
            return Series(**columns)
        except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
            raise SpecError(f"is not a time series ({error})", where=str(path), hint="run simulate again") from None
