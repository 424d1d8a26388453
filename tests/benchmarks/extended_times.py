"""What feet, cones and their like cost: a solve from one start, building it, and the exported gradient.

Run: python -m tests.benchmarks.extended_times [--starts 20] [--only NAME] [--write]
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from impact_posture.benchmark.measure import machine
from impact_posture.posture.nlp import PostureNLP, build_nlp, one_blas_thread
from impact_posture.posture.problem import PostureProblem
from impact_posture.posture.solve import run_start
from impact_posture.posture.starts import feasible_start
from impact_posture.toolchain import find_compiler
from tests.benchmarks.common import crba_time, default_problem
from tests.benchmarks.exported_feet import feet_table

PAGE = Path(__file__).parents[2] / "docs" / "generated" / "extended.md"


@dataclass(frozen=True)
class Case:
    """One problem.

    Attributes:
        name: What it is called in the table.
        robot: Its robot.
        frame: Contact frame; ``None`` where ``more`` has the contacts.
        normal: Contact normal, world; likewise.
        more: Further keys of ``problem.toml``.
        target_ms: What the project asks of one start, milliseconds; ``None`` where it asks nothing.
    """

    name: str
    robot: str
    frame: str | None
    normal: tuple[float, float, float] | None
    more: Mapping[str, object] = field(default_factory=dict)
    target_ms: float | None = None

    def problem(self) -> PostureProblem:
        """As ``impact-posture optimize`` poses it."""
        return default_problem(self.robot, self.frame, self.normal, **self.more)


DOWN, AHEAD, HAND = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), "gripper_right_base_link"
HANDS = ("gripper_left_base_link:-1,0,0", f"{HAND}:-1,0,0")
FEET, STANDING = ("FL_FOOT:0,0,1", "HR_FOOT:0,0,1"), ("FR_FOOT", "HL_FOOT")
MODELS: Mapping[str, object] = {"armature_range": (0.5, 2.0), "payload": (("ee", 0.3),)}
CASES = (
    Case("tilthex_arm, cone 5°", "tilthex_arm", "ee", DOWN, {"normal_cone": 5.0}, 10.0),
    Case("tilthex_arm, cone 20°", "tilthex_arm", "ee", DOWN, {"normal_cone": 20.0}, 10.0),
    Case("tilthex_arm, cone 45°", "tilthex_arm", "ee", DOWN, {"normal_cone": 45.0}, 10.0),
    Case("solo8, four feet", "solo8", "base_link", AHEAD, {}, 30.0),
    Case("solo8, four feet, cone 20°", "solo8", "base_link", AHEAD, {"normal_cone": 20.0}),
    Case("talos, two feet", "talos", HAND, AHEAD, {}, 150.0),
    Case("talos, two feet, cone 5°", "talos", HAND, AHEAD, {"normal_cone": 5.0}, 150.0),
    Case("talos, two feet, cone 20°", "talos", HAND, AHEAD, {"normal_cone": 20.0}, 150.0),
    Case("talos at the torso, two feet, cone 20°", "talos", "torso_2_link", AHEAD, {"normal_cone": 20.0}, 150.0),
    Case("talos, both hands", "talos", None, None, {"contact": HANDS}),
    Case("solo12, two feet struck", "solo12", None, None, {"contact": FEET, "support": STANDING}),
    Case("tilthex_arm, 6 models", "tilthex_arm", "ee", DOWN, MODELS),
    Case("talos, two feet, 3 models", "talos", HAND, AHEAD, {"armature_range": (0.5, 2.0)}),
)
_CRBA = 3
_COLUMNS = (
    "case|unknowns|way|build s|processor s|again s|solve ms|processor ms|× `crba`|iterations|certified|target ms"
)


@one_blas_thread()
def main() -> None:
    """Print the tables; with ``--write`` renew the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--starts", type=int, default=20, help="random feasible starts of each case")
    parser.add_argument("--only", default="", help="cases whose name has this in it")
    parser.add_argument("--write", action="store_true", help=f"write {PAGE.name} of the documentation")
    asked = parser.parse_args()
    if asked.write and asked.only:
        parser.error("--write is for all cases together: leave --only away")
    lines = [*_about(asked.starts), *_rows(asked.starts, asked.only), *([] if asked.only else feet_table())]
    page = "\n".join(lines)
    if asked.write:
        head = "<!-- Written by `python -m tests.benchmarks.extended_times --write`; do not edit. -->"
        PAGE.write_text(f"{head}\n\n{page}\n", encoding="utf-8")


def _about(starts: int) -> list[str]:
    about = machine()
    cores = f"{about['cores']} cores, load {about['load']}"
    found = [
        f"{about['processor']} ({about['architecture']}), {cores}; {about['compiler']}; CasADi {about['casadi']}, "
        f"Pinocchio {about['pinocchio']}; medians of {starts} random feasible starts, one at a time; "
        "× `crba` is of processor time. `again`: with the cache that the first build filled.",
        "",
        f"| {_COLUMNS.replace('|', ' | ')} |",
        "|---" * len(_COLUMNS.split("|")) + "|",
    ]
    print("\n".join(found), flush=True)
    return found


def _rows(count: int, only: str) -> Iterator[str]:
    for case in CASES:
        if only in case.name:
            problem = case.problem()
            starts = [feasible_start(problem, k, seed=1) for k in range(1, 4 * count)]
            usable = [start for start in starts if start is not None][:count]
            for way in ("interpreted", "compiled") if find_compiler() else ("interpreted",):
                yield _row(case, problem, usable, way)


def _row(case: Case, problem: PostureProblem, starts: list[np.ndarray], way: str) -> str:
    with tempfile.TemporaryDirectory() as folder:
        os.environ["IMPACT_POSTURE_CACHE"] = folder
        nlp, cold, busy_building = _built(problem, way)
        nlp, again, _ = _built(problem, way)
    scale = problem.objective.value(problem.given)
    runs = [run_start(nlp, start, scale) for start in starts]
    wall, busy = (statistics.median(getattr(record, what) for record, _ in runs) for what in ("time_s", "cpu_s"))
    crba = min(crba_time(problem.robot.model) for _ in range(_CRBA))
    row = [
        case.name,
        str(nlp.size),
        way,
        f"{cold:.1f}",
        f"{busy_building:.1f}",
        f"{again:.2f}",
        f"{wall * 1e3:.1f}",
        f"{busy * 1e3:.1f}",
        f"{busy / crba:.0f}",
        f"{statistics.median(record.iterations for record, _ in runs):.0f}",
        f"{sum(certificate.holds() for _, certificate in runs)}/{len(runs)}",
        "–" if case.target_ms is None else f"{case.target_ms:g}",
    ]
    text = f"| {' | '.join(row)} |"
    print(text, flush=True)
    return text


def _built(problem: PostureProblem, way: str) -> tuple[PostureNLP, float, float]:
    """The program, and wall and processor seconds, the compiler's with them."""
    began, busy = time.perf_counter(), sum(os.times()[:4])
    nlp = build_nlp(problem, compile="never" if way == "interpreted" else "always")
    return nlp, time.perf_counter() - began, sum(os.times()[:4]) - busy


if __name__ == "__main__":
    main()
