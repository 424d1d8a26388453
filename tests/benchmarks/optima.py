"""Do 16 starts find what many find?"""

from __future__ import annotations

from collections.abc import Iterator

from impact_posture.posture.solve import solve
from tests.benchmarks.cases import CASES
from tests.benchmarks.core import Request, machine, table

_CASES = ("tilthex_arm", "tilthex_arm, ahead", "panda", "talos, two feet", "tilthex_arm, cone 5°",
          "tilthex_arm, cone 20°", "talos, two feet, cone 20°")  # fmt: skip


def lines(request: Request) -> Iterator[str]:
    """A row a case: the best objective of 16 starts over the best of many."""
    yield from (machine(), "")
    rows = ([name, _above(name, request.count)] for name in _CASES if request.only in name)
    yield from table(["case", f"best of 16 above the best of {request.count}"], rows)


def _above(name: str, many: int) -> str:
    problem = CASES[name].problem()
    found = (solve(problem, starts=16), solve(problem, starts=many, seed=7, compile="never"))
    few, best = (min(optimum.objective for optimum in solution.optima) for solution in found)
    return f"{few / best - 1:+.2%}"
