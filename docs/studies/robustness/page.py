"""Page about where controllers help: recommendations, then tables.  Both are computed from stored records."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence

from docs.studies.core import table
from docs.studies.robustness.draws import PATIENCE
from docs.studies.robustness.envelope import choice, percent, spread
from docs.studies.robustness.outcomes import COMPARED, NOMINAL, SATURATED, Record
from docs.studies.robustness.statistics import (
    PREDICTORS,
    Split,
    agreement,
    change,
    fall,
    misled,
    predicted,
    rank,
    ranks_of_jumps,
    split,
    summarize,
    tried,
    worst,
)
from docs.studies.robustness.variations import RANGES
from impact_posture.simulation.offline_posture import SHARE

Records = Mapping[str, Sequence[Record]]
# The documentation includes the text before this mark in one place, and the text after this mark in another place.
MARK = "<!-- tables -->"
# A shoulder at most this horizontal distance from the center of the base is treated as under the center, m.
_UNDER = 0.04
# Drawn values for which the page shows rank correlations.
_RANKED = ("x", "z", "speed", "force", "stiffness", "armature", "gain", "contact", "friction")
_OVERVIEW = (
    "scenario|controller|less motion|lower jump|motion: median [quartiles]|jump: median|saturated, s: inside + "
    "outside|failed"
).split("|")


def page(records: Records, seed: int) -> Iterator[str]:
    records = {name: own for name, own in records.items() if tried(own)}
    yield from (choice(name, own) for name, own in records.items())
    yield from (*_stiffness(records), *_failed(records), *_predictors(records))
    yield from ("", MARK, "", "### How often each controller helps", "")
    yield from table(_OVERVIEW, [_overview(name, own, c) for name, own in records.items() for c in COMPARED])
    yield from ("", "### What predicts the jump", "", *_jump_ranks(records))
    yield from ("", "### What goes with success", "", *_ranks(records), "")
    yield from (*_splits(records), "", "### Counterexamples", "", *_counterexamples(records), "")
    yield from ("### What was drawn", "", *_drawn(records, seed))


def _minus(text: str) -> str:
    return text.replace("-", "−")


def _is_contact(name: str) -> bool:
    return name.startswith("aerial")


def _stiffness(records: Records) -> list[str]:
    """Compare the effect of the term's stiffness alone with the effect of the offline posture alone."""
    parts = []
    for name, own in records.items():
        term, stiff, posture = (summarize(own, c).motion[1] for c in ("robust", "stiff", "posture"))
        what = "the stiffness helps" if stiff < min(term, posture) else "both help"
        what = "the posture helps" if posture < stiff / 2 else what
        parts.append(
            f"In `{name}` the median motion changes by {percent(stiff)} with `stiff` and by {percent(posture)} with "
            f"`posture`: {what}."
        )
    lead = (
        "**Posture or stiffness?** `stiff` keeps the start posture with the stiffness of the term; "
        "`posture` takes the "
        "offline optimum, without this stiffness."
    )
    return [f"- {lead} {' '.join(parts)}"] if parts else []


def _failed(records: Records) -> list[str]:
    failures = []
    for name, own in records.items():
        for controller in COMPARED:
            summary = summarize(own, controller)
            words = ", ".join(f"{kind} {n}" for kind, n in sorted(summary.failures.items()))
            failed = sum(summary.failures.values())
            if words:
                failures.append(f"`{controller}` in `{name}` at {failed} of {summary.count} points ({words})")
    return [f"- **What failed:** {'; '.join(failures) or 'nothing'}."]


def _predictors(records: Records) -> list[str]:
    """State which of S, V and H predicts the velocity jump of a contact best."""
    aerial = {name: own for name, own in records.items() if _is_contact(name)}
    if not aerial:
        return []
    ranks = {name: ranks_of_jumps(own, tuple(PREDICTORS)) for name, own in aerial.items()}
    least = {key: min(correlations[key] for correlations in ranks.values()) for key in PREDICTORS}
    best = max(PREDICTORS, key=lambda key: -math.inf if math.isnan(least[key]) else least[key])
    parts = " and ".join(
        f"in `{name}` {', '.join(f'{_signed(correlations[key])} with {key}' for key in PREDICTORS)}"
        for name, correlations in ranks.items()
    )
    every = [r for own in aerial.values() for r in tried(own)]
    names = [c for c in COMPARED if c != NOMINAL]
    count = agreement(every, names, "S", "peak_jump")[1]
    same = {
        key: [agreement(every, names, key, metric)[0] for metric in ("peak_jump", "q_total_impact")]
        for key in PREDICTORS
    }
    ways = ", ".join(f"{key} for {jump} jumps and {motion} motions" for key, (jump, motion) in same.items())
    return [
        f"- **{best} predicts the jump of a contact best.** Rank correlations of the measured jump, over all "
        f"points and controllers: {parts}. In {count} runs, the sign of the change against nominal is predicted "
        f"correctly by {ways}."
    ]


def _overview(name: str, own: Sequence[Record], controller: str) -> list[str]:
    s = summarize(own, controller)
    cells = [f"{v}/{s.count}" for v in (s.helps, s.gentler)] + [spread(s.motion), percent(s.jump)]
    failed = ", ".join(f"{kind} {n}" for kind, n in sorted(s.failures.items())) or "0"
    end = [f"{s.saturation[0]:.2f} + {s.saturation[1]:.1f}", failed]
    return [f"`{name}`", f"`{controller}`", *(["–"] * 4 if controller == NOMINAL else cells), *end]


def _jump_ranks(records: Records) -> Iterator[str]:
    yield (
        "Spearman's rank correlation of the measured jump with what each number predicts, over all points and\n"
        "controllers: $v\\sqrt V$ without friction, $v\\sqrt S$ where the contact sticks, $v\\sqrt C$ with the "
        "friction of\nthe surface, and $\\sqrt H$. A push has an impulse and no speed, so only H can predict it."
    )
    yield ""
    body = []
    for name, own in records.items():
        correlations = ranks_of_jumps(own, tuple(PREDICTORS) if _is_contact(name) else ("H",))
        cells = (_signed(correlations.get(key, math.nan)) for key in PREDICTORS)
        body.append([f"`{name}`", f"{correlations['n']:.0f}", *cells])
    yield from table(["scenario", "runs", *(f"{key}" for key in PREDICTORS)], body)


def _signed(value: float) -> str:
    return "–" if math.isnan(value) else _minus(f"{value:+.2f}")


def _ranks(records: Records) -> Iterator[str]:
    """Yield rank correlations of the reduction of motion by the controller ``robust``."""
    rows: dict[str, Callable[[Record], float | None]] = {
        **{f"fall of {key}": lambda r, key=key: fall(r, "robust", key) for key in ("H", "V", "S")},
        "fall of the offset": lambda r: fall(r, "robust", "offset"),
        "nominal's offset": lambda r: r.documents[NOMINAL]["offset"],
        **{f"`{key}`": lambda r, key=key: r.draw.values.get(key) for key in _RANKED},
    }
    least = min((len(tried(own)) for own in records.values()), default=0)
    bound = f"{1.96 / math.sqrt(least - 1):.2f}" if least > 3 else ""
    chance = f"; chance alone stays below {bound} nineteen times in twenty" if bound else ""
    yield (
        "Spearman's rank correlation of the reduction of motion by `robust` with its changes before the impact "
        f"and\nwith the drawn values{chance}. *Offset*: distance of the center of mass from the line of the impact."
    )
    yield ""
    correlations = {words: [rank(tried(own), "robust", of) for own in records.values()] for words, of in rows.items()}
    body = [[words, *map(_signed, row)] for words, row in correlations.items()]
    yield from table(["with", *(f"`{name}`" for name in records)], body)


def _part(part: Split) -> str:
    return f"{part.helps}/{part.count}, {percent(part.median)}" if part.count else "none"


def _splits(records: Records) -> Iterator[str]:
    """Compare random draws with small values of mounting, armature or gain K with draws with large values."""
    middle = {r.name: math.sqrt(r.low * r.high) for ranges in RANGES.values() for r in ranges if r.scale == "log"}
    words = {key: f"`{key}` below {middle[key]:.2g} × the scenario's" for key in ("armature", "gain")}
    body = []
    for name, own in records.items():
        drawn = [r for r in tried(own) if not r.draw.name]
        for key in ("x", *words) if name == "aerial-vertical" else words:
            # The offline optimum does not depend on K, so leave out ``posture``.  Only the runs of the
            # vertical impact are split by x, the distance of the shoulder ahead of the base.
            for controller in ("robust",) if key == "gain" else ("robust", "posture"):
                limit = middle.get(key, _UNDER)
                so, otherwise = split(drawn, controller, lambda r, k=key, m=limit: abs(r.draw.values[k]) < m)
                about = words.get(key, f"shoulder less than {_UNDER:g} m from under the center")
                body.append([f"`{name}`", about, f"`{controller}`", _part(so), _part(otherwise)])
    if any(not r.draw.name for own in records.values() for r in own):
        yield from ("Number of random draws with less motion, and the median change of the motion:", "")
        yield from table(["scenario", "split", "controller", "so", "otherwise"], body)


def _counterexamples(records: Records) -> Iterator[str]:
    """List counterexamples, each with the command that repeats the run."""
    yield "These runs compare `robust` with `nominal`. `python -m docs.studies points --only NAME --number NUMBER`"
    yield from ("runs one of them again.", "")
    for name, every in records.items():
        own = tried(every)
        bad, wrong = worst(own, "robust"), misled(own, "robust")
        if bad is not None and change(bad, "robust") > 0:
            yield "- `robust` moves the robot most, compared with nominal, in " + _case(bad)
        else:
            yield f"- In `{name}`, `robust` never moves the robot more than nominal."
        if wrong is not None:
            yield "- The jump rises although H falls most in " + _case(wrong)
        else:
            yield f"- In `{name}`, the jump never rises where H falls."
        for record in [r for r in own if r.failure("robust")][:2]:
            yield f"- `robust` fails in {_where(record)}: {record.failure('robust')}."


def _where(record: Record) -> str:
    values = _minus(", ".join(f"{key} {value:.4g}" for key, value in record.draw.values.items()))
    return f"`{record.draw.scenario}` number {record.draw.number} ({record.draw.name or values})"


def _case(record: Record) -> str:
    motion, other = (
        f"{percent(change(record, name))}, jump {percent(change(record, name, 'peak_jump'))}"
        for name in ("robust", "posture")
    )
    numbers = []
    for key in ("H", "S"):
        before, after = (predicted(record, c, key) for c in (NOMINAL, "robust"))
        if before is not None and after is not None:
            label = "√H" if key == "H" else "v√S"
            numbers.append(f"{label} {before:.3g} → {after:.3g}")
    return (
        f"{_where(record)}: motion {motion}, {', '.join(numbers)}. With `posture`: "
        f"{record.failure('posture') or f'motion {other}'}."
    )


def _drawn(records: Records, seed: int) -> Iterator[str]:
    """Yield the ranges of drawn values, the fixed values and the number of rejected draws."""
    yield f"The seed is {seed}. Distributions are uniform unless the table says otherwise."
    yield from ("", *range_table(list(records)), "")
    yield (
        "Pushes have no mounting to vary, because a push acts at the frame. [The reproduction](reproduction.md) lists"
    )
    yield "the variations one at a time. A robot that does not come to rest is pushed"
    yield (
        f"{PATIENCE:g} s late. All runs have the noise of seed 0. Everything else is as in the files of "
        "the scenarios."
    )
    yield ""
    yield f"A draw is accepted if the motors can hold its start with {100 * SHARE:.0f} % of their limits and the"
    yield "nominal controller succeeds: it makes all contacts, or comes to rest before the push, does not fall, and"
    yield f"is at a limit for at most {100 * SATURATED:.0f} % of the time outside the impact windows. Otherwise"
    yield "another draw replaces this draw."
    yield ""
    for name, own in records.items():
        drawn = [record for record in own if not record.draw.name]
        reasons = Counter(reason for record in drawn for reason in record.rejected)
        words = "; ".join(f"{reason}: {n}" for reason, n in sorted(reasons.items(), key=lambda item: -item[1]))
        yield f"- `{name}`: {len(drawn)} random draws, {reasons.total()} rejected{f' ({words})' if words else ''}."


def range_table(scenarios: Sequence[str]) -> Iterator[str]:
    body = [[f"`{name}`", f"`{r.name}`", r.text(), r.words] for name in scenarios for r in RANGES[name]]
    return table(["scenario", "value", "range", "what it is"], body)
