"""Predict the recorded hits of an arm from a fit to one group of hits, and compare the joint models."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np

from docs.studies.core import Request, Vector, say, table
from docs.studies.hits.arm import ASSUMED_STIFFNESS, MASSES, MODELS, Arm, Model, elastic_response, with_box
from docs.studies.hits.figure import draw
from docs.studies.hits.fit import Fit, Fitted, Summary, fit_contact, spring_deflection
from docs.studies.hits.recordings import JOINTS, SOURCE, Group, Hit, by_group, read_hits
from impact_posture.errors import InputError
from impact_posture.impact.elasticity.contact_compression import Compression, ContactStiffness, compression
from impact_posture.impact.worst_case_objective import WorstCaseObjective

# All fits use this group.  The other groups are only predicted.
FITTED = Group(1, 2)
# Names of the naive predictions, and of predictions with another contact point.
LINKS, MASS, REPEAT = "links at the tip", "effective mass", "repeat the fitted group"
AT_TIP, PER_BOX = "reflected at the tip", "reflected, point per box"
PREDICTIONS = (LINKS, MASS, REPEAT, AT_TIP, *MODELS, PER_BOX)
Groups = Mapping[Group, Sequence[Hit]]


@dataclass(frozen=True)
class Score:
    """How a prediction compares with the measured jump of a group.

    Attributes:
        loss: Predicted divided by measured loss of tip speed along the tool axis.
        cosine: Cosine of the angle between predicted and measured joint jumps, in rad/s.
        size: Norm of the predicted jump divided by the norm of the measured jump.
        error: Norm of the error divided by the norm of the measured jump, both in the metric of the kinetic energy.
    """

    loss: float
    cosine: float = float("nan")
    size: float = float("nan")
    error: float = float("nan")

    @staticmethod
    def of(predicted: Vector, measured: Summary, arm: Arm) -> Score:
        """Compare joint jumps, rad/s, shape (7,)."""
        jump, tip, root = measured.jump, Arm().approach(measured.q), np.linalg.cholesky(arm.inertia(measured.q)).T
        length, norm = float(np.linalg.norm(predicted)), float(np.linalg.norm(jump))
        error = float(np.linalg.norm(root @ (predicted - jump)) / np.linalg.norm(root @ jump))
        return Score(
            float(tip @ predicted / (tip @ jump)), float(predicted @ jump) / length / norm, length / norm, error
        )


class Evaluation:
    """Fit of one group, and scores of all predictions of all groups.

    Args:
        groups: Hits by group, with :data:`FITTED`.
        recorded: Whether to use the jumps as recorded, with the effects of trend and controller.
    """

    def __init__(self, groups: Groups, *, recorded: bool = False) -> None:
        self.fit = Fit(groups[FITTED], recorded)
        self.measured = {group: self.fit.summary(hits) for group, hits in groups.items()}

    @cached_property
    def at_tip(self) -> Fitted:
        """The model ``reflected`` with a contact at the tip and the restitution that fits best."""
        return fit_contact(MODELS["reflected"], self.fit.arm, self.fit.measured, at_tip=True)

    @cached_property
    def refits(self) -> dict[Group, Fitted]:
        """The model ``reflected`` with contact point and restitution fitted to each group, for comparison only."""
        model, arm = MODELS["reflected"], self.fit.arm
        return {group: fit_contact(model, arm, measured) for group, measured in self.measured.items()}

    def jumps(self, group: Group) -> dict[str, Vector]:
        """Return the joint jumps of a group, rad/s: name of a prediction → predicted jumps."""
        measured = self.measured[group]
        rate = _speed(measured) / _speed(self.fit.measured)
        jumps = {LINKS: Fitted(Model("link"), Arm(), 1.0).jump(measured), REPEAT: rate * self.fit.measured.jump}
        jumps |= {AT_TIP: self.at_tip.jump(measured)}
        jumps |= {name: fitted.jump(measured) for name, fitted in self.fit.models.items()}
        first = self.refits.get(Group(1, group.box))
        return jumps if group.posture == 1 or first is None else jumps | {PER_BOX: first.jump(measured)}

    @cached_property
    def scores(self) -> dict[tuple[Group, str], Score]:
        scores = {}
        for group, measured in self.measured.items():
            for name, jump in self.jumps(group).items():
                scores[group, name] = Score.of(jump, measured, self.fit.arm)
            lost = _lost(measured) / -float(Arm().approach(measured.q) @ measured.jump)
            first = self.fit.measured
            gain = -float(Arm().approach(first.q) @ first.jump) / _lost(first)
            scores[group, MASS] = Score(gain * lost)
        return scores

    def impulses(self, group: Group) -> tuple[float, float, float]:
        """Return two impulses along the tool axis, from the joint torques and as predicted by ``reflected``, and a
        mass.

        The measured torques and the momentum of the links determine the impulse without controller, restitution and
        mass of the box: ``M Δq̇ − ∫Δτ dt = −(j p + moments)``.  The inertia of links and rotors weights the least
        squares.  For a box of the returned mass, kg, ``reflected`` predicts this impulse.  Impulses are in N·s.
        """
        measured, fitted = self.measured[group], self.fit.models["reflected"]
        links, q = replace(self.fit.arm, rotors=np.zeros(JOINTS)), measured.q
        momentum = links.inertia(q) @ measured.relative - measured.torque
        rows = [replace(links, offset=offset).approach(q) for offset in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))]
        columns = np.column_stack([rows[0], rows[1] - rows[0], rows[2] - rows[0]])
        root = np.linalg.cholesky(np.linalg.inv(self.fit.arm.inertia(q))).T
        impulse = -float(np.linalg.lstsq(root @ columns, root @ momentum)[0][0])
        j = fitted.arm.approach(q)
        mobility = float(j @ np.linalg.solve(fitted.arm.inertia(q), j))
        speed = fitted.gain * float(j @ measured.before)
        predicted = speed / (mobility + 1 / MASSES[group.box])
        return impulse, predicted, 1 / (speed / impulse - mobility)


def _speed(measured: Summary) -> float:
    return float(Arm().approach(measured.q) @ measured.before)


def _lost(measured: Summary) -> float:
    """Return the plastic loss of tip speed, m/s, from the effective mass of the links and the mass of the box."""
    j = Arm().approach(measured.q)
    mass = 1 / float(j @ np.linalg.solve(Arm().inertia(measured.q), j))
    box = MASSES[measured.group.box]
    return _speed(measured) * box / (box + mass)


def resampled(groups: Groups, generator: np.random.Generator) -> Groups:
    """Draw as many hits as each group has, with replacement."""
    return {group: [hits[k] for k in generator.integers(len(hits), size=len(hits))] for group, hits in groups.items()}


def lines(request: Request) -> Iterator[str]:
    """Yield fits, tables and intervals, and draw the figure if the page is written."""
    if not request.data:
        raise InputError("needs recordings", where="hits", hint=SOURCE)
    began = time.perf_counter()
    hits, left_out = read_hits(Path(request.data))
    groups = dict(by_group(hits))
    if FITTED not in groups:
        raise InputError(f"contains no hit of {FITTED}", where=request.data, hint=SOURCE)
    generator = np.random.default_rng(request.seed)
    evaluations = [Evaluation(groups)]
    for k in range(request.count):
        evaluations.append(Evaluation(resampled(groups, generator)))
        _ = evaluations[-1].scores
        say(f"\rresamples: {k + 1} of {request.count}", end="")
    say(f", {time.perf_counter() - began:.0f} s")
    best = evaluations[0]
    yield from _recordings(groups, left_out, request)
    yield from ("### Fitted", "", *_fits(evaluations), "")
    yield from ("### Loss of tip speed", "", *_losses(evaluations), "")
    yield from ("### Joint jumps", "", *_jumps(evaluations), "")
    yield from ("### Order of the models", "", *_order(evaluations), "")
    yield "Errors with the recorded jumps, which include trend and controller, and with the contact one row later:"
    later = dict(by_group(moved for hit in hits if (moved := hit.later()) is not None))
    others = {"as recorded": Evaluation(groups, recorded=True)}
    if FITTED in later:
        others["one row later"] = Evaluation(later)
    yield from ("", *_errors(others), "")
    yield from ("### Which inertia", "", *_inertia(best), "")
    yield from ("### Impulse", "", *_impulses(evaluations), "")
    yield from ("### Jump of each joint", "", *_each_joint(best))
    if request.write:
        draw(groups, best)


def _recordings(groups: Groups, left_out: Sequence[str], request: Request) -> Iterator[str]:
    used = ", ".join(f"{len(hits)} ({group})" for group, hits in groups.items())
    yield f"Hits: {used}. Intervals contain 95 % of {request.count} bootstrap resamples (seed {request.seed}) of the"
    yield "hits, with a new fit for each resample."
    if left_out:
        counts = [f"{left_out.count(reason)} ({reason})" for reason in sorted(set(left_out))]
        yield f"Left out: {', '.join(counts)}."
    yield ""


def _with_interval(values: Sequence[float], digits: int) -> str:
    """Write the first value, and the 95 % interval of the other values."""
    low, high = np.percentile(values[1:], [2.5, 97.5])
    return f"{values[0]:.{digits}f} ({low:.{digits}f} … {high:.{digits}f})"


def _fits(evaluations: Sequence[Evaluation]) -> Iterator[str]:
    fits = [each.fit for each in evaluations]
    yield f"Mass added to link 7: {_with_interval([fit.arm.mass for fit in fits], 2)} kg."
    yield f"Stiffness of the contact, from its duration: {fits[0].arm.stiffness / 1e3:.0f} kN/m."
    springs = [1e3 * spring_deflection(fit.hits) for fit in fits]
    rows = [
        [
            str(k + 1),
            _with_interval([fit.arm.rotors[k] for fit in fits], 3),
            _with_interval([deflection[k] for deflection in springs], 3),
            f"{1e3 / ASSUMED_STIFFNESS[k]:.3f}",
        ]
        for k in range(JOINTS)
    ]
    head = ["joint", "rotor, kg·m²", "deflection of the spring, mrad/(N·m)", "assumed deflection, mrad/(N·m)"]
    yield from ("", *table(head, rows), "")
    models = {AT_TIP: [each.at_tip for each in evaluations]}
    models |= {name: [fit.models[name] for fit in fits] for name in MODELS}
    for group in evaluations[0].measured:
        if group != FITTED:
            models[f"reflected, fitted to {group}"] = [each.refits[group] for each in evaluations]
    rows = []
    for name, fitted in models.items():
        places = [
            _with_interval([sign * each.arm.offset[k] for each in fitted], 0) for k, sign in ((0, 1e3), (1, -1e3))
        ]
        if name == AT_TIP:
            places = ["0", "0"]
        rows.append([name, *places, _with_interval([each.gain - 1 for each in fitted], 2)])
    yield from table(["model", "contact beside the tip, mm", "contact above the tip, mm", "restitution e"], rows)


def _losses(evaluations: Sequence[Evaluation]) -> Iterator[str]:
    best = evaluations[0]
    tips = {group: Arm().approach(measured.q) for group, measured in best.measured.items()}
    rows = []
    for words, key in (
        ("approach speed, m/s", "before"),
        ("loss as recorded, m/s", "recorded"),
        ("loss by the contact, m/s", "jump"),
    ):
        values = [float(tips[group] @ getattr(measured, key)) for group, measured in best.measured.items()]
        rows.append([words, *(f"{abs(value):.3f}" for value in values)])
    for name in PREDICTIONS:
        cells = [
            _with_interval([each.scores[group, name].loss for each in evaluations], 2)
            if (group, name) in best.scores
            else "–"
            for group in best.measured
        ]
        rows.append([f"predicted / measured: {name}", *cells])
    yield from table(["", *map(str, best.measured)], rows)


def _jumps(evaluations: Sequence[Evaluation]) -> Iterator[str]:
    best, rows = evaluations[0], []
    for group, name in best.scores:
        if name != MASS:
            scores = [each.scores[group, name] for each in evaluations]
            cells = [
                _with_interval([getattr(score, key) for score in scores], 2) for key in ("cosine", "size", "error")
            ]
            rows.append([str(group), name, *cells])
    yield from table(["group", "prediction", "cosine", "size", "error"], rows)


def _order(evaluations: Sequence[Evaluation]) -> Iterator[str]:
    best, *others = evaluations
    rows = []
    for group in best.measured:
        order = sorted(MODELS, key=lambda name: best.scores[group, name].error)
        words = order[0]
        for first, second in pairwise(order):
            better = [each.scores[group, first].error < each.scores[group, second].error for each in others]
            words += f" < {second} ({np.mean(better):.0%})"
        naive = min(best.scores[group, name].error for name in (LINKS, REPEAT))
        error = best.scores[group, order[0]].error
        beats = np.mean([each.scores[group, "reflected"].error < each.scores[group, "link"].error for each in others])
        rows.append([str(group), words, f"{beats:.0%}", f"{error:.2f}", "–" if group == FITTED else f"{naive:.2f}"])
    head = ["group", "models by error (fraction of resamples with this order)", "reflected < link", "least error"]
    yield from table([*head, "least naive error"], rows)


def _errors(evaluations: Mapping[str, Evaluation]) -> Iterator[str]:
    names = [name for name in PREDICTIONS if name not in (MASS, PER_BOX)]
    rows = [
        [words, str(group), *(f"{each.scores[group, name].error:.2f}" for name in names)]
        for words, each in evaluations.items()
        for group in each.measured
    ]
    yield from table(["jumps", "group", *names], rows)


def _inertia(best: Evaluation) -> Iterator[str]:
    rows = []
    for group, measured in best.measured.items():
        arm, box = best.fit.models["reflected"].arm, MASSES[group.box]
        response = elastic_response(arm, box, measured.q)
        known = _compression(arm, box, measured, ContactStiffness(linear=arm.stiffness))
        materials = _compression(arm, box, measured, None).by_material
        rows.append([
            str(group), f"{1e3 * response.duration:.1f}", "–" if known.x is None else f"{known.x:.2f}",
            f"`{known.fitting}`", ", ".join(f"{x:.2f} on {name}" for name, x in materials.items()),
        ])  # fmt: skip
    yield from table(["group", "T, ms", "x", "advised model", "x if only a material is stated"], rows)


def _compression(arm: Arm, box: float, measured: Summary, contact: ContactStiffness | None) -> Compression:
    case = arm.case(box)
    objective = WorstCaseObjective(case.robot, case.contact)
    result = compression(objective, with_box(measured.q), float(arm.approach(measured.q) @ measured.before), contact)
    assert result is not None
    return result


def _impulses(evaluations: Sequence[Evaluation]) -> Iterator[str]:
    rows = []
    for group in evaluations[0].measured:
        columns = zip(*(each.impulses(group) for each in evaluations), strict=True)
        rows.append([str(group), *(_with_interval(values, 2) for values in columns), f"{MASSES[group.box]:g}"])
    head = ["group", "impulse from joint torques, N·s", "impulse predicted by reflected, N·s"]
    yield from table([*head, "mass for the first impulse, kg", "mass used, kg"], rows)


def _each_joint(best: Evaluation) -> Iterator[str]:
    rows = []
    for group, measured in best.measured.items():
        jumps = best.jumps(group)
        rows.append([str(group), "measured", *(f"{value:.2f}" for value in measured.jump)])
        rows += [[str(group), name, *(f"{value:.2f}" for value in jumps[name])] for name in MODELS]
    yield from table(["group", "jump, rad/s", *(f"joint {k + 1}" for k in range(JOINTS))], rows)
