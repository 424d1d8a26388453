"""The page of the study of verdicts: the worst rows, then counts for each bar, then other robots."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product

from docs.studies.core import Request, cell, collected, table
from docs.studies.verdict.study import (
    CASES,
    FRICTIONS,
    HELD_OUT,
    MOVES,
    STIFFNESSES,
    Case,
    Compared,
    Pair,
    Row,
    compare,
)
from impact_posture.errors import ImpactPostureError

# Number → its name in the tables, and its largest allowed relative error.
NUMBERS = {
    "jump": ("whole jump", 0.05),
    "linear": ("base linear", 0.05),
    "angular": ("base angular", 0.05),
    "joint": ("worst joint", 0.05),
    "impulse": ("normal impulse", 0.05),
    "force": ("peak force", 0.10),
}
# A change below this value has no sign.
NO_CHANGE = 0.03
SHOWN = 25
_WORST = "case|friction|k, N/m|feet|number|posture|predicted|simulated|error|error, posture still|T, ms".split("|")
_COUNTS = "number|bar|within|largest error|within, posture still|changes above 3 %|right sign".split("|")
_CASES = ("case", "rows", *(name for name, _ in NUMBERS.values()))


def lines(request: Request) -> Iterator[str]:
    """Yield the tables of both groups of robots."""
    frictions, stiffnesses = (", ".join(f"{value:g}" for value in values) for values in (FRICTIONS, STIFFNESSES))
    yield f"Speed: 1 m/s. Friction: {frictions}. Stiffness: {stiffnesses} N/m. Before and after an optimization with"
    yield f"{request.count} starts and the objective `auto`."
    for title, cases in (("Robots that the simulation was written with", CASES), ("Other robots", HELD_OUT)):
        chosen = [case for case in cases if request.only in case.name]
        if chosen:
            yield from ("", f"### {title}", "")
            yield from _group(chosen, request)


def _group(cases: Sequence[Case], request: Request) -> Iterator[str]:
    tasks = list(product(cases, FRICTIONS))

    def work(index: int) -> Compared:
        try:
            return compare(*tasks[index], request.count)
        except ImpactPostureError as error:
            case, friction = tasks[index]
            return Compared((), (f"{case.name}, friction {friction:g}: {str(error).splitlines()[0]}",))

    results = collected(work, len(tasks), request.jobs, "verdicts")
    rows = [row for result in results for row in result.rows]
    yield from _worst(rows)
    for feet, words in (("–", "Robots without feet"), ("held", "Feet that are held"), ("free", "Feet that are free")):
        some = [row for row in rows if row.feet == feet]
        if some:
            yield from ("", f"{words}, {len(some)} verdicts:", "")
            yield from _counts(some, request)
    yield from ("", "Largest error of each case, in percent:", "")
    yield from table(_CASES, [_case(case, [row for row in rows if row.case == case]) for case in cases])
    missing = [reason for result in results for reason in result.missing]
    if missing:
        yield from ("", "Not compared:", "", *(f"- {reason}" for reason in missing))


def _pairs(rows: Sequence[Row]) -> list[tuple[Row, str, Pair]]:
    return [(row, name, getattr(row, name)) for row in rows for name in ("before", "after")]


def _worst(rows: Sequence[Row]) -> Iterator[str]:
    """Yield the worst number of each verdict, relative to its bar, for the worst verdicts."""
    errors = [
        (abs(error) / bar, row, name, pair, number)
        for row, name, pair in _pairs(rows)
        for number, (_, bar) in NUMBERS.items()
        if (error := pair.error(number)) is not None
    ]
    worst = {id(error[1]): error for error in sorted(errors, key=lambda error: error[0])}
    ordered = sorted(worst.values(), key=lambda error: -error[0])[:SHOWN]
    yield f"The {len(ordered)} worst of {len(rows)} verdicts, each with its worst number:"
    yield ""
    yield from table(_WORST, [_worst_row(*error[1:]) for error in ordered])


def _worst_row(row: Row, name: str, pair: Pair, number: str) -> list[str]:
    where = [row.case.name, f"{row.friction:g}", f"{row.stiffness:.0e}", row.feet]
    values = [f"{getattr(side, number):.3g}" for side in (pair.predicted, pair.simulated)]
    errors = [f"{100 * (pair.error(number, still=still) or 0.0):+.1f} %" for still in (False, True)]
    return [*where, NUMBERS[number][0], name, *values, *errors, f"{1e3 * pair.time:.1f}"]


def _counts(rows: Sequence[Row], request: Request) -> Iterator[str]:
    """Yield how many numbers are within each bar, signs, sticking, and feet."""
    known = [number for number in NUMBERS if any(row.changes(number) for row in rows)]
    yield from table(_COUNTS, [_count(number, rows, request) for number in known])
    pairs = [pair for _, _, pair in _pairs(rows)]
    sliding = [pair for row, _, pair in _pairs(rows) if row.friction > 0]
    same = sum(pair.predicted.slips == pair.simulated.slips for pair in sliding)
    yield ""
    yield f"Stick or slip is as predicted in {same} of {len(sliding)} impacts with friction. The worst joint is the"
    yield f"predicted one in {sum(pair.named for pair in pairs)} of {len(pairs)} impacts."
    if rows[0].feet == "free":
        stay = [pair for pair in pairs if not pair.predicted.moving]
        move = [pair for pair in pairs if pair.predicted.moving]
        surprising = sum(bool(pair.simulated.moving) for pair in stay)
        same = sum(pair.simulated.moving == pair.predicted.moving for pair in move)
        more = sum(bool(pair.simulated.moving - pair.predicted.moving) for pair in move)
        yield f"A foot moves if its speed is above {100 * MOVES:g} % of the approach speed."
        yield f"All feet should stay in {len(stay)} impacts; a foot moves in {surprising} of them."
        yield f"Feet should move in {len(move)} impacts; the same feet move in {same}, and further feet in {more}."
    unsolved = sum(pair.unsolved for pair in pairs)
    if unsolved:
        yield f"{unsolved} time steps of these simulations were not solved."


def _count(number: str, rows: Sequence[Row], request: Request) -> list[str]:
    words, bar = NUMBERS[number]
    pairs = [pair for _, _, pair in _pairs(rows) if pair.error(number) is not None]
    errors = [abs(pair.error(number) or 0.0) for pair in pairs]
    still = [abs(pair.error(number, still=True) or 0.0) for pair in pairs]
    changes = [change for row in rows if (change := row.changes(number)) and max(map(abs, change)) > NO_CHANGE]
    right = sum(first * second > 0 for first, second in changes)
    inside = sum(error <= bar for error in errors)
    group = f"{rows[0].feet} feet" if rows[0].feet != "–" else "no feet"
    if inside < len(errors):
        request.missed.append(f"{words}, {group}: {len(errors) - inside} of {len(errors)} beyond {100 * bar:g} %")
    if right < len(changes):
        request.missed.append(f"{words}, {group}: {len(changes) - right} of {len(changes)} signs wrong")
    return [
        words, f"{100 * bar:g} %", f"{inside} of {len(errors)}", f"{100 * max(errors):.1f} %",
        f"{sum(error <= bar for error in still)} of {len(still)}", f"{len(changes)}", f"{right}",
    ]  # fmt: skip


def _case(case: Case, rows: Sequence[Row]) -> list[str]:
    cells = []
    for number in NUMBERS:
        errors = [abs(error) for _, _, pair in _pairs(rows) if (error := pair.error(number)) is not None]
        cells.append(cell(100 * max(errors) if errors else None, 1))
    return [case.name, f"{len(rows)}", *cells]
