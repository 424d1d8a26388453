"""Time of exported H and ∇H: with and without the supports of a robot, and called from Python."""

from __future__ import annotations

import ctypes
import tempfile
from collections.abc import Iterator
from pathlib import Path

from docs.studies.build import Built
from docs.studies.cases import CASES
from docs.studies.core import Request, machine, median_time, one_core, table
from docs.studies.kernel.harness import COUNT, Harness, Kernel, Samples
from docs.studies.kernel.peers import exported
from impact_posture.codegen.export import export
from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.system.libraries import library_path

# Robots with feet on the ground, and the goal for the time with supports and without supports, µs.
_FEET = {"solo8, four feet": "–", "solo12": "–", "g1": "–", "talos, two feet": "2.5"}
_LOADED = ("tilthex_arm", "solo8, four feet", "panda")
_ROUNDS = 61


def feet(request: Request) -> Iterator[str]:
    rows = (row for name, target in _FEET.items() if request.only in name for row in _standing(name, target))
    yield from table(["exported H and ∇H", "made by", "standing µs", "free µs", "ratio", "target"], rows)


def _standing(name: str, target: str) -> Iterator[list[str]]:
    objective = CASES[name].problem().objective
    harness = Harness(Samples(objective.robot, objective.contact.frame))
    for label, built in exported(objective, "feet")[0]:
        both = [Kernel(n, "ours", built, {"eval": built.symbol(n)}) for n in ("feet_eval", "feet_free_eval")]
        standing, free = (times["eval"] for times in harness.times(both, _ROUNDS))
        yield [objective.robot.name, label, f"{standing:.3f}", f"{free:.3f}", f"{standing / free:.2f}", target]


def loader(request: Request) -> Iterator[str]:
    """Yield a row for each robot: time of a call from Python, time of the same call from C, and the difference."""
    yield from (machine(), "")
    rows = (_loaded(name, request.count) for name in _LOADED if request.only in name)
    yield from table(["robot", "call from Python, µs", "from C", "above"], rows)


def _loaded(name: str, passes: int) -> list[str]:
    objective = CASES[name].problem().objective
    samples = Samples(objective.robot, objective.contact.frame)
    with tempfile.TemporaryDirectory() as folder:
        export(objective, Path(folder), check=False)
        gradient = ImpactGradient.load(Path(folder))
        prefix = str(gradient.manifest["prefix"])
        # Load the library that the loader calls.
        built = Built(ctypes.CDLL(str(library_path(Path(folder), prefix))), "", 0.0)
        kernel = Kernel(prefix, "ours", built, {"eval": built.symbol(f"{prefix}_eval")})
        pairs = list(zip(*samples.drawn, strict=True))
        with one_core():
            call = median_time(lambda: [gradient.value_and_gradient(q, n) for q, n in pairs], passes) / COUNT * 1e6
        alone = Harness(samples).times([kernel], passes)[0]["eval"]
    return [objective.robot.name, f"{call:.2f}", f"{alone:.2f}", f"{call - alone:.2f}"]
