"""The page of the study, all of it from the records: what to choose, in sentences, and tables."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence

from impact_posture.simulation.offline import SHARE
from tests.benchmarks.core import table
from tests.benchmarks.robustness.draws import COUNT, DWELL, PATIENCE, PAUSE, RANGES
from tests.benchmarks.robustness.outcomes import AERIAL, HELD, NOMINAL, SATURATED, Record, controllers
from tests.benchmarks.robustness.statistics import (
    Split,
    Summary,
    agreement,
    change,
    fall,
    misled,
    rank,
    split,
    summarize,
    worst,
)

Records = Mapping[str, Sequence[Record]]
# The page of the documentation takes what is before and what is after.
MARK = "<!-- tables -->"
# A controller that helps less often than this, or at the median by less, is no advice.
_OFTEN, _MUCH = 2 / 3, 0.05
# M: a shoulder that is less than this ahead of or behind the base's center is under it.
_UNDER = 0.04
# Drawn values whose rank correlation is shown.
_RANKED = ("x", "z", "speed", "force", "stiffness", "armature", "gain")
_OVERVIEW = (
    "scenario|controller|less motion|lower jump|both|motion: median [quartiles]|jump: median|no more saturation"
    "|saturated, s: inside + outside|on stops|failed"
).split("|")
_WORDS = {
    "aerial-vertical": "An arm that comes down on a floor",
    "aerial-lateral": "An arm that runs against a wall",
    "solo8-push": "A quadruped that is pushed",
    "talos-push": "A humanoid that is pushed",
}


def page(records: Records, seed: int) -> Iterator[str]:
    """All of it, as lines of Markdown."""
    yield from (*_choices(records), *_held(records), *_failed(records), *_by_V(records))
    yield from ("", MARK, "", "### How often each controller helps", "")
    yield from table(_OVERVIEW, [_overview(name, own, c) for name, own in records.items() for c in controllers(name)])
    yield from ("", "### What goes with success", "", *_ranks(records), "", *_V_splits(records), "")
    yield from (*_splits(records), "", "### Counterexamples", "", *_counterexamples(records), "")
    yield from ("### What was drawn", "", *_drawn(records, seed))


def percent(value: float) -> str:
    """A relative change; what failed has none."""
    return "fails" if value == math.inf else _minus(f"{100 * value:+.0f} %")


def _minus(text: str) -> str:
    return text.replace("-", "−")


# ---- what to choose -----------------------------------------------------------------------------------------------


def _choices(records: Records) -> Iterator[str]:
    """What to take, scenario by scenario, led by what helped most often."""
    for name, own in records.items():
        found = [summarize(own, c) for c in controllers(name) if c != NOMINAL]
        found.sort(key=lambda s: (-s.helps, s.quartiles[1]))
        best = found[0]
        good = best.helps >= _OFTEN * best.count and best.quartiles[1] <= -_MUCH
        lead = f"take `{best.controller}`: it" if good else f"nothing helps reliably; at best `{best.controller}`"
        others = "; ".join(f"`{s.controller}` in {s.helps} ({percent(s.quartiles[1])})" for s in found[1:])
        fails = sum(best.failures.values())
        low, middle, high = (percent(v) for v in best.quartiles)
        yield (
            f"- **{_WORDS[name]}** (`{name}`): {lead} moved the robot less than the nominal controller in "
            f"{best.helps} of {best.count} configurations (median {middle}, quartiles {low} and {high}), with a "
            f"lower jump in {best.gentler}{f', and failed in {fails}' if fails else ''}. At a control limit in all, "
            f"in the windows + outside: {_limits(best)} s, nominal {_limits(summarize(own, NOMINAL))} s. The others: "
            f"{others}."
        )


def _limits(summary: Summary) -> str:
    return " + ".join(f"{seconds:.1f}" for seconds in summary.saturation)


def _held(records: Records) -> list[str]:
    parts = []
    for name in (name for name in records if HELD in controllers(name)):
        live, held = (summarize(records[name], c).quartiles[1] for c in ("robust", HELD))
        if live > -_MUCH:
            what = "neither"
        elif held > -_MUCH:
            what = "stiffness, which a higher gain of the nominal controller gives as well"
        else:
            what = "mostly posture" if held <= live / 2 else "both"
        parts.append(f"`{name}` {percent(live)} live, {percent(held)} held: {what}")
    lead = "**Posture or stiffness?** What is left when the term goes before the push is posture"
    return [f"- {lead}: {'; '.join(parts)}."] if parts else []


def _failed(records: Records) -> list[str]:
    found = []
    for name, own in records.items():
        for controller in controllers(name):
            words = ", ".join(f"{kind} in {n}" for kind, n in sorted(summarize(own, controller).failures.items()))
            found += [f"`{controller}` in `{name}` ({words} of {len(own)})"] if words else []
    return [f"- **What failed:** {'; '.join(found) or 'nothing'}."]


def _by_V(records: Records) -> list[str]:
    aerial = [r for name, own in records.items() if HELD not in controllers(name) for r in own]
    if not aerial:
        return []
    fallen = [r for r in aerial if (fall(r, "robust", "H") or 0.0) > 0]
    less, lower = (sum(change(r, "robust", m) < 0 for r in fallen) for m in ("q_total_impact", "peak_jump"))
    count = agreement(aerial, AERIAL[1:], "V", "peak_jump")[1]
    jump, motion = (
        {name: agreement(aerial, AERIAL[1:], name, metric)[0] for name in ("V", "H")}
        for metric in ("peak_jump", "q_total_impact")
    )
    lead = "V told no better than H."
    if jump["V"] > jump["H"]:
        lead = "V tells better than H what becomes of the jump, not of the motion."
        lead = "Compare V before you trust a lower H." if motion["V"] >= motion["H"] else lead
    *first, last = (f"`{name}`" for name in AERIAL[1:])
    return [
        f"- **{lead}** `robust` came to a lower H in {len(fallen)} of {len(aerial)} aerial configurations; in {less} "
        f"of those the motion fell, in {lower} the jump. Of all {count} aerial runs of {', '.join(first)} and "
        f"{last}, the jump went the way of V in {jump['V']} and the way of H in {jump['H']}, the motion in "
        f"{motion['V']} and {motion['H']}."
    ]


# ---- tables -------------------------------------------------------------------------------------------------------


def _overview(name: str, own: Sequence[Record], controller: str) -> list[str]:
    s = summarize(own, controller)
    low, middle, high = (percent(v) for v in s.quartiles)
    cells = [f"{v}/{s.count}" for v in (s.helps, s.gentler, s.both)]
    cells += [f"{middle} [{low}, {high}]", percent(s.jump), f"{s.freer}/{s.count}"]
    failed = ", ".join(f"{kind} {n}" for kind, n in sorted(s.failures.items())) or "0"
    end = [f"{s.saturation[0]:.2f} + {s.saturation[1]:.1f}", str(s.stops), failed]
    return [f"`{name}`", f"`{controller}`", *(["–"] * 6 if controller == NOMINAL else cells), *end]


def _ranks(records: Records) -> Iterator[str]:
    """Rank correlations of the reduction by ``robust``."""
    rows: dict[str, Callable[[Record], float | None]] = {
        "fall of H": lambda r: fall(r, "robust", "H"),
        "fall of V": lambda r: fall(r, "robust", "V"),
        "fall of the offset": lambda r: fall(r, "robust", "offset"),
        "nominal's offset": lambda r: r.outcomes[NOMINAL].offset,
        **{f"`{key}`": lambda r, key=key: r.draw.values.get(key) for key in _RANKED},
    }
    least = min((len(own) for own in records.values()), default=0)
    bound = f"{1.96 / math.sqrt(least - 1):.2f}" if least > 3 else ""
    chance = f"; chance alone stays below {bound} nineteen times in twenty" if bound else ""
    yield (
        "Spearman's rank correlation of the reduction of motion by `robust` with what it changed before the impact "
        f"and\nwith what was drawn{chance}. *Offset*: distance of the center of mass from the line of the impact."
    )
    yield ""
    found = {words: [rank(own, "robust", of) for own in records.values()] for words, of in rows.items()}
    body = [[words, *("–" if math.isnan(v) else _minus(f"{v:+.2f}") for v in row)] for words, row in found.items()]
    yield from table(["with", *(f"`{name}`" for name in records)], body)


def _V_splits(records: Records) -> Iterator[str]:
    yield from ("Where a controller's V before the impact was lower than nominal's, and where it was not:", "")
    body = []
    for name, own in records.items():
        # A push gives its impulse, not its speed.
        for controller in controllers(name)[1:] if HELD not in controllers(name) else ():
            known = [r for r in own if fall(r, controller, "V") is not None]
            parts = split(known, controller, lambda r, c=controller: (fall(r, c, "V") or 0.0) > 0)
            body.append([f"`{name}`", f"`{controller}`", *map(_part, parts)])
    yield from table(["scenario", "controller", "V lower", "V higher"], body)


def _part(part: Split) -> str:
    return f"{part.helps}/{part.count}, {percent(part.median)}" if part.count else "none"


def _splits(records: Records) -> Iterator[str]:
    """By mounting, armature and K."""
    middle = {r.name: math.sqrt(r.low * r.high) for ranges in RANGES.values() for r in ranges if r.scale == "log"}
    words = {key: f"`{key}` below {middle[key]:.2g} × the scenario's" for key in ("armature", "gain")}
    yield from ("Less motion in how many, and the median change:", "")
    body = []
    for name, own in records.items():
        for key in ("x", *words) if name == "aerial-vertical" else words:
            # The offline optimum knows no K; in the impact against a wall it is the height that matters.
            for controller in ("robust",) if key == "gain" else ("robust", "posture"):
                limit = middle.get(key, _UNDER)
                so, otherwise = split(own, controller, lambda r, k=key, m=limit: abs(r.draw.values[k]) < m)
                about = words.get(key, f"shoulder less than {_UNDER:g} m from under the center")
                body.append([f"`{name}`", about, f"`{controller}`", _part(so), _part(otherwise)])
    yield from table(["scenario", "split", "controller", "so", "otherwise"], body)


def _counterexamples(records: Records) -> Iterator[str]:
    """By name, with what it takes to see them again."""
    yield "Of `robust` against `nominal`; each can be run again with `python -m tests.benchmarks robustness"
    yield from ("--only NAME --number NUMBER`.", "")
    for name, own in records.items():
        bad, wrong = worst(own, "robust"), misled(own, "robust")
        if bad is not None and change(bad, "robust") > 0:
            yield "- Worst motion: " + _case(bad)
        else:
            yield f"- `{name}`: `robust` moved the robot more than nominal in none."
        if wrong is not None:
            yield "- H fell most and the jump rose: " + _case(wrong)
        else:
            yield f"- `{name}`: in none did H fall and the jump rise."
        for record in [r for r in own if r.outcomes["robust"].failure][:2]:
            yield f"- Failed, {record.outcomes['robust'].failure}: {_where(record)}."


def _where(record: Record) -> str:
    values = _minus(", ".join(f"{key} {value:.4g}" for key, value in record.draw.values.items()))
    return f"`{record.draw.scenario}` number {record.draw.number} ({values})"


def _case(record: Record) -> str:
    nominal, own, posture = (record.outcomes[name] for name in (NOMINAL, "robust", "posture"))
    motion, other = (
        f"{percent(change(record, name))}, jump {percent(change(record, name, 'peak_jump'))}"
        for name in ("robust", "posture")
    )
    return (
        f"{_where(record)}: motion {motion}, H {nominal.H:.3g} → {own.H:.3g}, V {nominal.V:.3g} → {own.V:.3g}; "
        f"`posture` {posture.failure or other}."
    )


def _drawn(records: Records, seed: int) -> Iterator[str]:
    """Ranges, what is fixed, what was drawn again."""
    yield from (f"Seed {seed}; uniform, unless it says otherwise.", "", *range_table(list(records)), "")
    yield "The pushes have no mounting to vary: where a push acts is the frame."
    yield f"Contacts: {COUNT} a run, {DWELL:g} s behind the surface, {PAUSE:g} s between them; each push one way."
    yield f"A robot that does not come to rest is pushed {PATIENCE:g} s late. Noise of seed 0; else as in the files."
    yield ""
    yield f"A draw is taken if the motors hold its start with {100 * SHARE:.0f} % of their limits and the nominal"
    yield "controller gets through: it makes all contacts, or comes to rest before the push, does not fall, and is at"
    yield f"a limit for at most {100 * SATURATED:.0f} % of the time outside the impact windows. Else, another draw:"
    yield ""
    for name, own in records.items():
        reasons = Counter(reason for record in own for reason in record.rejected)
        words = "; ".join(f"{reason}: {n}" for reason, n in sorted(reasons.items(), key=lambda item: -item[1]))
        total = reasons.total()
        yield f"- `{name}`: {len(own)} configurations, {total} draws rejected{f' ({words})' if words else ''}."


def range_table(scenarios: Sequence[str]) -> Iterator[str]:
    """What varies, and how far."""
    body = [[f"`{name}`", f"`{r.name}`", r.text(), r.words] for name in scenarios for r in RANGES[name]]
    return table(["scenario", "value", "range", "what it is"], body)
