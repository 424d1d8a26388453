"""Run every controller in variations of the shipped experiments, to measure where each controller helps.

Finished points are stored in build/robustness, so that an interrupted study can continue.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from docs.studies.core import ROOT, Request, machine, say
from docs.studies.robustness import envelope, page
from docs.studies.robustness.outcomes import NotAdmissible, Record, is_complete, point
from docs.studies.robustness.variations import RANGES, VARIATIONS
from impact_posture.posture.program.ipopt import one_blas_thread
from impact_posture.system.optional_package import import_mujoco
from impact_posture.system.processes import fork_map


def points(request: Request) -> Iterator[str]:
    """Run the points that are not stored yet, or repeat one point."""
    import_mujoco()
    # Use a separate cache, because every armature and mounting needs new libraries.
    os.environ["IMPACT_POSTURE_CACHE"] = str(ROOT / "build" / "robustness" / "cache")
    scenarios = [name for name in RANGES if request.only in name]
    began = time.perf_counter()
    try:
        if request.number is not None:
            yield from (point(name, request.number, request.seed).to_json() for name in scenarios)
            return
        wanted = {name: len(VARIATIONS[name]) + request.count for name in scenarios}
        study(wanted, request.seed, request.jobs, _store(request))
    except NotAdmissible as error:
        raise SystemExit(str(error)) from None
    kept = _store(request).complete(scenarios)
    yield ", ".join(f"{name}: {len(own)} points" for name, own in kept.items())
    say(f"{machine('mujoco')}; {time.perf_counter() - began:.0f} s")


def lines(request: Request) -> Iterator[str]:
    """Yield the page about where controllers help, computed from the stored points."""
    yield from page.page(_store(request).complete([n for n in RANGES if request.only in n]), request.seed)


def kept_targets(request: Request) -> Iterator[str]:
    """Yield the page about the targets that controllers meet, computed from the stored points."""
    yield from envelope.page(_store(request).complete([n for n in RANGES if request.only in n]))


def _store(request: Request) -> Store:
    return Store(ROOT / "build" / "robustness", request.seed)


def study(
    points: dict[str, int],
    seed: int,
    jobs: int,
    store: Store,
    run: Callable[..., Record] = point,
    tell: Callable[[str], None] = say,
) -> None:
    """Run the points that are missing in the store.

    All controllers run at a point before the next point begins, so an interrupted study has the same points for all
    controllers.  Successive points belong to different scenarios.
    """
    wanted = [(name, number) for number in range(max(points.values())) for name in points if number < points[name]]
    missing = [each for each in wanted if not is_complete(store.get(*each))]

    def one(index: int) -> str:
        name, number = missing[index]
        began = time.process_time()
        # Each worker process stores its records itself, so that an interruption loses only unfinished points.
        with one_blas_thread():
            store.keep(run(name, number, seed, store.get(name, number)))
        return f"{name} {number}: {time.process_time() - began:.0f} s"

    with fork_map(one, len(missing), jobs) as done:
        for count, (_, words) in enumerate(done, 1):
            tell(f"{count}/{len(missing)} {words}")


class Store:
    """Finished points of a study, one file each."""

    def __init__(self, folder: Path, seed: int) -> None:
        self._folder, self._seed = folder, seed

    def _file(self, scenario: str, number: int) -> Path:
        return self._folder / f"seed-{self._seed}" / scenario / f"{number:03d}.json"

    def get(self, scenario: str, number: int) -> Record | None:
        """Return the record of a point, or ``None`` if it is missing or outdated."""
        file = self._file(scenario, number)
        return Record.from_json(file.read_text(encoding="utf-8")) if file.is_file() else None

    def keep(self, record: Record) -> None:
        """Write a record to its file completely or not at all."""
        file = self._file(record.draw.scenario, record.draw.number)
        file.parent.mkdir(parents=True, exist_ok=True)
        beside = file.with_suffix(f".{os.getpid()}")
        beside.write_text(record.to_json() + "\n", encoding="utf-8")
        beside.replace(file)

    def complete(self, scenarios: Sequence[str]) -> dict[str, list[Record]]:
        """Return the points of each scenario before the first incomplete point."""
        records: dict[str, list[Record]] = {}
        for name in scenarios:
            records[name] = []
            while is_complete(record := self.get(name, len(records[name]))):
                assert record is not None
                records[name].append(record)
        return records
