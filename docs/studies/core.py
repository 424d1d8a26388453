"""Functions that studies share, and the list of all studies."""

from __future__ import annotations

import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from docs.studies.build import compiler_version, processor
from impact_posture.posture.manifold.feasible_start import feasible_start
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.system.processes import fork_map
from impact_posture.system.toolchain import find_compiler

Vector = NDArray[np.float64]
_T = TypeVar("_T")

ROOT = Path(__file__).parents[2]
CRBA_CALLS = 2000


@dataclass(frozen=True)
class Study:
    """Study with a name, a description, and the generator of its results.

    ``source`` is a module in this folder with the generator ``lines(request)``, or ``module:name`` of the generator.
    """

    name: str
    source: str
    about: str
    count: int = 1
    page: bool = True
    target: str = ""  # target of make that writes the page
    parts: bool = False  # whether the page has a section ### for each case, so that some cases can be renewed

    def lines(self, request: Request) -> Iterator[str]:
        """Run the study and yield its results as lines of text."""
        module, _, function = self.source.partition(":")
        return getattr(import_module(f"docs.studies.{module}"), function or "lines")(request)

    @property
    def head(self) -> str:
        """First line of the page of the study."""
        command = f"make {self.target}" if self.target else f"python -m docs.studies {self.name} --write"
        return f"<!-- Written by `{command}`; do not edit. -->"


STUDIES = {
    study.name: study
    for study in (
        Study("solve", "solve", "solve and build times, and the exported gradient with feet; random starts", 20),
        Study("answer", "answer", "time of optimize until answer and end, or of another version", 5, page=False),
        Study("formulations", "formulations", "impact equations as constraints or in the objective", 12, page=False),
        Study("kernel", "kernel.times", "H and ∇H: our code, Pinocchio C++, ADAM and CasADi; passes", 101),
        Study("gpu", "gpu.study", "H and ∇H on a GPU and on all cores; calls from CuPy, PyTorch and JAX; frax"),
        Study("loader", "exported:loader", "a call of exported code from Python; passes", 100, page=False),
        Study("tsid", "tsid", "a tick of the online controllers; ticks", 2000),
        Study("relaxed", "relaxed", "relaxed ticks in C of pushed robots; budget of iterations", 100, page=False),
        Study("digits", "digits", "the digits that double precision keeps with feet; random postures", 3),
        Study("fronts", "fronts", "where the default contact frames of the catalogue touch"),
        Study("shapes", "shapes", "the collision shapes of the catalogue, fitted again"),
        Study("feasible", "feasible", "what feasibility costs; seeds", 3, target="study-feasible"),
        Study("approach", "approach", "speed that robots can reach in optimal postures", target="study-feasible"),
        Study("restitution", "restitution", "rebound of each contact law", target="calibration"),
        Study("impacts", "impact.page", "objectives, and impacts in MuJoCo; postures", 30, target="study-impacts"),
        Study("elastic", "elastic.study", "arms with elastic joints in MuJoCo; postures", 20, target="study-elastic"),
        Study("hits", "hits.study", "recorded hits of an iiwa 7, predicted; resamples", 200, target="study-hits"),
        Study("global", "global_search:maps", "self-motions and their bounds; seeds", 10, target="study-global"),
        Study("search", "search_quality", "the default search and 16 starts; seeds", 3, target="study-global"),
        Study(
            "screening", "random_postures", "random postures of talos; postures", 100_000_000, target="study-global"
        ),
        Study("draws", "random_postures:command", "exports to draw for screening; postures", 100_000_000, page=False),
        Study("flow", "flow", "where the reference flow rests, from random starts", 1000, target="study-flow"),
        Study("strikes", "strikes", "planned strikes; seeds", 10, target="study-strikes", parts=True),
        Study("landing", "strikes:landing", "a fall onto four feet; seeds", 10, target="study-strikes", parts=True),
        Study("strike-instants", "strikes:instants", "early and late contacts of strikes", target="study-strikes"),
        Study("real-impacts", "real_impacts", "predicted balls, strikes and taps", target="study-real-impacts"),
        Study("points", "robustness.study:points", "runs for robustness, envelope; random draws", 40, page=False),
        Study("robustness", "robustness.study", "where each controller helps", target="study-robustness"),
        Study("envelope", "robustness.study:kept_targets", "targets that are kept", target="study-robustness"),
        Study(
            "verdict",
            "verdict.page",
            "numbers of the verdict, compared with simulated impacts; starts",
            4,
            target="study-verdict",
        ),
        Study("scan", "scan", "a scan along the redundancy; postures of each robot", 11, target="study-scan"),
        Study("robots", "robots", "all models at hand, from file to posture; starts", 4, target="study-robots"),
        Study("reproduction", "reproduction", "the experiments of the paper; seeds", 10, target="reproduction"),
    )
}


@dataclass(frozen=True)
class Request:
    """Options from the command line.  A study adds the goals that it misses to ``missed``."""

    only: str = ""
    count: int = 1
    seed: int = 0
    number: int | None = None
    jobs: int = 1
    write: bool = False
    against: str = ""
    data: str = ""
    missed: list[str] = field(default_factory=list)


def page_of(name: str) -> Path:
    return ROOT / "docs" / "generated" / f"{name}.md"


def renewed(page: str, text: str) -> str:
    """Return a page with its sections ``### …`` replaced or followed by the sections of another text.

    Raise ``ValueError`` if the text above the sections differs, for example because of another number of seeds.
    """
    (above, *old), (intro, *new) = (("\n" + part).strip("\n").split("\n### ") for part in (page, text))
    if above.rstrip() != intro.rstrip():
        raise ValueError("the text above the sections differs from the page: renew all cases")
    sections = {section.splitlines()[0]: section.rstrip() for section in (*old, *new)}
    return "\n\n### ".join([above.rstrip(), *sections.values()]) + "\n"


def say(words: str, end: str = "\n") -> None:
    print(words, end=end, file=sys.stderr, flush=True)


def collected(work: Callable[[int], _T], count: int, jobs: int, what: str) -> list[_T]:
    """Compute ``work(0)`` to ``work(count - 1)`` in several processes, print progress, and return the results."""
    results_by_index: dict[int, _T] = {}
    with fork_map(work, count, jobs) as results:
        for index, result in results:
            results_by_index[index] = result
            say(f"\r{what}: {len(results_by_index)} of {count}", end="")
    say("")
    return [results_by_index[k] for k in range(count)]


def kept(file: Path, compute: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return the JSON content of a file, which is computed and written if the file does not exist."""
    if not file.is_file():
        content = compute()
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(content), encoding="utf-8")
    return dict(json.loads(file.read_text(encoding="utf-8")))


def table(head: Sequence[str], rows: Iterator[Sequence[str]] | Sequence[Sequence[str]]) -> Iterator[str]:
    """Yield the lines of a Markdown table.  Each line appears as soon as its row is computed."""
    yield f"| {' | '.join(head)} |"
    yield "|" + "---|" * len(head)
    yield from (f"| {' | '.join(row)} |" for row in rows)


def cell(value: float | None, digits: int) -> str:
    """Write a number for a table cell."""
    return "–" if value is None else f"{value:.{digits}f}"


def machine(*packages: str) -> str:
    """Describe processor, compiler and versions of packages."""
    compiler = find_compiler()
    versions = ", ".join(f"{name} {version(name)}" for name in ("casadi", "pin", "numpy", *packages))
    return (
        f"{processor()['name']} ({platform.machine()}), {os.cpu_count()} cores, load {os.getloadavg()[0]:.2f}; "
        f"{compiler_version(compiler) if compiler else 'no compiler'}; Python {platform.python_version()}, {versions}"
    )


@contextmanager
def one_core() -> Iterator[None]:
    """Keep this process on one core if the system can."""
    allowed = os.sched_getaffinity(0) if hasattr(os, "sched_setaffinity") else set()
    if allowed:
        os.sched_setaffinity(0, {max(allowed)})
    try:
        yield
    finally:
        if allowed:
            os.sched_setaffinity(0, allowed)


def median_time(call: Callable[[], object], repeats: int) -> float:
    """Return the median processor time of a call, s.  Unlike wall time, it excludes the time of other programs."""
    times = []
    for _ in range(repeats):
        began = time.thread_time()
        call()
        times.append(time.thread_time() - began)
    return statistics.median(times)


def crba_time(model: pin.Model) -> float:
    """Return the median processor time of Pinocchio ``crba``, s, as a measure of the speed of this machine."""
    data, q = model.createData(), pin.randomConfiguration(model, -np.ones(model.nq), np.ones(model.nq))
    return median_time(lambda: pin.crba(model, data, q), CRBA_CALLS)


def feasible_starts(problem: ConstrainedProblem, count: int, seed: int) -> list[Vector]:
    """Draw random postures, and return the first ``count`` feasible postures."""
    starts = (feasible_start(problem, index, seed) for index in range(1, 4 * count))
    return [start for start in starts if start is not None][:count]
