"""What a benchmark found: rows, what is not among them, and how the export compares."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from impact_posture.benchmark.count import Operations
from impact_posture.benchmark.peer import Group, Peer
from impact_posture.benchmark.pinocchio import DERIVATIVES
from impact_posture.benchmark.timing import Times
from impact_posture.benchmark.workbench import Skipped


@dataclass(frozen=True)
class BenchRow:
    """One way of computing H and ∇H.

    Attributes:
        name: How it is called.
        group: Whose it is.
        what: What it does.
        eval_us: Microseconds of H with ∇H, one configuration.
        value_us: Microseconds of H alone; ``None`` where it has no such function.
        batch_us: Microseconds of H with ∇H, a configuration of many.
        ratio: ``eval_us`` over that of the fastest of ours.
        operations: Of H with ∇H; ``None`` where it is a library of templates.
        source_kb: Size of the source, kB.
        eval_kb: Size of what H with ∇H takes of it, kB.
        compile_s: Processor seconds of the compiler, for all of the source.
        flags: Compiler and options.
        difference: Largest relative difference from Pinocchio's numbers by dense linear algebra.
    """

    name: str
    group: Group
    what: str
    eval_us: float
    value_us: float | None
    batch_us: float | None
    ratio: float
    operations: Operations | None
    source_kb: float | None
    eval_kb: float | None
    compile_s: float
    flags: str
    difference: float

    @staticmethod
    def of(peer: Peer, times: Times, best: float, difference: float) -> BenchRow:
        """A row of a peer; ``best`` is the shortest time of ours, seconds."""
        if times.eval is None:
            raise ValueError(f"{peer.name} was not timed")
        return BenchRow(
            peer.name, peer.group, peer.what, times.eval * 1e6, _scaled(times.value), _scaled(times.batch),
            times.eval / best, peer.operations, peer.source_kb, peer.eval_kb, peer.compile_s, peer.flags, difference,
        )  # fmt: skip

    def to_dict(self) -> dict[str, object]:
        """For a JSON document."""
        operations = None if self.operations is None else self.operations.to_dict()
        return {**self.__dict__, "operations": operations}


def _scaled(seconds: float | None) -> float | None:
    return None if seconds is None else seconds * 1e6


@dataclass(frozen=True)
class Comparison:
    """How many times faster the fastest of ours is.

    Attributes:
        against: ``pinocchio_derivatives``: Pinocchio's own derivative algorithms; ``pinocchio_by_hand``: the fastest
            of what can be written by hand on its types; ``adam``, ``casadi``, ``differences``: the fastest of these.
        words: The same in words.
        row: The row compared with.
        eval: One configuration against one.
        batch: One configuration against one of our batch, on one core.
    """

    against: str
    words: str
    row: str
    eval: float
    batch: float


_AGAINST: tuple[tuple[str, str, Callable[[BenchRow], bool]], ...] = (
    (
        "pinocchio_derivatives",
        "Pinocchio's own derivative algorithms",
        lambda row: row.name == DERIVATIVES,
    ),
    (
        "pinocchio_by_hand",
        "the fastest by hand on Pinocchio's types",
        lambda row: row.group == "pinocchio" and row.name != DERIVATIVES,
    ),
    ("adam", "ADAM's M and J through CasADi", lambda row: row.group == "adam"),
    ("casadi", "CRBA + LDLᵀ through CasADi", lambda row: row.group == "casadi"),
    ("differences", "central differences of our own H", lambda row: row.group == "differences"),
)


@dataclass(frozen=True)
class BenchReport:
    """One robot's.

    Attributes:
        robot: Its name.
        frame: Contact frame.
        nq: Length of a configuration.
        nv: Degrees of freedom.
        configurations: How many random ones each was called at.
        rounds: How many passes over them the medians are of.
        core: The processor core; ``None`` where the system does not let one choose.
        rows: Ours first.
        skipped: What is not there, and why.
        notes: Remarks.
        floor: What an ideal articulated-body solve, adjoint and sweep need; ``None`` for joints of several
            coordinates.
    """

    robot: str
    frame: str
    nq: int
    nv: int
    configurations: int
    rounds: int
    core: int | None
    rows: tuple[BenchRow, ...]
    skipped: tuple[Skipped, ...]
    notes: tuple[str, ...]
    floor: Operations | None

    @property
    def comparisons(self) -> tuple[Comparison, ...]:
        """Against the fastest of each kind that is there."""
        ours = [row for row in self.rows if row.group == "ours"]
        single = min(row.eval_us for row in ours)
        many = min(row.batch_us for row in ours if row.batch_us is not None)
        found = []
        for against, words, belongs in _AGAINST:
            rows = [row for row in self.rows if belongs(row)]
            if rows:
                fastest = min(rows, key=lambda row: row.eval_us)
                ratios = fastest.eval_us / single, fastest.eval_us / many
                found.append(Comparison(against, words, fastest.name, *ratios))
        return tuple(found)

    def to_dict(self) -> dict[str, object]:
        """For a JSON document."""
        return {
            "robot": self.robot,
            "frame": self.frame,
            "nq": self.nq,
            "nv": self.nv,
            "configurations": self.configurations,
            "rounds": self.rounds,
            "core": self.core,
            "rows": [row.to_dict() for row in self.rows],
            "comparisons": [dict(c.__dict__) for c in self.comparisons],
            "skipped": [dict(s.__dict__) for s in self.skipped],
            "notes": list(self.notes),
            "floor": None if self.floor is None else self.floor.to_dict(),
        }


def commands(reports: Sequence[BenchReport]) -> dict[str, tuple[str, ...]]:
    """Compiler and options → the rows that they made, each once."""
    found: dict[str, list[str]] = {}
    for row in (row for report in reports for row in report.rows):
        names = found.setdefault(row.flags, [])
        names += [row.name] if row.name not in names else []
    return {flags: tuple(names) for flags, names in found.items()}
