"""``impact-posture bench [ROBOT]...``."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Literal, get_args

import typer

from impact_posture_cli import options
from impact_posture_cli.checks import UsageError

if TYPE_CHECKING:
    from impact_posture.benchmark.count import Operations
    from impact_posture.benchmark.report import BenchReport, BenchRow
    from impact_posture_cli.output import Page

# The library's own list sits behind heavy imports; a test keeps the two in step.
PeerName = Literal["differences", "pinocchio", "adam", "casadi"]
_NO_PEER = "none"


def _peers(text: str) -> str:
    """Refuse unknown names at once."""
    known = get_args(PeerName)
    for name in text.split(","):
        if name not in known and text != _NO_PEER:
            raise typer.BadParameter(f"no peer '{name}': one or more of {','.join(known)}, or {_NO_PEER}")
    return text


Robots = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="ROBOT", show_default="solo8 tilthex_arm panda talos",
        help="Known names, paths to a .urdf, or example-robot-data:PATH.",
    ),
]  # fmt: skip
Peers = Annotated[
    str,
    typer.Option(
        "--peers", metavar="NAME,NAME", callback=_peers, rich_help_panel=options.OUTPUT,
        help="What to compare with: differences, pinocchio, adam, casadi; or none.",
    ),
]  # fmt: skip
Rounds = Annotated[
    int, typer.Option("--rounds", min=1, rich_help_panel=options.OUTPUT, help="Passes that the medians are of.")
]
Patience = Annotated[
    float,
    typer.Option(
        "--patience", metavar="S", min=1, rich_help_panel=options.OUTPUT,
        help="Processor seconds that a compiler may take for one build.",
    ),
]  # fmt: skip


def bench(
    robot: Robots = None,
    frame: options.Frame = None,
    lock: options.Lock = None,
    root: options.Root = None,
    armature: options.Armature = None,
    config: options.Config = None,
    srdf: options.Srdf = None,
    package_dir: options.PackageDirs = None,
    peers: Peers = "differences,pinocchio,adam,casadi",
    rounds: Rounds = 101,
    patience: Patience = 240.0,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Time H and ∇H on this machine: the exported C beside Pinocchio C++, ADAM, CasADi and finite differences."""
    own = {"--frame": frame, "--lock": lock, "--root": root, "--config": config, "--srdf": srdf}
    said = [name for name, value in (own | {"--armature": armature}).items() if value is not None]
    if said and len(robot or ()) != 1:
        raise UsageError(f"{', '.join(said)}: of which robot? Name one ROBOT.")
    if not 1 <= patience < 1e6:
        raise typer.BadParameter("give seconds, one or more", param_hint="--patience")
    from impact_posture.benchmark.measure import DEFAULT_ROBOTS, machine, measure
    from impact_posture_cli.impact_options import impact_request
    from impact_posture_cli.output import Page, print_json

    wanted = [name for name in get_args(PeerName) if name in peers.split(",")]
    # Wrong names show before the first minute of compiling.
    impacts = [
        impact_request(
            name, frame=frame, normal=(0.0, 0.0, 1.0), offset=None, normal_frame="world", contact=None, impulse=1.0,
            posture=None, support=None, no_support=True, metric="euclidean", weights=None, objective="impulse",
            speed=1.0, restitution=0.0, root=root, package_dir=package_dir, srdf=srdf, config=config,
            armature=armature, lock=lock, lock_massless=False, normal_cone=0.0,
        ).resolve()
        for name in robot or DEFAULT_ROBOTS
    ]  # fmt: skip
    about = machine()
    page = Page(quiet=quiet)
    if not json:
        page.title(str(about["processor"]), f"{about['cores']} cores, load {about['load']}")
        page.line(str(about["compiler"]), style="dim")
    reports = []
    for impact in impacts:
        with _progress(impact.robot.name, shown=not (quiet or json)) as say:
            reports.append(measure(impact.robot, impact.contact.frame, wanted, rounds, patience, say))
        if not json:
            _show(page, reports[-1])
    if json:
        rows = [report.to_dict() for report in reports]
        print_json({"schema": "impact-posture/bench/1", "machine": about, "robots": rows})
        return
    _flags(page, reports)
    page.warnings(dict.fromkeys(line for impact in impacts for line in impact.warnings))


def _show(page: Page, report: BenchReport) -> None:
    page.gap()
    page.title(
        f"{report.robot} at {report.frame}",
        f"nq {report.nq}, nv {report.nv}, {report.configurations} configurations",
    )
    rows = [_cells(row) for row in report.rows]
    if report.floor is not None:
        rows.append(("floor", "", "", "", "", str(report.floor.total), "", ""))
    heads = ("way", "H, ∇H µs", "ratio", "H µs", "batch", "ops", "kB", "build s")
    page.table(heads, rows, right=range(1, len(heads)), fold=0)
    compared = [(f"{c.eval:.1f} ×", f"batch {c.batch:.1f} ×", f"faster than {c.words}") for c in report.comparisons]
    if compared:
        page.table((), compared, right=(0, 1))
    for left in report.skipped:
        page.line(f"{left.name}: skipped, {left.reason}", style="dim")
    for note in report.notes:
        page.line(note, style="dim")


def _cells(row: BenchRow) -> tuple[str, ...]:
    return (
        row.name, _cell(row.eval_us, 3), _cell(row.ratio, 2), _cell(row.value_us, 3), _cell(row.batch_us, 3),
        _count(row.operations), _cell(row.source_kb, 0), _cell(row.compile_s, 1),
    )  # fmt: skip


def _cell(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def _count(operations: Operations | None) -> str:
    return "–" if operations is None else str(operations.total)


def _flags(page: Page, reports: list[BenchReport]) -> None:
    from impact_posture.benchmark.report import commands

    page.gap()
    for flags, names in commands(reports).items():
        page.line(f"{', '.join(names)}: {flags}", style="dim")


@contextmanager
def _progress(robot: str, *, shown: bool) -> Iterator[Callable[[str], None]]:
    """What is being done, on standard error: a status line on a terminal, else one line each."""
    if not shown:
        yield lambda text: None
        return
    from rich.console import Console
    from rich.text import Text

    from impact_posture.escape import printable

    console = Console(stderr=True, highlight=False, soft_wrap=True)
    if not console.is_terminal:
        yield lambda text: console.print(Text(printable(f"{robot}: {text}")))
        return
    with console.status("") as status:
        yield lambda text: status.update(Text(printable(f"{robot}: {text}")))
