"""Page about the targets that each controller meets in variations of a scenario (the envelope)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

from docs.studies.core import table
from docs.studies.robustness.draws import COUNT, DWELL, PAUSE
from docs.studies.robustness.outcomes import COMPARED, NOMINAL, Record
from docs.studies.robustness.statistics import change, quantile, summarize, tried
from docs.studies.robustness.variations import SHIPPED, VARIATIONS
from impact_posture.experiment.reproduction import PAPER
from impact_posture.simulation.controllers.controller_factory import MEANING

Records = Mapping[str, Sequence[Record]]
# A controller is recommended only if it meets every target in at least this share of the variations.
_OFTEN = 2 / 3
# Number of variations that a sentence of the page lists.
_TOLD = 7
_NAMES = {
    "reduction": "reduction below the paper's", "recovery": "no reduction over the second",
    "peak_jump": "higher jump", "peak_recovery": "higher peak in the second",
    "saturation": "more saturation inside",
    "saturation_outside": "more saturation outside", "stops": "on a stop", "rested": "not at rest",
    "completed": "failed",
}  # fmt: skip
# For each scenario: choices of our own, and the variation that shows the effect of each.
_DEVIATIONS = {
    "aerial-vertical": {
        "the arm is mounted below the base's center, 8 cm behind its place in the URDF": "mounted as in the URDF"
    },
    "aerial-lateral": {
        "the arm is mounted below the base's center, 8 cm behind its place in the URDF": "mounted as in the URDF",
        "the robot approaches at 0.3 m/s, because the rotors hardly push sideways": "speed × 1.67 (as vertical)",
    },
}
_HEAD = (
    "scenario|controller|all targets kept|motion in the window: median [quartiles]|over the second: median "
    "[quartiles]|jump: median|force over nominal's: median, largest|saturated, s: inside + outside|targets missed, "
    "points"
).split("|")


def page(records: Records) -> Iterator[str]:
    yield from ("### What to choose", "")
    yield from (choice(name, own) for name, own in records.items() if tried(own))
    yield from (_tuned(name, own) for name, own in records.items() if sum(bool(r.draw.name) for r in tried(own)) > 1)
    yield ""
    yield from _counts(records)
    yield from ("", "### Over the envelope", "")
    rows = [_overview(name, own, c) for name, own in records.items() if tried(own) for c in COMPARED]
    yield from table(_HEAD, rows)
    yield from ("", "### One thing at a time", "", *_explained(), "")
    for name, own in records.items():
        yield from (f"`{name}`:", "", *_variations(own), "")
    yield from ("### What our own choices change", "", *_deviations(records))


def percent(value: float) -> str:
    """Write a relative change as text.  Infinity stands for a failed run."""
    return "fails" if value == math.inf else f"{100 * value:+.0f} %".replace("-", "−")


def spread(values: Sequence[float]) -> str:
    """Write median and quartiles of a relative change as text."""
    low, middle, high = (percent(v) for v in values)
    return f"{middle} [{low}, {high}]"


def choice(name: str, own: Sequence[Record]) -> str:
    """Return the controller that meets every target most often.  In case of a tie, choose the least motion."""
    summaries = [summarize(own, c) for c in COMPARED if c != NOMINAL]
    best = min(summaries, key=lambda s: (-s.kept, s.motion[1]))
    reliable = best.kept >= _OFTEN * best.count
    lead = "Take" if reliable else "No controller keeps its targets reliably. The best is"
    words = (
        f"- **{name}**: {lead} `{best.controller}` ({MEANING[best.controller]}). "
        f"It keeps every target at {best.kept} of {best.count} points. It changes the motion by "
        f"{percent(best.motion[1])} at the median (quartiles {percent(best.motion[0])} and {percent(best.motion[2])})"
    )
    if name.startswith("aerial"):
        words += f", with {best.force[0]:.1f} times the peak force"
    others = ", ".join(
        f"`{s.controller}` {s.kept} (motion {percent(s.motion[1])})" for s in summaries if s is not best
    )
    return f"{words}. Points at which other controllers keep every target: {others}."


def _tuned(name: str, own: Sequence[Record]) -> str:
    """Compare the controllers ``robust`` (term with a gain) and ``robust-flow`` (no gain) in single variations."""
    parts = []
    for controller in ("robust", "robust-flow"):
        named = [(r.draw.name, change(r, controller)) for r in tried(own) if r.draw.name]
        (_, shipped), *others = named
        # List only the first variations, which are the most important.  The table has all variations.
        changes = ", ".join(f"{percent(value)} ({words})" for words, value in others[:_TOLD])
        changed = f"`{controller}` changes the motion by {percent(shipped)}"
        parts.append(f"{changed} as shipped, and otherwise by {changes}")
    return f"- **How far {name} is tuned:** {'. '.join(parts)}."


def _counts(records: Records) -> Iterator[str]:
    counts = []
    for name, own in records.items():
        draws, lacking = sum(not r.draw.name for r in own), [r for r in own if not r.documents]
        words = f"in `{name}`, {len(own) - draws} variations one at a time and {draws} random draws"
        if lacking:
            reasons = ", ".join(f"{r.draw.name} ({r.rejected[-1]})" for r in lacking)
            words += f", without the points at which nominal itself fails: {reasons}"
        counts.append(words)
    planned = sum(len(VARIATIONS[name]) for name in records)
    yield f"Points: {'; '.join(counts)}."
    yield f"The plan has {planned} variations in all, and 40 random draws of each scenario."
    yield (
        f"The runs are shorter than the shipped scenarios: one seed of noise, {COUNT} contacts instead "
        f"of 5, {DWELL:g} s "
        f"behind the surface and {PAUSE:g} s between contacts; the pushes have both signs. So the second after "
        "an impact includes the motion back from the surface, for all controllers."
    )


def _overview(name: str, own: Sequence[Record], controller: str) -> list[str]:
    s = summarize(own, controller)
    limits = " + ".join(f"{seconds:.2f}" for seconds in s.saturation)
    if controller == NOMINAL:
        return [f"`{name}`", f"`{controller}`", *["–"] * 5, limits, "–"]
    force = f"{s.force[0]:.2f}, {s.force[1]:.2f}" if name.startswith("aerial") else "–"
    missed = ", ".join(f"{_NAMES[t]} {n}" for t, n in sorted(s.missed.items(), key=lambda item: -item[1]))
    cells = [f"{s.kept}/{s.count}", spread(s.motion), spread(s.recovery), percent(s.jump), force, limits]
    return [f"`{name}`", f"`{controller}`", *cells, missed or "none"]


def _explained() -> Iterator[str]:
    yield "Change of the motion in the window / over one second, relative to nominal at the same point. **Bold**:"
    yield "all targets are met. *Nominal*: motion of the nominal controller in the window."


def _variations(own: Sequence[Record]) -> Iterator[str]:
    others = [c for c in COMPARED if c != NOMINAL]
    rows = []
    for r in own:
        if r.draw.name:
            rows.append([r.draw.name, *(_cells(r, others) if r.documents else [r.rejected[-1]])])
    draws = [r for r in tried(own) if not r.draw.name]
    if draws:
        medians = [
            " / ".join(percent(quantile([change(r, c, m) for r in draws], 0.5)) for m in _MOTIONS) for c in others
        ]
        rows.append([f"median of {len(draws)} random draws", "–", *medians])
    return table(["changed", "nominal", *(f"`{c}`" for c in others)], rows)


_MOTIONS = ("q_total_impact", "q_total_recovery")


def _cells(record: Record, others: Sequence[str]) -> Iterator[str]:
    yield f"{record.documents[NOMINAL]['metrics']['q_total_impact']:.3g}"
    for controller in others:
        words = record.failure(controller) or " / ".join(percent(change(record, controller, m)) for m in _MOTIONS)
        yield words if record.missed(controller) else f"**{words}**"


def _deviations(records: Records) -> Iterator[str]:
    """List our own choices in a scenario, and their effects."""
    for name, deviations in _DEVIATIONS.items():
        known = {r.draw.name: r for r in records.get(name, ()) if r.draw.name}
        for words, variation in deviations.items():
            shipped, other = known.get(SHIPPED), known.get(variation)
            if shipped is None or other is None or not (shipped.documents and other.documents):
                reason = "not run yet" if other is None else (other.rejected or ("not run yet",))[-1]
                yield f"- `{name}`: {words}. Its effect is not known: {reason}."
                continue
            effects = "; ".join(
                f"`{c}` {percent(change(shipped, c))} becomes {other.failure(c) or percent(change(other, c))}"
                for c in COMPARED
                if c != NOMINAL
            )
            paper = percent(-PAPER[name].reduction)
            yield f"- `{name}`: {words}. Motion ({variation}): {effects} (the paper: {paper})."
    yield (
        "- `solo8-push` and `talos-push` do not change the robots. In all four scenarios, gains and "
        "sensors are choices."
    )
