"""Compare implementations of H and ∇H by time, operations, source size and compile time.

All implementations use the same configurations and normals, W = I, and the robot without supports.  The results of
all implementations are checked first.  Then C loops call the implementations alternately on one core.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from docs.studies.core import Request, cell, machine, say, table
from docs.studies.kernel.counts import total
from docs.studies.kernel.floor import floor
from docs.studies.kernel.harness import COUNT, Absent, Disagreement, Harness, Kernel, Kind, Samples
from docs.studies.kernel.peers import adam, dense, ours, same_graph
from docs.studies.kernel.pinocchio import DERIVATIVES, kernels
from impact_posture.errors import CompilerError
from impact_posture.robot.robot_loader import load_robot

ROBOTS = ("solo8", "tilthex_arm", "panda", "talos")
PEERS = {"same graph": same_graph, "pinocchio": kernels, "adam": adam, "casadi": dense}
# Text of a comparison → prefix of the names of the compared rows, and the name of a row that is left out.  Our
# fastest row is compared with the fastest of these rows.
_AGAINST = {
    "Pinocchio's own derivative algorithms": (DERIVATIVES, ""),
    "the fastest by hand on Pinocchio's types": ("Pinocchio", DERIVATIVES),
    "ADAM's M and J through CasADi": ("ADAM", ""),
    "CRBA + LDLᵀ through CasADi": ("CasADi", ""),
    "the same graph, printed by CasADi": ("same graph", ""),
    "central differences of our own H": ("differences", ""),
}
_HEAD = "implementation|H, ∇H µs|ratio|H µs|∇/H|batch µs|operations|packed|source kB|build s|error".split("|")


@dataclass(frozen=True)
class Report:
    """Rows of the table of one robot, with times in µs and our rows first, and the reasons for missing rows."""

    samples: Samples
    rows: Sequence[tuple[Kernel, dict[Kind, float], float]]
    skipped: Sequence[str]

    def fastest(self, start: str, but: str = "") -> float | None:
        """Return the shortest time of H with ∇H among the rows whose names start with ``start``."""
        names = [k.name.startswith(start) and k.name != but for k, _, _ in self.rows]
        return min((_single(t) for (_, t, _), fits in zip(self.rows, names, strict=True) if fits), default=None)

    def compared(self, start: str, but: str) -> str:
        """Return as text how many times faster our code is and, in brackets, our code for batches."""
        other, own = self.fastest(start, but), self.fastest("ours") or 1.0
        batch = min(times["batch"] for _, times, _ in self.rows if "batch" in times)
        return "–" if other is None else f"{other / own:.1f} ({other / batch:.1f})"


def _single(times: dict[Kind, float]) -> float:
    return times["eval"] if "eval" in times else times["differences"]


def measure(samples: Samples, rounds: int, peers: Sequence[str] = tuple(PEERS)) -> Report:
    """Build and check the implementations, and measure the time of implementations with correct numbers.

    Raises:
        CompilerError: No C compiler is installed, or our export cannot be built or computes wrong numbers.
    """
    robot, skipped = samples.robot, []
    say(f"{robot.name}: the export")
    made = ours(samples)
    for name in peers:
        try:
            made += PEERS[name](samples)
        except (Absent, CompilerError) as absent:
            skipped.append(f"{name}: skipped, {str(absent)[:200]}")
    harness, right = Harness(samples), []
    for kernel in made:
        try:
            right.append((kernel, harness.difference(kernel)))
        except Disagreement as wrong:
            if kernel.group == "ours":
                raise CompilerError(f"{kernel.name}: {wrong}", where="kernel", hint="try verify") from None
            skipped.append(f"{kernel.name}: skipped, {wrong}")
    say(f"{robot.name}: {rounds} rounds")
    times = harness.times([kernel for kernel, _ in right], rounds)
    rows = [(kernel, timed, error) for (kernel, error), timed in zip(right, times, strict=True)]
    # Only the fastest of our builds with finite differences is kept.
    differences = {kernel.name: t["differences"] for kernel, t, _ in rows if "differences" in t}
    slower = sorted(differences, key=lambda name: differences[name])[1:]
    return Report(samples, [row for row in rows if row[0].name not in slower], skipped)


def lines(request: Request) -> Iterator[str]:
    """Yield comparisons, a table for each robot, and the compiler commands."""
    reports = []
    for name in (name for name in ROBOTS if request.only in name):
        robot = load_robot(name)
        reports.append(measure(Samples(robot, robot.spec.contact.frame or ""), request.count))
    yield f"{machine()}; one core, medians of {request.count} passes over {COUNT} random configurations."
    yield ""
    names = [f"{r.samples.robot.name} (nv {r.samples.robot.nv})" for r in reports]
    body = [[words, *[r.compared(*which) for r in reports]] for words, which in _AGAINST.items()]
    yield from table(["how many times faster H with ∇H is than", *names], body)
    yield from ("", "In brackets: time of a configuration in a batch, on the same core.", "")
    for report in reports:
        yield from _robot(report)
    commands: dict[str, list[str]] = {}
    for name, flags in dict.fromkeys((k.name, k.built.flags) for report in reports for k, _, _ in report.rows):
        commands.setdefault(flags, []).append(name)
    yield from ("Made by:", "")
    yield from table(["rows", "compiler and options"], [[", ".join(v), f"`{k}`"] for k, v in commands.items()])


def _robot(report: Report) -> Iterator[str]:
    samples, best = report.samples, report.fastest("ours") or 1.0
    robot = samples.robot
    yield f"**{robot.name}** at `{samples.frame}`: nq {robot.nq}, nv {robot.nv}"
    yield ""
    rows = []
    for kernel, times, error in report.rows:
        single, value, count = _single(times), times.get("value"), kernel.operations
        numbers = [
            (single, 3), (single / best, 2), (value, 3), (single / value if value else None, 2),
            (times.get("batch"), 3), (total(count) if count else None, 0), (kernel.packed, 0), (kernel.source_kb, 0),
            (kernel.built.compile_s, 1),
        ]  # fmt: skip
        rows.append([kernel.name, *[cell(*number) for number in numbers], f"{error:.0e}"])
    if samples.plain:
        rows.append(["floor", *["–"] * 5, str(floor(robot, samples.point.joint)), *["–"] * 4])
    yield from table(_HEAD, rows)
    yield from ("", *[f"- {words}" for words in report.skipped], *[""] * bool(report.skipped))
