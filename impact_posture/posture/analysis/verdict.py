"""The verdict on an optimal posture: changes at base, joints and contact for the given speed and friction."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import sqrt

from impact_posture.config.json_block import JsonBlock
from impact_posture.impact.elasticity.contact_compression import both_models
from impact_posture.impact.evaluation.coulomb_jump import CoulombJump, coulomb_jump
from impact_posture.impact.evaluation.evaluation import Evaluation
from impact_posture.impact.evaluation.standing_impact import StandingImpact
from impact_posture.impact.evaluation.velocity_jump import Jump, normal_jump
from impact_posture.impact.resolved_impact import ResolvedImpact
from impact_posture.posture.analysis.verdict_changes import (
    SAME,
    PredictedImpact,
    changes,
    in_words,
    outcome_of,
    relative_change,
)
from impact_posture.posture.analysis.verdict_conditions import Circumstances, Condition, conditions


@dataclass(frozen=True)
class Verdict(JsonBlock):
    """Changes from the initial to the optimal posture, at the given approach speed and friction.

    Attributes:
        outcome: Verdict in a few words: ``better`` (no effect on base, joints or contact grows by 5 % or more),
            ``better for … at the price of …``, ``no better``, ``worse``, ``cannot arrive`` or ``unknown``.
        line: The conditions, the outcome and the numbers in words.
        minimized: Name of the minimized objective, and change of the norm of the jump, in words.
        jump: Relative change of the norm ``‖Δν‖_W`` of the jump; ``None`` if it is unknown.
        impulse: Relative change of the normal impulse.
        peak_force: Relative change of the peak force with friction; ``None`` if it is unknown.
        advice: Advice, one line each: the jump without friction, a better objective, or a more accurate joint model.
        conditions: Conditions under which the numbers hold, the gravest first.
        before, after: The predicted impact in the initial and in the optimal posture; ``None`` if it is unknown.
        unilateral: The same predictions if feet can lift and slide; ``None`` if the effects on base and joints are
            the same as with feet that stay.
        assumptions: Assumptions behind the numbers, one line each.
    """

    outcome: str
    line: str
    minimized: str = ""
    jump: float | None = None
    impulse: float | None = None
    peak_force: float | None = None
    advice: tuple[str, ...] = ()
    conditions: tuple[Condition, ...] = ()
    before: PredictedImpact | None = None
    after: PredictedImpact | None = None
    unilateral: tuple[PredictedImpact, PredictedImpact] | None = None
    assumptions: tuple[str, ...] = ()


def verdict(
    impact: ResolvedImpact, before: Evaluation, after: Evaluation, known: Circumstances = Circumstances()
) -> Verdict:
    """Compare the predicted impacts in the initial and the optimal posture.

    Jumps, impulses and forces include the friction of the contact.  Peak forces are for the given contact stiffness,
    or for a linear contact of any stiffness, ``F ∝ √m`` with the effective mass m with friction.  Several contacts
    are struck at the same time.  If the jump of this impact is unknown at one of the postures, only the first contact
    is compared.
    """
    together = bool(before.together and after.together)
    first, last = _jump(before, together), _jump(after, together)
    stated = conditions(impact, before, after, known)
    opening = "; ".join(condition.line for condition in stated)
    if impact.speed <= 0 or first is None or last is None:
        why = "there is no approach speed" if impact.speed <= 0 else "the contact cannot move along the normal"
        line = "; ".join(filter(None, [opening, f"no verdict, because {why}"]))
        return Verdict("unknown", f"verdict: {line}.", conditions=stated)
    sides = _predicted(before, first), _predicted(after, last)
    unilateral = _unilateral(impact, (before, after), sides)
    known_mass = before.contact_mass is not None and after.contact_mass is not None
    linear = _linear_force(impact, sides) if known_mass else None
    felt = changes(*sides, impact.speed, linear, f" at {impact.contact.frame}" if together else "")
    outcome, force = outcome_of(felt), next((change.relative for change in felt if change.side == "force"), None)
    friction = f"with friction {impact.contact.friction:g}" if isinstance(last, CoulombJump) else "without friction"
    contact = friction + _slip(last)
    if impact.objective.others:
        contact += ", all contacts at once" if together else f", at {impact.contact.frame} alone"
    numbers = [change.line for change in felt]
    told = f"At {impact.speed:g} m/s {contact}: {', '.join(numbers)}."
    refuted = any(condition.refutes for condition in stated)
    opening += ". " if opening else ""
    told = f"verdict: {opening}{_sentence(outcome, refuted, bool(opening))}. {told}{_lifted(impact, unilateral)}"
    jump = relative_change(first.norm, last.norm)
    advice = (
        *(condition.hint for condition in stated if condition.hint),
        *_without_friction(before, after, jump),
        *_better_objective(impact, outcome, (first, last)),
        *(("`max_force` bounds the force",) if any(c.grows for c in felt if c.side == "force") else ()),
        *_other_joint_model(impact, before, after),
    )
    return Verdict(
        outcome="cannot arrive" if refuted else outcome,
        line=told,
        minimized=_minimized(impact, (first, last)),
        jump=jump,
        impulse=relative_change(first.normal_impulse, last.normal_impulse),
        peak_force=force,
        advice=advice,
        conditions=stated,
        before=sides[0],
        after=sides[1],
        unilateral=unilateral,
        assumptions=_assumptions(impact, friction, together, force),
    )


def _sentence(outcome: str, refuted: bool, later: bool) -> str:
    if refuted:
        return f"If it arrived, the posture would be {outcome}"
    return outcome.capitalize() if later else outcome


def _unilateral(
    impact: ResolvedImpact, evaluations: tuple[Evaluation, Evaluation], held: tuple[PredictedImpact, PredictedImpact]
) -> tuple[PredictedImpact, PredictedImpact] | None:
    """Return the predictions for feet that lift or slide; ``None`` if the effects equal those with fixed feet."""
    first, last = (evaluation.standing for evaluation in evaluations)
    if first is None or last is None:
        return None
    sides = _standing(impact, first), _standing(impact, last)
    differ = [
        change.grows or change.falls
        for pair in zip(held, sides, strict=True)
        for change in changes(*pair, impact.speed)
    ]
    return sides if first.moves or last.moves or any(differ) else None


def _standing(impact: ResolvedImpact, standing: StandingImpact) -> PredictedImpact:
    mass = standing.jump.normal_impulse / normal_jump(impact.speed, impact.restitution)
    # If several contacts are struck at the same time, their forces are unknown.
    contact = None if impact.objective.others else impact.contact_stiffness
    return _felt(standing.jump, None if contact is None else contact.peak_force(mass, impact.speed))


def _lifted(impact: ResolvedImpact, sides: tuple[PredictedImpact, PredictedImpact] | None) -> str:
    """Return a sentence with the outcome and the numbers if the feet can lift and slide; empty without ``sides``."""
    if sides is None:
        return ""
    felt = changes(*sides, impact.speed, _linear_force(impact, sides))
    return f" With feet that lift or slide: {outcome_of(felt)}, {', '.join(change.line for change in felt)}."


def _predicted(evaluation: Evaluation, jump: Jump) -> PredictedImpact:
    # If several contacts are struck at the same time, their forces are unknown.
    compression = None if evaluation.contacts else evaluation.compression
    return _felt(jump, None if compression is None else compression.peak_force)


def _felt(jump: Jump, peak_force: float | None) -> PredictedImpact:
    return PredictedImpact(
        **vars(jump.effect),
        impulse=jump.normal_impulse,
        peak_force=peak_force,
        jump=jump.norm,
        sticks=jump.sticks if isinstance(jump, CoulombJump) else None,
    )


def _minimized(impact: ResolvedImpact, jumps: tuple[Jump, Jump]) -> str:
    metric = impact.objective.metric.kind
    mixed = "" if metric == "kinetic" else ", m/s and rad/s in one norm"
    change = in_words(relative_change(jumps[0].norm, jumps[1].norm))
    norm = f"‖Δν‖ ({metric}{mixed}) {change} ({jumps[0].norm:.3g} to {jumps[1].norm:.3g})"
    return f"minimized: {impact.objective.kind}; the whole jump {norm}"


def _assumptions(impact: ResolvedImpact, friction: str, together: bool, force: float | None) -> tuple[str, ...]:
    # Impacts at several contacts at the same time are treated as plastic.
    restitution = 0.0 if together else impact.restitution
    stated = "the stated contact" if impact.contact_stiffness else "a linear contact, the same before and after"
    return (
        f"rigid impact at {impact.speed:g} m/s with restitution {restitution:g}, {friction}",
        f"jump in the {impact.objective.metric.kind} metric, with joint model '{impact.robot.joint_model}'",
        *(("the feet stay on the ground",) if impact.objective.supports else ()),
        *((f"peak force of {stated}, {friction}",) if force is not None else ()),
    )


def _jump(evaluation: Evaluation, together: bool) -> Jump | None:
    if evaluation.together and together:
        return evaluation.together[0]
    return evaluation.coulomb or evaluation.frictionless


def _slip(jump: Jump) -> str:
    return "" if not isinstance(jump, CoulombJump) else ", sticking" if jump.sticks else ", slipping"


def _linear_force(impact: ResolvedImpact, sides: tuple[PredictedImpact, PredictedImpact]) -> float | None:
    """Return the relative change of the peak force ``F ∝ √m`` of a linear contact; ``None`` for several contacts."""
    return None if impact.objective.others else sqrt(sides[1].impulse / sides[0].impulse) - 1


def _without_friction(before: Evaluation, after: Evaluation, jump: float) -> Iterator[str]:
    """Yield the change of the jump without friction if its sign differs from the change with friction."""
    if before.frictionless is None or after.frictionless is None or before.contacts:
        return
    change = relative_change(before.frictionless.norm, after.frictionless.norm)
    if abs(change) >= SAME and (change > 0) != (jump > 0):
        yield f"without friction the jump {in_words(change)}"


def _better_objective(impact: ResolvedImpact, outcome: str, jumps: tuple[Jump, Jump]) -> Iterator[str]:
    objective = impact.objective
    grown = relative_change(jumps[0].norm, jumps[1].norm) > -SAME
    if (grown or outcome in ("worse", "no better")) and objective.kind != "coulomb" and not objective.others:
        kind = "sticking" if objective.normal_cone_deg else "coulomb"
        # If the contact sticks at both postures, S is the squared jump.  Without friction, V is the squared jump.  If
        # the objective is this quantity already, no other objective is better.
        slides = impact.contact.friction == 0
        sticks = all(isinstance(jump, CoulombJump) and jump.sticks for jump in jumps)
        same = (kind, "speed" if slides else "", "sticking" if sticks else "")
        if objective.kind not in same and not (slides and kind == "sticking"):
            yield f"`objective` {kind} minimizes this whole jump; '{objective.kind}' minimizes another quantity"


def _other_joint_model(impact: ResolvedImpact, before: Evaluation, after: Evaluation) -> Iterator[str]:
    """Yield the change of the jump for each joint model that is more accurate than the chosen joint model."""
    chosen, compression = impact.robot.joint_model, after.compression
    if compression is None or chosen in (compression.fitting, "locked", "elastic"):
        return
    if compression.x is None and not compression.unknown_springs:
        return
    x = "x is unknown" if compression.x is None else f"x = {compression.x:.2g}"
    rebound = normal_jump(impact.speed, impact.restitution)
    for name, objective in both_models(impact.objective).items():
        if name == chosen or compression.fitting not in (None, name):
            continue
        jumps = [coulomb_jump(objective, evaluation.q, rebound) for evaluation in (before, after)]
        if jumps[0] is not None and jumps[1] is not None:
            change = in_words(relative_change(jumps[0].norm, jumps[1].norm))
            yield f"with joint model '{name}' ({x}) the jump {change}"
