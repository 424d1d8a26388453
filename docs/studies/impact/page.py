"""Page that compares the objectives with simulated impacts of random postures on a stiff surface in MuJoCo."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from docs.studies.core import Request, Vector, machine, say, table
from docs.studies.impact.study import (
    FRICTIONS,
    LIGHTEST,
    OBJECTIVES,
    PICKED_FOR,
    SLID,
    STUDIED,
    VARIATIONS,
    Choice,
    Dropped,
    Row,
    choices,
    needed_friction,
)
from docs.studies.impact.surface import Surface
from impact_posture.errors import ImpactPostureError, InputError
from impact_posture.system.optional_package import import_mujoco

# Number of postures of each robot in the table of variations.
_FEW = 10
_RANKS = "robot|friction|postures|slid|e|size of the jumps|spread of √C|√H|√V|√S|√C|√E".split("|")
_RANKS += ["jump per impulse with √H", "loss with E"]
_RATIOS = "robot|friction|jump: λ√H|jump: (1+e)v√V|jump: (1+e)v√S|jump: (1+e)v√C|loss: (1−e²)v²E".split("|")
_CONE = "robot|friction|should stick|of these slid|jump: (1+e)v√S|largest error of Δν|should slide|of these slid"
_CONVEX = "robot|friction|e|rank of √C|jump: (1+e)v√C|rank of √V|rank of √S"
_VARIED = "impact|lasts, ms|e|no friction: rank of √V|measured/predicted|sticks: rank of √S|measured/predicted|slid"


def lines(request: Request) -> Iterator[str]:
    """Yield all tables of the page."""
    import_mujoco()
    if request.count < 3:
        raise InputError(f"{request.count} postures", where="--count", hint="a rank correlation needs three")
    began = time.perf_counter()
    robots = [name for name in STUDIED if request.only in name]
    dropped = [Dropped.prepare(name, request.count, request.seed) for name in robots]
    rows = [robot.on(Surface(mu)) for robot in dropped for mu in FRICTIONS]
    lasts = max(float(row.measured("duration").max()) for row in rows) * 1e3
    yield from (f"{request.count} random postures (seed {request.seed}) of each robot:", "")
    for case, _, words in (STUDIED[name] for name in robots):
        frame = case.problem().objective.contact.frame
        yield f"- `{case.robot}`: {words}; `{frame}`, n = ({', '.join(f'{v:g}' for v in case.normal or ())})"
    yield from ("", f"Approach speed {Surface().speed:g} m/s; no contact lasts longer than {lasts:.2f} ms.", "")
    yield from ("### Rank correlation of the measured jump with each objective", "")
    yield from table(_RANKS, [_rank_row(row) for row in rows])
    yield ""
    yield (
        f"*slid*: postures whose contact point leaves with a tangential speed above {SLID:.0%} of the approach speed."
    )
    yield from ("", *_left_out(rows), "", "### Measured over predicted: median [least, largest]", "")
    yield from table(
        _RATIOS, [[row.robot, _friction(row.surface), *(_ratio(row.ratios(o)) for o in OBJECTIVES)] for row in rows]
    )
    yield from ("", "Targets:", "", *_verdicts(rows), "", *_which_stick(dropped, rows))
    yield from (*_variations(dropped, request.count), *_picks(robots))
    say(f"{machine('mujoco')}; {time.perf_counter() - began:.0f} s")


def _rank_row(row: Row) -> list[str]:
    sizes = row.measured("size")
    cells = [row.robot, _friction(row.surface), str(len(row.outcomes)), str(row.slid)]
    cells += [_range(row.measured("restitution")), f"{sizes.min():.3g}–{sizes.max():.3g}"]
    predicted = np.sqrt([o.value("coulomb") for o in row.outcomes])
    cells.append(f"{predicted.max() / predicted.min():.1f}-fold")
    cells += [f"{row.rank(objective):.3f}" for objective in OBJECTIVES]
    per_impulse = row.rank("impulse", lambda o: o.per_impulse)
    return [*cells, f"{per_impulse:.3f}", f"{row.rank('energy', lambda o: o.measured.loss):.3f}"]


def _left_out(rows: Sequence[Row]) -> list[str]:
    """Return a line for each robot and surface for which postures were left out, with the reasons."""
    entries = [
        f"- {row.robot}, {_friction(row.surface)}: {count} left out, {reason}"
        for row in rows
        for reason, count in sorted(row.left_out.items())
    ]
    return entries or ["- none left out"]


def _verdicts(rows: Sequence[Row]) -> Iterator[str]:
    """Compare the errors of ``√C``, ``√V`` (no friction) and ``√S`` (with friction) with the allowed errors."""
    frictions = dict.fromkeys(row.surface.friction for row in rows)
    wanted = [("coulomb", mu, 0.95) for mu in frictions]
    for objective, mu, least in [
        *wanted,
        *[("sticking", mu, 0.95) if mu else ("speed", mu, 0.98) for mu in frictions],
    ]:
        own = [row for row in rows if row.surface.friction == mu]
        targets = {
            f"rank ≥ {least}": lambda row, o=objective, m=least: row.rank(o) >= m,
            "every jump within 20 %": lambda row, o=objective: np.abs(row.ratios(o) - 1).max() <= 0.2,
        }
        if mu in (0, np.inf) or objective == "coulomb":
            targets["Δν itself within 1 %"] = lambda row, o=objective: (
                max(x.deviation(o) for x in row.outcomes) <= 0.01
            )
        for words, holds in targets.items():
            missed = [row.robot for row in own if not holds(row)]
            verdict = f"missed by {', '.join(missed)}" if missed else f"met by all {len(own)}"
            yield f"- `{objective}`, {_friction(Surface(mu))}: {words}: {verdict}"


def _which_stick(dropped: Sequence[Dropped], rows: Sequence[Row]) -> Iterator[str]:
    """Compare predicted and simulated sticking, with Coulomb friction and with the friction of MuJoCo."""
    between = [row for row in rows if 0 < row.surface.friction < np.inf]
    yield from ("### Which postures stick", "")
    yield "A posture *should stick* if its sticking impulse needs at most the friction of the surface: the tangential"
    yield from ("part of the impulse over the normal part.", "")
    body = []
    for row in between:
        cells = [row.robot, _friction(row.surface)]
        for part in (held := row.split()):
            cells += [str(len(part.outcomes)), str(part.slid), _ratio(part.ratios("sticking"))]
            if part is held[0]:
                errors = [o.deviation("sticking") for o in part.outcomes]
                cells.append(f"{max(errors):.1%}" if errors else "–")
        body.append(cells)
    yield from table([*_CONE.split("|"), "jump: (1+e)v√S"], body)
    yield from ("", "### MuJoCo's own friction", "")
    largest = max(row.measured("restitution").max() for row in between)
    yield "MuJoCo's friction (elliptic cones) is convex: sliding lifts the contact, which Coulomb's law does not do."
    yield (
        f"Under Coulomb's law (tables above), the contact rebounds with at most e = {largest:.2f} at every posture. "
        "With MuJoCo's friction, the same postures give:"
    )
    yield ""
    convex = [by.on(replace(Surface(mu), convex=True)) for by in dropped for mu in FRICTIONS if 0 < mu < np.inf]
    yield from table(_CONVEX.split("|"), [_convex_row(row) for row in convex])
    yield ""


def _convex_row(row: Row) -> list[str]:
    cells = [row.robot, _friction(row.surface), _range(row.measured("restitution")), f"{row.rank('coulomb'):.3f}"]
    return [
        *cells,
        _ratio(row.ratios("coulomb")),
        *(f"{row.rank(objective):.3f}" for objective in ("speed", "sticking")),
    ]


def _variations(dropped: Sequence[Dropped], postures: int) -> Iterator[str]:
    """Yield a table of impacts with other speeds, restitutions and stiffnesses; the lightest robot has its own
    rows."""
    few = [replace(robot, scenes=robot.scenes[:_FEW]) for robot in dropped]
    body, gone = [], []
    parts = ("", [r for r in few if r.robot != LIGHTEST]), (f", {LIGHTEST}", [r for r in few if r.robot == LIGHTEST])
    for (variation, surface), (own, part) in product((("as above", Surface()), *VARIATIONS), parts):
        if not part:
            continue
        words = variation + own
        smooth, sticky = ([robot.on(replace(surface, friction=mu)) for robot in part] for mu in (0.0, np.inf))
        both = [*smooth, *sticky]
        lasts, rebound = (np.concatenate([row.measured(k) for row in both]) for k in ("duration", "restitution"))
        cells = [words, f"{np.median(lasts * 1e3):.2g}", _range(rebound)]
        for rows, objective in ((smooth, "speed"), (sticky, "sticking")):
            cells.append(f"≥ {min(row.rank(objective) for row in rows):.3f}")
            cells.append(_ratio(np.concatenate([row.ratios(objective) for row in rows])))
        body.append([*cells, str(sum(row.slid for row in sticky)), str(sum(r.left_out.total() for r in both))])
        left = [row for row in both if row.left_out]
        gone += [f"Left out, at {words}:", "", *_left_out(left), ""] if left else []
    yield from ("### Speed, rebound, stiffness", "")
    yield f"The first {min(_FEW, postures)} postures of each robot. The rank is the lowest over the robots."
    yield f"{LIGHTEST}, whose arm is light, has separate rows."
    yield from ("", *table([*_VARIED.split("|"), "left out"], body), "", *gone)


def _picks(robots: Sequence[str]) -> Iterator[str]:
    """Yield the optimal posture of each objective, and the impact in this posture."""
    picks = {name: choices(name) for name in robots}
    smooth, sticks = FRICTIONS[0], FRICTIONS[-1]
    head = ["robot", "picked by", "H", "1/G, kg", "V", "S", "μ to stick"]
    head += [f"jump, {_friction(Surface(mu))}" for mu in FRICTIONS]
    head += [
        f"{what}, {_friction(Surface(mu))}" for what in ("impulse in N·s", "loss in J") for mu in (smooth, sticks)
    ]
    yield from ("### What each objective picks", "", f"`coulomb` is minimized for μ = {PICKED_FOR:g}.", "")
    picked = [choice for some in picks.values() if isinstance(some, list) for choice in some]
    yield from table(head, [_choice(choice) for choice in picked])
    yield ""
    yield from (f"- {n}: no optima, {error}" for n, error in picks.items() if isinstance(error, ImpactPostureError))


def _choice(choice: Choice) -> list[str]:
    o, measured = choice.predicted, choice.measured
    cells = [choice.robot, f"`{choice.objective}`" if choice.objective in OBJECTIVES else choice.objective]
    cells += [f"{o.H:.3g}", f"{1 / o.G:.3g}", f"{o.V:.3g}", "undefined" if o.S is None else f"{o.S:.3g}"]
    cells.append(f"{needed_friction(o):.2f}")
    shown = [(m, "size") for m in measured.values()]
    shown += [(measured[mu], name) for name in ("impulse", "loss") for mu in (FRICTIONS[0], FRICTIONS[-1])]
    return cells + ["–" if m is None else f"{getattr(m, name):.2f}" for m, name in shown]


def _friction(surface: Surface) -> str:
    if np.isinf(surface.friction):
        return "sticks"
    return f"μ = {surface.friction:g}" if surface.friction else "no friction"


def _range(values: Vector) -> str:
    low, high = f"{values.min():.2f}", f"{values.max():.2f}"
    return low if low == high else f"{low}–{high}"


def _ratio(values: Vector) -> str:
    return f"{np.median(values):.3f} [{values.min():.3f}, {values.max():.3f}]" if len(values) else "–"
