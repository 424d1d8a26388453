"""The page's tables, all of them from the records."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence

from tests.benchmarks.robustness.advice import Records, choice_lines, percent
from tests.benchmarks.robustness.draws import COUNT, DWELL, PATIENCE, PAUSE, RANGES
from tests.benchmarks.robustness.outcomes import HELD, NOMINAL, SATURATED, SHARE, Record, controllers
from tests.benchmarks.robustness.statistics import (
    Split,
    change,
    fall,
    misled,
    rank,
    split,
    summarize,
    worst,
)

# The page of the documentation takes what is before and what is after.
MARK = "<!-- tables -->"
# M: a shoulder that is less than this ahead of or behind the base's center is under it.
_UNDER = 0.04
# Drawn values whose rank correlation is shown.
_RANKED = ("x", "z", "speed", "force", "stiffness", "armature", "gain")


def page(records: Records, seed: int) -> str:
    """All of it, as Markdown."""
    lines = [*choice_lines(records), "", MARK, "", "### How often each controller helps", ""]
    lines += [*overview(records), "", "### What goes with success", "", *ranks(records), "", *by_v(records), ""]
    lines += [*splits(records), "", "### Counterexamples", "", *counterexamples(records), ""]
    lines += ["### What was drawn", "", *drawn(records, seed)]
    return "\n".join(lines) + "\n"


def _v_parts(own: Sequence[Record], controller: str) -> tuple[Split, Split]:
    known = [r for r in own if fall(r, controller, "V") is not None]
    return split(known, controller, lambda r: (fall(r, controller, "V") or 0.0) > 0)


def overview(records: Records) -> list[str]:
    """A row a scenario and controller."""
    lines = [
        "| scenario | controller | less motion | lower jump | both | motion: median [quartiles] | jump: median "
        "| no more saturation | saturated, s: inside + outside | on stops | failed |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, own in records.items():
        for controller in controllers(name):
            s = summarize(own, controller)
            inside, outside = s.saturation
            low, middle, high = (percent(v) for v in s.quartiles)
            failed = ", ".join(f"{kind} {n}" for kind, n in sorted(s.failures.items())) or "0"
            if controller == NOMINAL:
                cells = ["–"] * 6
            else:
                cells = [f"{v}/{s.count}" for v in (s.helps, s.gentler, s.both)]
                cells += [f"{middle} [{low}, {high}]", percent(s.jump), f"{s.freer}/{s.count}"]
            row = [f"`{name}`", f"`{controller}`", *cells, f"{inside:.2f} + {outside:.1f}", str(s.stops), failed]
            lines.append(f"| {' | '.join(row)} |")
    return lines


def ranks(records: Records) -> list[str]:
    """Rank correlations of the reduction by ``robust``."""
    rows: dict[str, Callable[[Record], float | None]] = {
        "fall of H": lambda r: fall(r, "robust", "H"),
        "fall of V": lambda r: fall(r, "robust", "V"),
        "fall of the offset": lambda r: fall(r, "robust", "offset"),
        "nominal's offset": lambda r: r.outcomes[NOMINAL].offset,
    }
    for key in _RANKED:
        rows[f"`{key}`"] = lambda r, key=key: r.draw.values.get(key)  # type: ignore[misc]
    lines = [f"| with | {' | '.join(f'`{name}`' for name in records)} |", "|---" * (len(records) + 1) + "|"]
    for words, of in rows.items():
        values = [rank(own, "robust", of) for own in records.values()]
        cells = ["–" if math.isnan(v) else f"{v:+.2f}".replace("-", "−") for v in values]
        lines.append(f"| {words} | {' | '.join(cells)} |")
    least = min((len(own) for own in records.values()), default=0)
    chance = (
        f"; chance alone stays below {1.96 / math.sqrt(least - 1):.2f} nineteen times in twenty" if least > 3 else ""
    )
    return [
        "Spearman's rank correlation of the reduction of motion by `robust` with what it changed before the impact",
        f"and with what was drawn{chance}. *Offset*: distance of the center of mass from the line of the impact.",
        "",
        *lines,
    ]


def by_v(records: Records) -> list[str]:
    """Helped where V fell, and where it rose."""
    lines = ["| scenario | controller | V lower | V higher |", "|---|---|---|---|"]
    for name, own in records.items():
        # A push gives its impulse, not its speed.
        for controller in controllers(name)[1:] if HELD not in controllers(name) else ():
            lower, higher = _v_parts(own, controller)
            lines.append(f"| `{name}` | `{controller}` | {_part(lower)} | {_part(higher)} |")
    return ["Where a controller's V before the impact was lower than nominal's, and where it was not:", "", *lines]


def _part(part: Split) -> str:
    return f"{part.helps}/{part.count}, {percent(part.median)}" if part.count else "none"


def splits(records: Records) -> list[str]:
    """By mounting, armature and K."""
    middle = {r.name: math.sqrt(r.low * r.high) for ranges in RANGES.values() for r in ranges if r.scale == "log"}
    ways: list[tuple[str, str, Callable[[Record], bool]]] = [
        (f"shoulder less than {_UNDER:g} m from under the center", "x", lambda r: abs(r.draw.values["x"]) < _UNDER),
        *(
            (f"`{key}` below {middle[key]:.2g} × the scenario's", key,
             lambda r, key=key: r.draw.values[key] < middle[key])  # type: ignore[misc]
            for key in ("armature", "gain")
        ),
    ]  # fmt: skip
    lines = ["| scenario | split | controller | so | otherwise |", "|---|---|---|---|---|"]
    for name, own in records.items():
        keys = {r.name for r in RANGES[name]}
        for words, key, choose in ways:
            for controller in ("robust", "posture"):
                # The offline optimum knows no K; under a wall's impact it is the height that matters.
                if (
                    key in keys
                    and (name, key) != ("aerial-lateral", "x")
                    and (key, controller) != ("gain", "posture")
                ):
                    so, otherwise = split(own, controller, choose)
                    lines.append(f"| `{name}` | {words} | `{controller}` | {_part(so)} | {_part(otherwise)} |")
    return ["Less motion in how many, and the median change:", "", *lines]


def counterexamples(records: Records) -> list[str]:
    """By name, with what it takes to see them again."""
    lines = []
    for name, own in records.items():
        bad, wrong = worst(own, "robust"), misled(own, "robust")
        failed = [r for r in own if r.outcomes["robust"].failure]
        if bad is not None and change(bad, "robust") > 0:
            lines += ["- Worst motion: " + _case(bad)]
        else:
            lines += [f"- `{name}`: `robust` moved the robot more than nominal in none."]
        if wrong is not None:
            lines += ["- H fell most and the jump rose: " + _case(wrong)]
        else:
            lines += [f"- `{name}`: in none did H fall and the jump rise."]
        for record in failed[:2]:
            lines += [f"- Failed, {record.outcomes['robust'].failure}: {_where(record)}."]
    return [
        "Of `robust` against `nominal`; each can be run again with `python -m tests.benchmarks.robustness_study",
        "--scenarios NAME --configuration NUMBER`.",
        "",
        *lines,
    ]


def _where(record: Record) -> str:
    values = ", ".join(f"{key} {value:.4g}" for key, value in record.draw.values.items()).replace("-", "−")
    return f"`{record.draw.scenario}` number {record.draw.number} ({values})"


def _case(record: Record) -> str:
    nominal, own = record.outcomes[NOMINAL], record.outcomes["robust"]
    return (
        f"{_where(record)}: motion {percent(change(record, 'robust'))}, "
        f"jump {percent(change(record, 'robust', 'peak_jump'))}, "
        f"H {nominal.H:.3g} → {own.H:.3g}, V {nominal.V:.3g} → {own.V:.3g}; `posture` "
        f"{_motion_and_jump(record, 'posture')}."
    )


def _motion_and_jump(record: Record, controller: str) -> str:
    failure = record.outcomes[controller].failure
    if failure:
        return failure
    return f"{percent(change(record, controller))}, jump {percent(change(record, controller, 'peak_jump'))}"


def drawn(records: Records, seed: int) -> list[str]:
    """Ranges, what is fixed, what was drawn again."""
    lines = [f"Seed {seed}; uniform, unless it says otherwise.", ""]
    lines += range_table(list(records))
    lines += [
        "",
        "The pushes have no mounting to vary: where a push acts is the frame.",
        f"Contacts: {COUNT} a run, {DWELL:g} s behind the surface, {PAUSE:g} s between them; each push one way.",
        f"A robot that does not come to rest is pushed {PATIENCE:g} s late. Noise of seed 0; else as in the files.",
        "",
        f"A draw is taken if the motors hold its start with {100 * SHARE:.0f} % of their limits and the nominal",
        "controller gets through: it makes all contacts, or comes to rest before the push, does not fall, and is at",
        f"a limit for at most {100 * SATURATED:.0f} % of the time outside the impact windows. Else, another draw:",
        "",
    ]
    for name, own in records.items():
        reasons = Counter(reason for record in own for reason in record.rejected)
        words = "; ".join(f"{reason}: {n}" for reason, n in sorted(reasons.items(), key=lambda item: -item[1]))
        total = sum(reasons.values())
        lines.append(
            f"- `{name}`: {len(own)} configurations, {total} draws rejected{f' ({words})' if words else ''}."
        )
    return lines


def range_table(scenarios: Sequence[str]) -> list[str]:
    """What varies, and how far."""
    lines = ["| scenario | value | range | what it is |", "|---|---|---|---|"]
    for name in scenarios:
        lines += [f"| `{name}` | `{r.name}` | {r.text()} | {r.words} |" for r in RANGES[name]]
    return lines
