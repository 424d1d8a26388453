"""Where does each controller help?  Random variations of the shipped experiments, every controller in each.

Each configuration that is done stays in build/robustness; a run that was interrupted goes on from there.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from impact_posture.dynamics.mjcf import import_mujoco
from impact_posture.processes import fork_map
from tests.benchmarks.core import ROOT, Request, machine, say
from tests.benchmarks.robustness.draws import RANGES
from tests.benchmarks.robustness.outcomes import NotAdmissible, Record, configuration
from tests.benchmarks.robustness.page import page


def lines(request: Request) -> Iterator[str]:
    """The page, once all configurations are there; or one configuration, run anew."""
    import_mujoco()
    scenarios = [name for name in RANGES if request.only in name]
    began = time.perf_counter()
    try:
        if request.number is not None:
            yield from (configuration(name, request.number, request.seed).to_json() for name in scenarios)
            return
        store = Store(ROOT / "build" / "robustness", request.seed)
        records = study(scenarios, request.count, request.seed, request.jobs, store)
    except NotAdmissible as error:
        raise SystemExit(str(error)) from None
    yield from page(records, request.seed)
    say(f"{machine('mujoco')}; {time.perf_counter() - began:.0f} s")


def study(
    scenarios: Sequence[str],
    configurations: int,
    seed: int,
    jobs: int,
    store: Store,
    run: Callable[[str, int, int], Record] = configuration,
    tell: Callable[[str], None] = say,
) -> dict[str, list[Record]]:
    """Run the configurations that the store lacks; all of them, by scenario."""
    # By number first: a study that is cut short has as many of each scenario.
    wanted = [(name, number) for number in range(configurations) for name in scenarios]
    missing = [each for each in wanted if store.get(*each) is None]

    def one(index: int) -> str:
        name, number = missing[index]
        began = time.perf_counter()
        # Kept by the process that ran it: nothing that is done is lost when the others are stopped.
        store.keep(run(name, number, seed))
        return f"{name} {number}: {time.perf_counter() - began:.0f} s"

    with fork_map(one, len(missing), jobs) as done:
        for count, (_, words) in enumerate(done, 1):
            tell(f"{count}/{len(missing)} {words}")
    found = [store.get(*each) for each in wanted]
    return {name: [r for r in found if r is not None and r.draw.scenario == name] for name in scenarios}


class Store:
    """Finished configurations of a study, a file each: an interrupted study goes on where it was."""

    def __init__(self, folder: Path, seed: int) -> None:
        self._folder, self._seed = folder, seed

    def _file(self, scenario: str, number: int) -> Path:
        return self._folder / f"seed-{self._seed}" / scenario / f"{number:03d}.json"

    def get(self, scenario: str, number: int) -> Record | None:
        """What was kept of a configuration, if it still holds."""
        file = self._file(scenario, number)
        return Record.from_json(file.read_text(encoding="utf-8")) if file.is_file() else None

    def keep(self, record: Record) -> None:
        """Write it down, whole or not at all."""
        file = self._file(record.draw.scenario, record.draw.number)
        file.parent.mkdir(parents=True, exist_ok=True)
        beside = file.with_suffix(f".{os.getpid()}")
        beside.write_text(record.to_json() + "\n", encoding="utf-8")
        beside.replace(file)
