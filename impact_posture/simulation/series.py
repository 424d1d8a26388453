"""What happened in a run, tick by tick."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from impact_posture.errors import SpecError

Array = NDArray[Any]

# S within which two times are one: sums of time steps are not exact.
_SAME = 1e-9
# S from the begin of an impact in which what was held back may come out again.
RECOVERY = 1.0


@dataclass(frozen=True, eq=False)
class Window:
    """A time that counts.

    Attributes:
        kind: ``impact``; ``dwell``, from the first touch until the reference leaves; or ``recovery``, from the
            impact's begin until :data:`RECOVERY` later, at most until the next approach begins or the run ends.
        contact: Which contact, or push, it belongs to, from 0.
        begin: s.
        end: s.
        touched: Whether the impact came; else the window begins where it was expected.
    """

    kind: str
    contact: int
    begin: float
    end: float
    touched: bool

    def to_dict(self) -> dict[str, object]:
        """JSON content."""
        return {name.name: getattr(self, name.name) for name in fields(self)}


@dataclass(frozen=True, eq=False)
class Series:
    """The truth of a run, n ticks; times and states are those at a tick's end, when its command has been executed.

    Attributes:
        t: s, shape (n,).
        q: Configuration, shape (n, nq).
        v: ν, shape (n, nv).
        torque: Joint torques as commanded, within the limits, shape (n, joints).
        rotor_command: Rotor speeds as commanded, within the limits, shape (n, rotors).
        rotor_speed: As they turn, shape (n, rotors).
        force: Of the surfaces on the shape that hits, or of the push, world, N, shape (n, 3).
        peak: Largest normal force on that shape within the tick, N, shape (n,).
        slip: Tangential speed of the shape, or of the fastest foot, where it touches, m/s, shape (n,).
        touching: Shapes that touch, shape (n,).
        feet: Whether each foot that is to stay touches, shape (n, feet).
        objective: H of the impact, shape (n,); NaN where it was not evaluated.
        level: Of the preparing term, shape (n,).
        status: Index into :data:`STATUSES`, shape (n,).
        at_stop: Whether a joint is at a position limit, shape (n, nv).
        reference: Distance of the reference along its way in, m, shape (n,); zero for pushes.
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

    def slice(self, begin: float, end: float) -> slice:
        """The ticks that lie in ``(begin, end]``, rounding of the times aside."""
        first, last = np.searchsorted(self.t, [begin + _SAME, end + _SAME], side="right")
        return slice(int(first), int(last))

    def save(self, path: Path, **more: Any) -> None:
        """Write as NPZ."""
        columns: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        np.savez_compressed(path, **columns, **more)

    @staticmethod
    def load(path: Path) -> Series:
        """Read what :meth:`save` wrote.

        Raises:
            SpecError: It cannot be read, or is something else.
        """
        try:
            with np.load(path, allow_pickle=False) as found:
                columns = {f.name: found[f.name] for f in fields(Series)}
            if len({column.shape[0] for column in columns.values()}) != 1:
                raise ValueError("columns of different lengths")
            return Series(**columns)
        except (OSError, ValueError, KeyError, TypeError, IndexError, EOFError, BadZipFile, zlib.error) as error:
            raise SpecError(f"is no time series ({error})", where=str(path), hint="run simulate again") from None
