"""The page of the study of verdicts: numbers whose error is too large, counts for each number, and other robots."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product

import numpy as np

from docs.studies.core import Request, cell, collected, table
from docs.studies.verdict.study import (
    CASES,
    FRICTIONS,
    HELD_OUT,
    MOVES,
    STIFFNESSES,
    Case,
    Compared,
    HoldingTime,
    Pair,
    Row,
    compare,
)
from impact_posture.errors import ImpactPostureError
from impact_posture.posture.analysis.verdict_changes import FELT

# Number → its name in the tables, and its largest allowed relative error.
NUMBERS = {
    "jump": ("whole jump", 0.05),
    "linear": ("base linear", 0.05),
    "angular": ("base angular", 0.05),
    "joint": ("worst joint", 0.05),
    "impulse": ("normal impulse", 0.05),
    "force": ("peak force", 0.10),
}
VELOCITIES = ("linear", "angular", "joint")
# A smaller change counts as no change.
NO_CHANGE = 0.03
# Largest relative error of the predicted shortest contact time with which the feet stay.  The simulation determines
# this contact time with an accuracy of 5 %.
HOLDING = 0.20
# Reasons why a number may be beyond its bar.
NEGLIGIBLE, MOVES_LONG = "negligible", "robot moves"
_WORST = "case|friction|k, N/m|feet|number|posture|predicted|simulated|error|error, posture still|T, ms|reason".split(
    "|"
)
_COUNTS = "number|bar|within|negligible|robot moves|missed|largest error|changes above 3 %|right sign".split("|")
_HOLDING = "case|friction|posture|predicted, ms|simulated, ms|error|error, posture still|reason".split("|")
_CASES = ("case", "rows", *(name for name, _ in NUMBERS.values()))


def lines(request: Request) -> Iterator[str]:
    """Yield the tables of both groups of robots."""
    frictions, stiffnesses = (", ".join(f"{value:g}" for value in values) for values in (FRICTIONS, STIFFNESSES))
    yield f"Speed: 1 m/s. Friction: {frictions}. Stiffness: {stiffnesses} N/m. Before and after an optimization with"
    yield f"{request.count} starts and the objective `auto`."
    for title, cases in (("Robots with which the simulation was written", CASES), ("Other robots", HELD_OUT)):
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
            return Compared((), (), (f"{case.name}, friction {friction:g}: {str(error).splitlines()[0]}",))

    results = collected(work, len(tasks), request.jobs, "verdicts")
    rows = [row for result in results for row in result.rows]
    yield from _beyond(rows)
    for feet, words in (("–", "Robots without feet"), ("held", "Feet that are held"), ("free", "Feet that are free")):
        some = [row for row in rows if row.feet == feet]
        if some:
            yield from ("", f"{words}, {len(some)} verdicts:", "")
            yield from _counts(some, request)
    yield from _holding([time for result in results for time in result.held], request)
    yield from ("", "Largest error of each case, in percent:", "")
    yield from table(_CASES, [_case(case, [row for row in rows if row.case == case]) for case in cases])
    missing = [reason for result in results for reason in result.missing]
    if missing:
        yield from ("", "Not compared:", "", *(f"- {reason}" for reason in missing))


def _pairs(rows: Sequence[Row]) -> list[tuple[Row, str, Pair]]:
    return [(row, name, getattr(row, name)) for row in rows for name in ("before", "after")]


def _reason(row: Row, pair: Pair, number: str) -> str | None:
    """Return why a number may be beyond its bar; empty without a reason, ``None`` if it is within its bar."""
    bar, error = NUMBERS[number][1], pair.error(number)
    if error is None or abs(error) <= bar:
        return None
    predicted, simulated = pair.values(number)
    if number in VELOCITIES and abs(predicted - simulated) <= FELT * pair.speed:
        return NEGLIGIBLE
    return MOVES_LONG if row.long and abs(pair.error(number, still=True) or 0.0) <= bar else ""


def _beyond(rows: Sequence[Row]) -> Iterator[str]:
    """Yield all numbers beyond their bar with the reason, first those without a reason, then the worst."""
    beyond = [
        (bool(reason), -abs(pair.error(number) or 0.0) / bar, row, name, pair, number, reason)
        for row, name, pair in _pairs(rows)
        for number, (_, bar) in NUMBERS.items()
        if (reason := _reason(row, pair, number)) is not None
    ]
    beyond.sort(key=lambda entry: (entry[0], entry[1]))
    yield f"Numbers beyond their bar in {len(rows)} verdicts: {len(beyond)}."
    yield ""
    if beyond:
        yield from table(_WORST, [_beyond_row(*entry[2:]) for entry in beyond])


def _beyond_row(row: Row, name: str, pair: Pair, number: str, reason: str) -> list[str]:
    where = [row.case.name, f"{row.friction:g}", f"{row.stiffness:.0e}", row.feet]
    values = [f"{value:.3g}" for value in pair.values(number)]
    errors = [f"{100 * (pair.error(number, still=still) or 0.0):+.1f} %" for still in (False, True)]
    return [*where, NUMBERS[number][0], name, *values, *errors, f"{1e3 * pair.time:.1f}", reason or "**missed**"]


def _counts(rows: Sequence[Row], request: Request) -> Iterator[str]:
    """Yield how many numbers are within their bar, and how often signs, sticking and feet are predicted correctly."""
    known = [number for number in NUMBERS if any(row.changes(number) for row in rows)]
    yield from table(_COUNTS, [_count(number, rows, request) for number in known])
    pairs = [pair for _, _, pair in _pairs(rows)]
    sliding = [pair for row, _, pair in _pairs(rows) if row.friction > 0]
    same = sum(pair.predicted.slips == pair.simulated.slips for pair in sliding)
    yield ""
    yield f"Stick or slip is as predicted in {same} of {len(sliding)} impacts with friction. The worst joint is the"
    yield f"predicted one in {sum(pair.named for pair in pairs)} of {len(pairs)} impacts."
    if rows[0].feet == "free":
        yield from _feet(rows, request)
    unsolved = sum(pair.unsolved for pair in pairs)
    if unsolved:
        yield f"Unsolved time steps of these simulations: {unsolved}."


def _feet(rows: Sequence[Row], request: Request) -> Iterator[str]:
    pairs = _pairs(rows)
    equal = sum(pair.predicted.moving == pair.simulated.moving for _, _, pair in pairs)
    wrong = [entry for entry in pairs if entry[2].wrong_feet()]
    share, near = f"{100 * MOVES:g} %", len(pairs) - equal - len(wrong)
    yield f"A foot moves if its speed is above {share} of the approach speed. Feet move as predicted in {equal} of"
    yield f"{len(pairs)} impacts, and within {share} of the approach speed in {near} more."
    for row, name, pair in wrong:
        predicted, simulated = (", ".join(sorted(side.moving)) or "none" for side in (pair.predicted, pair.simulated))
        where = f"{row.case.name}, friction {row.friction:g}, {row.stiffness:.0e} N/m, {name}"
        excused = row.long and pair.still.moving == pair.predicted.moving
        yield f"- {where}: predicted {predicted}; simulated {simulated}{f' ({MOVES_LONG})' if excused else ''}"
        if not excused:
            request.missed.append(f"feet, {where}")


def _holding(times: Sequence[HoldingTime], request: Request) -> Iterator[str]:
    """Yield the shortest contact times with which the feet stay, the largest error first."""
    if not times:
        return
    ordered = sorted(times, key=lambda time: -abs(np.log(time.predicted / time.simulated)))
    reasons = [_holding_reason(time) for time in ordered]
    missed = reasons.count("")
    yield from (
        "",
        f"Shortest contact times with which the feet stay, within {100 * HOLDING:g} %: {reasons.count(None)} of",
    )
    yield f"{len(times)}; robot moves: {reasons.count(MOVES_LONG)}; missed: {missed}. The worst first:"
    yield ""
    yield from table(_HOLDING, [_holding_row(*entry) for entry in zip(ordered, reasons, strict=True)])
    if missed:
        request.missed.append(f"shortest contact time with which the feet stay: {missed} of {len(times)}")


def _holding_reason(time: HoldingTime) -> str | None:
    """Return why the error of a time exceeds its bar, as :func:`_reason` does for a number."""
    error, still = (abs(time.predicted / other - 1) for other in (time.simulated, time.still))
    if error <= HOLDING:
        return None
    return MOVES_LONG if time.long and still <= HOLDING else ""


def _holding_row(time: HoldingTime, reason: str | None) -> list[str]:
    values = [f"{1e3 * value:.2g}" for value in (time.predicted, time.simulated)]
    errors = [f"{100 * (time.predicted / other - 1):+.0f} %" for other in (time.simulated, time.still)]
    word = "" if reason is None else reason or "**missed**"
    return [time.case.name, f"{time.friction:g}", time.posture, *values, *errors, word]


def _count(number: str, rows: Sequence[Row], request: Request) -> list[str]:
    words, bar = NUMBERS[number]
    errors = [error for _, _, pair in _pairs(rows) if (error := pair.error(number)) is not None]
    reasons = [_reason(row, pair, number) for row, _, pair in _pairs(rows)]
    missed = reasons.count("")
    changes = [change for row in rows if (change := row.changes(number)) and _signed(row, number, change)]
    right = sum(first * second > 0 for first, second in changes)
    group = f"{rows[0].feet} feet" if rows[0].feet != "–" else "no feet"
    if missed:
        request.missed.append(f"{words}, {group}: {missed} of {len(errors)} beyond {100 * bar:g} %")
    if right < len(changes):
        request.missed.append(f"{words}, {group}: {len(changes) - right} of {len(changes)} signs wrong")
    return [
        words, f"{100 * bar:g} %", f"{sum(abs(error) <= bar for error in errors)} of {len(errors)}",
        f"{reasons.count(NEGLIGIBLE)}", f"{reasons.count(MOVES_LONG)}", f"{missed}",
        f"{100 * max(map(abs, errors)):.1f} %", f"{len(changes)}", f"{right}",
    ]  # fmt: skip


def _signed(row: Row, number: str, change: tuple[float, float]) -> bool:
    """Return whether a number changes by more than 3 %, and a velocity also by more than a negligible amount."""
    if max(map(abs, change)) <= NO_CHANGE:
        return False
    first, last = row.before.values(number), row.after.values(number)
    least = FELT * row.before.speed if number in VELOCITIES else 0.0
    return max(abs(b - a) for a, b in zip(first, last, strict=True)) > least


def _case(case: Case, rows: Sequence[Row]) -> list[str]:
    cells = []
    for number in NUMBERS:
        errors = [abs(error) for _, _, pair in _pairs(rows) if (error := pair.error(number)) is not None]
        cells.append(cell(100 * max(errors) if errors else None, 1))
    return [case.name, f"{len(rows)}", *cells]
