"""The result of a comparison, with one row for each source and quantity."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal

from impact_posture.verification.samples import Sample

Verdict = Literal["pass", "fail", "skipped"]

REFERENCE = "Pinocchio"


@dataclass(frozen=True)
class Row:
    """One quantity of one source, compared with the numbers of Pinocchio.

    Attributes:
        source: Name of the source.
        quantity: ``H``, ``G``, ``Λ_c``, ``∇H``, ``M`` or ``J``.
        verdict: ``skipped`` where this machine lacks the source.
        error: Largest relative error over all samples; ``None`` where there is none or it is not finite.
        tolerance: Largest relative error that passes.
        sample: Number of the sample with that error, from 0.
        entry: Entry of the quantity with that error; empty for a number.
        note: Reason of a skip or failure.
    """

    source: str
    quantity: str
    verdict: Verdict
    error: float | None = None
    tolerance: float | None = None
    sample: int | None = None
    entry: str = ""
    note: str = ""


@dataclass(frozen=True, eq=False)
class VerificationReport:
    """All sources side by side.

    Attributes:
        rows: The rows, in the order of the sources.
        samples: The samples.
        seed: The seed of the samples.
    """

    rows: tuple[Row, ...]
    samples: tuple[Sample, ...]
    seed: int

    @property
    def passed(self) -> bool:
        """Whether no row failed; skipped rows do not count."""
        return all(row.verdict != "fail" for row in self.rows)

    def to_dict(self) -> dict[str, object]:
        """Return the JSON content: verdict, rows, and the samples that rows name."""
        named = sorted({row.sample for row in self.rows if row.sample is not None})
        return {
            "passed": self.passed,
            "reference": REFERENCE,
            "seed": self.seed,
            "count": len(self.samples),
            "rows": [asdict(row) for row in self.rows],
            "samples": [
                {"sample": k, "q": self.samples[k].q.tolist(), "normal": self.samples[k].normal.tolist()}
                for k in named
            ],
        }
