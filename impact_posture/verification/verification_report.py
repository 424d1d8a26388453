"""What a comparison found: one row for each way and quantity."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from impact_posture.verification.samples import Sample

Vector = NDArray[np.float64]
Verdict = Literal["pass", "fail", "skipped"]

REFERENCE = "Pinocchio"


@dataclass(frozen=True)
class Row:
    """One quantity computed one way, against Pinocchio's numbers.

    Attributes:
        source: The way.
        quantity: ``H``, ``G``, ``Λ_c``, ``∇H``, ``M`` or ``J``.
        verdict: ``skipped`` where the way is not to be had here.
        tolerance: Largest relative error that passes.
        error: Largest relative error over all samples; ``None`` where there is none or it is not finite.
        sample: Number of the sample where it occurred, from 0.
        entry: The entry of the quantity where it occurred; empty for a number.
        note: Why it was skipped, or what failed.
    """

    source: str
    quantity: str
    verdict: Verdict
    tolerance: float | None = None
    error: float | None = None
    sample: int | None = None
    entry: str = ""
    note: str = ""

    def to_dict(self) -> dict[str, object]:
        """JSON content."""
        return {
            "source": self.source,
            "quantity": self.quantity,
            "verdict": self.verdict,
            "error": self.error,
            "tolerance": self.tolerance,
            "sample": self.sample,
            "entry": self.entry,
            "note": self.note,
        }


@dataclass(frozen=True, eq=False)
class VerificationReport:
    """All ways side by side.

    Attributes:
        rows: In the order of the ways.
        samples: Where they were compared.
        seed: That the samples came from.
    """

    rows: tuple[Row, ...]
    samples: tuple[Sample, ...]
    seed: int

    @property
    def passed(self) -> bool:
        """Whether no row failed; rows that were skipped do not count."""
        return all(row.verdict != "fail" for row in self.rows)

    def to_dict(self) -> dict[str, object]:
        """JSON content: verdict, rows, and the samples that rows name."""
        named = sorted({row.sample for row in self.rows if row.sample is not None})
        return {
            "passed": self.passed,
            "reference": REFERENCE,
            "seed": self.seed,
            "count": len(self.samples),
            "rows": [row.to_dict() for row in self.rows],
            "samples": [
                {"sample": k, "q": self.samples[k].q.tolist(), "normal": self.samples[k].normal.tolist()}
                for k in named
            ],
        }


@dataclass(frozen=True)
class Deviation:
    """The largest relative error of one quantity at one sample.

    Attributes:
        error: Largest ``|found − expected|`` over the scale; infinite where a number is not finite.
        index: The entry where it occurred.
    """

    error: float
    index: tuple[int, ...]


def deviation(found: Vector, expected: Vector, scale: float = 0.0) -> Deviation:
    """Largest deviation over the largest expected entry, or over ``scale`` if that is larger."""
    difference = np.abs(found - expected)
    difference[~np.isfinite(difference)] = np.inf
    index = tuple(int(k) for k in np.unravel_index(int(np.argmax(difference)), difference.shape))
    largest, size = float(difference[index]), max(float(np.abs(expected).max()), scale)
    return Deviation(largest / size if size > 0 else (np.inf if largest > 0 else 0.0), index)
