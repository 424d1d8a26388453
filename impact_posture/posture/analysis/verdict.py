"""The verdict on an optimal posture: how jump, impulse and force change at the given approach speed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import sqrt
from typing import Literal

from impact_posture.config.json_block import json_block
from impact_posture.impact.elasticity.contact_compression import both_models
from impact_posture.impact.evaluation.coulomb_jump import CoulombJump, coulomb_jump
from impact_posture.impact.evaluation.evaluation import Evaluation
from impact_posture.impact.evaluation.velocity_jump import Jump
from impact_posture.impact.resolved_impact import ResolvedImpact

Outcome = Literal[
    "better", "better at the price of force", "better at the price of impulse", "no better", "worse", "unknown"
]

# A relative change below this value is treated as no change.
_SAME = 0.01


@dataclass(frozen=True)
class PredictedImpact:
    """The predicted impact in one posture at the given approach speed; ``jump`` is ``‖Δν‖_W``.

    Attributes:
        impulse: Normal impulse at the first contact, N·s.
        peak_force: Largest normal force with the friction of the contact, N; ``None`` if no contact stiffness is
            given, or for several contacts.
        sticks: Whether the first contact point sticks; ``None`` if the jump was computed without friction.
    """

    jump: float
    impulse: float
    peak_force: float | None
    sticks: bool | None

    def to_dict(self) -> dict[str, object]:
        """Return JSON content."""
        return json_block(self)


@dataclass(frozen=True)
class Verdict:
    """Changes from the initial to the optimal posture, at the given approach speed and friction.

    Attributes:
        outcome: Verdict in a few words, one of the values of ``Outcome``.
        line: One sentence that describes the verdict.
        jump: Relative change of ``‖Δν‖_W``; ``None`` if it is unknown.
        impulse: Relative change of the normal impulse.
        peak_force: Relative change of the peak force with friction; ``None`` if it is unknown.
        advice: Advice, one line each: the jump without friction, a better objective, or a more accurate joint model.
        before, after: The predicted impact in the initial and in the optimal posture; ``None`` if it is unknown.
        assumptions: Assumptions behind the numbers, one line each.
    """

    outcome: Outcome
    line: str
    jump: float | None
    impulse: float | None
    peak_force: float | None
    advice: tuple[str, ...]
    before: PredictedImpact | None = None
    after: PredictedImpact | None = None
    assumptions: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, object]:
        """Return JSON content."""
        return json_block(self)


def verdict(impact: ResolvedImpact, before: Evaluation, after: Evaluation) -> Verdict:
    """Compare the predicted jumps of the initial and the optimal posture.

    Jumps, impulses and forces include the friction of the contact.  Peak forces are for the given contact stiffness,
    or for a linear contact of any stiffness, ``F ∝ √m`` with the effective mass m with friction.  Several contacts
    are struck at the same time.  If the jump of this impact is unknown at one of the postures, only the first contact
    is compared.
    """
    together = bool(before.together and after.together)
    pair = _jump(before, together), _jump(after, together)
    if impact.speed <= 0 or pair[0] is None or pair[1] is None:
        why = "there is no approach speed" if impact.speed <= 0 else "the contact cannot move along the normal"
        return Verdict("unknown", f"no verdict: {why}.", None, None, None, ())
    jump, impulse = _change(pair[0].norm, pair[1].norm), _change(pair[0].normal_impulse, pair[1].normal_impulse)
    force = _force_change(before, after)
    outcome: Outcome = "better at the price of impulse" if impulse > _SAME else "better"
    if (force or 0.0) > _SAME:
        outcome = "better at the price of force"
    if jump > _SAME:
        outcome = "worse"
    elif jump > -_SAME:
        outcome = "no better"
    where = f" at {impact.contact.frame}" if together else ""
    parts = [
        f"the jump {_in_words(jump)} ({pair[0].norm:.3g} to {pair[1].norm:.3g}{_slip(pair[1])})",
        f"the normal impulse{where} {_in_words(impulse)} "
        f"({pair[0].normal_impulse:.3g} to {pair[1].normal_impulse:.3g} N·s)",
    ]
    if force is not None:
        parts.append(f"the peak force {_in_words(force)}{_newtons(before, after)}")
    contact = f"with friction {impact.contact.friction:g}" if isinstance(pair[1], CoulombJump) else "without friction"
    if impact.objective.others:
        contact += ", all contacts at once," if together else f", at {impact.contact.frame} alone,"
    line = f"verdict: {outcome}. At {impact.speed:g} m/s {contact} {', '.join(parts[:-1])} and {parts[-1]}."
    advice = (
        *_without_friction(before, after, jump),
        *_better_objective(impact, outcome, (pair[0], pair[1])),
        *_other_joint_model(impact, before, after),
    )
    sides = _predicted(before, pair[0]), _predicted(after, pair[1])
    assumptions = _assumptions(impact, after, pair[1], together, force)
    return Verdict(outcome, line, jump, impulse, force, advice, *sides, assumptions)


def _predicted(evaluation: Evaluation, jump: Jump) -> PredictedImpact:
    # If several contacts are struck at the same time, their forces are unknown.
    compression = None if evaluation.contacts else evaluation.compression
    peak = None if compression is None else compression.peak_force
    return PredictedImpact(
        jump.norm, jump.normal_impulse, peak, jump.sticks if isinstance(jump, CoulombJump) else None
    )


def _assumptions(
    impact: ResolvedImpact, after: Evaluation, jump: Jump, together: bool, force: float | None
) -> tuple[str, ...]:
    friction = f"with friction {impact.contact.friction:g}" if isinstance(jump, CoulombJump) else "without friction"
    # Impacts at several contacts at the same time are treated as plastic.
    restitution = 0.0 if together else impact.restitution
    stated = "the stated contact" if impact.contact_stiffness else "a linear contact, the same before and after"
    return (
        f"rigid impact at {impact.speed:g} m/s with restitution {restitution:g}, {friction}",
        f"jump in the {impact.objective.metric.kind} metric, with joint model '{impact.robot.joint_model}'",
        *(("the feet stay on the ground",) if impact.objective.supports else ()),
        *(f"the impulse acts at the contact point, although {touch.fact}" for touch in impact.early_touches(after.q)),
        *((f"peak force of {stated}, {friction}",) if force is not None else ()),
    )


def _jump(evaluation: Evaluation, together: bool) -> Jump | None:
    if evaluation.together and together:
        return evaluation.together[0]
    return evaluation.coulomb or evaluation.frictionless


def _change(before: float, after: float) -> float:
    return after / before - 1 if before > 0 else 0.0


def _in_words(change: float) -> str:
    if abs(change) <= _SAME:
        return "stays"
    size = f"{100 * abs(change):.0f} %" if change < 1 else f"a factor of {1 + change:.3g}"
    return f"{'falls' if change < 0 else 'grows'} by {size}"


def _slip(jump: Jump) -> str:
    return "" if not isinstance(jump, CoulombJump) else ", sticking" if jump.sticks else ", slipping"


def _force_change(before: Evaluation, after: Evaluation) -> float | None:
    if before.contacts or before.contact_mass is None or after.contact_mass is None:
        return None
    first, second = before.compression, after.compression
    if first and second and first.peak_force is not None and second.peak_force is not None:
        return _change(first.peak_force, second.peak_force)
    return sqrt(after.contact_mass / before.contact_mass) - 1


def _newtons(before: Evaluation, after: Evaluation) -> str:
    first, second = before.compression, after.compression
    if not (first and second) or first.peak_force is None or second.peak_force is None:
        return " (linear contact)"
    return f" ({first.peak_force:.3g} to {second.peak_force:.3g} N)"


def _without_friction(before: Evaluation, after: Evaluation, jump: float) -> Iterator[str]:
    """Yield the change of the jump without friction if its sign differs from the change with friction."""
    if before.frictionless is None or after.frictionless is None or before.contacts:
        return
    change = _change(before.frictionless.norm, after.frictionless.norm)
    if abs(change) > _SAME and (change > 0) != (jump > 0):
        yield f"without friction the jump {_in_words(change)}"


def _better_objective(impact: ResolvedImpact, outcome: Outcome, jumps: tuple[Jump, Jump]) -> Iterator[str]:
    objective = impact.objective
    if outcome in ("worse", "no better") and objective.kind != "coulomb" and not objective.others:
        kind = "sticking" if objective.normal_cone_deg else "coulomb"
        # If the contact sticks at both postures, the jump with friction is the jump that S measures.  At friction 0,
        # the jump equals the jump that V measures.  If the objective is already S or V in these cases, another
        # objective is not better.
        slides = impact.contact.friction == 0
        sticks = all(isinstance(jump, CoulombJump) and jump.sticks for jump in jumps)
        same = (kind, "speed" if slides else "", "sticking" if sticks else "")
        if objective.kind not in same and not (slides and kind == "sticking"):
            yield f"`objective` {kind} minimizes this jump; '{objective.kind}' minimizes another quantity"
    if outcome == "better at the price of force":
        yield "`max_force` bounds the force"


def _other_joint_model(impact: ResolvedImpact, before: Evaluation, after: Evaluation) -> Iterator[str]:
    """Yield the change of the jump for each joint model that is more accurate than the chosen joint model."""
    chosen, compression = impact.robot.joint_model, after.compression
    if compression is None or compression.x is None or chosen in (compression.fitting, "locked", "elastic"):
        return
    rebound = (1 + impact.restitution) * impact.speed
    for name, objective in both_models(impact.objective).items():
        if name == chosen or compression.fitting not in (None, name):
            continue
        jumps = [coulomb_jump(objective, evaluation.q, rebound) for evaluation in (before, after)]
        if jumps[0] is not None and jumps[1] is not None:
            change = _in_words(_change(jumps[0].norm, jumps[1].norm))
            yield f"with joint model '{name}' (x = {compression.x:.2g}) the jump {change}"
