"""Where does each controller help?  Random variations of the shipped experiments, every controller in each.

Run: make study-robustness, or
python -m tests.benchmarks.robustness_study [--scenarios NAME …] [--configurations 40] [--seed 0] [--jobs 2] [--write]

Each configuration that is done stays in the --work folder; a run that was interrupted goes on from there.  One
configuration alone: --scenarios NAME --configuration N.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from impact_posture.dynamics.mjcf import import_mujoco
from impact_posture.errors import ImpactPostureError
from impact_posture.processes import fork_map
from tests.benchmarks.common import machine
from tests.benchmarks.robustness.draws import RANGES
from tests.benchmarks.robustness.outcomes import NotAdmissible, Record, Store, configuration
from tests.benchmarks.robustness.tables import page

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "generated" / "robustness.md"
WORK = ROOT / "build" / "robustness"
HEAD = "<!-- Written by `make study-robustness`; do not edit. -->"


def main() -> int:
    """Run what is not done yet and print the tables; with ``--write`` also leave them for the documentation."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenarios", nargs="+", choices=list(RANGES), default=list(RANGES))
    parser.add_argument("--configurations", type=int, default=40, help="of each scenario")
    parser.add_argument("--configuration", type=int, help="print this one alone, run anew")
    parser.add_argument("--seed", type=int, default=0, help="of the draws")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--work", type=Path, default=WORK, help="where finished configurations are kept")
    parser.add_argument("--write", action="store_true", help=f"also write {PAGE.name} of the documentation")
    args = parser.parse_args()
    if args.configurations < 1:
        parser.error("--configurations: at least one")
    if args.write and set(args.scenarios) != set(RANGES):
        parser.error("--write is for all scenarios together: leave --scenarios away")
    try:
        version = import_mujoco().__version__
        if args.configuration is not None:
            for name in args.scenarios:
                print(configuration(name, args.configuration, args.seed).to_json())
            return 0
        began = time.perf_counter()
        store = Store(args.work, args.seed)
        records = study(args.scenarios, args.configurations, args.seed, args.jobs, store, say=_say)
    except (ImpactPostureError, NotAdmissible) as error:
        print(error, file=sys.stderr)
        return 1
    text = page(records, args.seed)
    print(text)
    print(f"{machine()}, MuJoCo {version}; {time.perf_counter() - began:.0f} s")
    if args.write:
        PAGE.write_text(f"{HEAD}\n\n{text}", encoding="utf-8")
    return 0


def _say(words: str) -> None:
    print(words, file=sys.stderr, flush=True)


def study(
    scenarios: Sequence[str],
    configurations: int,
    seed: int,
    jobs: int,
    store: Store,
    *,
    run: Callable[[str, int, int], Record] = configuration,
    say: Callable[[str], None] = lambda words: None,
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
            say(f"{count}/{len(missing)} {words}")
    found: dict[str, list[Record]] = {name: [] for name in scenarios}
    for name, number in wanted:
        record = store.get(name, number)
        if record is not None:
            found[name].append(record)
    return found


if __name__ == "__main__":
    sys.exit(main())
