"""What a user should choose, in sentences that the records write."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from tests.benchmarks.robustness.outcomes import AERIAL, HELD, NOMINAL, Record, controllers
from tests.benchmarks.robustness.statistics import Summary, agreement, change, fall, summarize

Records = Mapping[str, Sequence[Record]]
# A controller that helps less often than this, or at the median by less, is no advice.
_OFTEN, _MUCH = 2 / 3, 0.05
WORDS = {
    "aerial-vertical": "An arm that comes down on a floor",
    "aerial-lateral": "An arm that runs against a wall",
    "solo8-push": "A quadruped that is pushed",
    "talos-push": "A humanoid that is pushed",
}


def percent(value: float) -> str:
    """A relative change; what failed has none."""
    return "fails" if value == math.inf else f"{100 * value:+.0f} %".replace("-", "−")


def _change(summary: Summary) -> str:
    low, middle, high = (percent(v) for v in summary.quartiles)
    return f"median {middle}, quartiles {low} and {high}"


def _limits(summary: Summary) -> str:
    inside, outside = summary.saturation
    return f"{inside:.1f} + {outside:.1f}"


def choice_lines(records: Records) -> list[str]:
    """What to take, scenario by scenario, led by what helped most often."""
    lines = []
    for name, own in records.items():
        found = [summarize(own, c) for c in controllers(name) if c != NOMINAL]
        found.sort(key=lambda s: (-s.helps, s.quartiles[1]))
        best = found[0]
        good = best.helps >= _OFTEN * best.count and best.quartiles[1] <= -_MUCH
        lead = f"take `{best.controller}`: it" if good else f"nothing helps reliably; at best `{best.controller}`"
        others = "; ".join(f"`{s.controller}` in {s.helps} ({percent(s.quartiles[1])})" for s in found[1:])
        fails = sum(best.failures.values())
        lines.append(
            f"- **{WORDS[name]}** (`{name}`): {lead} moved the robot less than the nominal controller in "
            f"{best.helps} of {best.count} configurations ({_change(best)}), with a lower jump in {best.gentler}"
            f"{f', and failed in {fails}' if fails else ''}. At a control limit in all, in the windows + "
            f"outside: {_limits(best)} s, nominal {_limits(summarize(own, NOMINAL))} s. The others: {others}."
        )
    return [*lines, *_held_line(records), *_failed_line(records), *_v_line(records)]


def _held_line(records: Records) -> list[str]:
    pushed = {name: own for name, own in records.items() if HELD in controllers(name)}
    if not pushed:
        return []
    parts = []
    for name, own in pushed.items():
        live, held = (summarize(own, c).quartiles[1] for c in ("robust", HELD))
        if live > -_MUCH:
            what = "neither"
        elif held > -_MUCH:
            what = "stiffness, which a higher gain of the nominal controller gives as well"
        else:
            what = "mostly posture" if held <= live / 2 else "both"
        parts.append(f"`{name}` {percent(live)} live, {percent(held)} held: {what}")
    return [
        f"- **Posture or stiffness?** What is left when the term goes before the push is posture: {'; '.join(parts)}."
    ]


def _failed_line(records: Records) -> list[str]:
    found = []
    for name, own in records.items():
        for controller in controllers(name):
            failures = summarize(own, controller).failures
            if failures:
                words = ", ".join(f"{kind} in {n}" for kind, n in sorted(failures.items()))
                found.append(f"`{controller}` in `{name}` ({words} of {len(own)})")
    return [f"- **What failed:** {'; '.join(found)}."] if found else ["- **What failed:** nothing."]


def _v_line(records: Records) -> list[str]:
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
    if jump["V"] > jump["H"] and motion["V"] >= motion["H"]:
        lead = "Compare V before you trust a lower H."
    elif jump["V"] > jump["H"]:
        lead = "V tells better than H what becomes of the jump, not of the motion."
    else:
        lead = "V told no better than H."
    return [
        f"- **{lead}** `robust` came to a lower H in {len(fallen)} of {len(aerial)} aerial configurations; in {less} "
        f"of those the motion fell, in {lower} the jump. Of all {count} aerial runs of {_listed(AERIAL[1:])}, "
        f"the jump went the way of V in {jump['V']} and the way of H in {jump['H']}, the motion in {motion['V']} and "
        f"{motion['H']}."
    ]


def _listed(names: Sequence[str]) -> str:
    quoted = [f"`{name}`" for name in names]
    return f"{', '.join(quoted[:-1])} and {quoted[-1]}"
