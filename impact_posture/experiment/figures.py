"""From runs to the pictures of :mod:`impact_posture.plot`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from impact_posture.experiment.jobs import Job
from impact_posture.experiment.many import Store
from impact_posture.experiment.reproduction import Reproduction
from impact_posture.simulation.runs import Run


def draw_runs(job: Job, runs: Sequence[Run], folder: Path, formats: Sequence[str]) -> None:
    """Figures of one job."""


def draw_side_by_side(jobs: Sequence[Job], store: Store, folder: Path, formats: Sequence[str]) -> None:
    """Figures of several controllers in one scenario."""


def draw_reproduction(
    found: Reproduction, jobs: Sequence[Job], store: Store, folder: Path, formats: Sequence[str]
) -> None:
    """Figures of a reproduction."""
