"""Uncertain models: model variants, their worst case, and the displacement of the optimum."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import scipy.optimize

from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import FrameNotFound, ImpactPostureError, InputError, SpecError
from impact_posture.impact.evaluation.evaluation import evaluate
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.metric import Metric
from impact_posture.impact.worst_case.model_set import ModelSet, finite_maximum
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.analysis.robustness import Robustness, VariantOptimum, solve_robustly
from impact_posture.posture.constraints.center_of_mass_over_feet import CenterOfMassOverFeet
from impact_posture.posture.constraints.kept_contacts import KeptContacts
from impact_posture.posture.formulation.problem_file import dump_settings, prepare, read_settings, resolved_settings
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.search.multistart import solve
from impact_posture.robot.model_variant import MOST_VARIANTS, Payload, between, build_model_variants
from tests.support.helpers import assert_close, random_configurations, relative, rng, robot, unit
from tests.support.pinocchio_values import central_gradient, frame_jacobian, mass_matrix
from tests.support.settings import make_settings

FRAMES = {"tilthex_arm": "ee", "panda": "panda_hand_tcp", "bolt": "base_link", "talos": "gripper_right_base_link"}


# ---- model variants ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FRAMES)
def test_a_payload_adds_its_mass_and_a_factor_scales_the_armature(name: str) -> None:
    nominal_robot = robot(name)
    before, armature = nominal_robot.model_sha256, nominal_robot.armature.copy()
    frame = FRAMES[name]
    payload = Payload(frame, 0.7)
    variants = build_model_variants(nominal_robot, (0.5, 3.0), [payload])
    assert [s.name for s in variants] == [
        "as modeled", "armature × 0.5", "armature × 3", f"0.7 kg at {frame}",
        f"armature × 0.5, 0.7 kg at {frame}", f"armature × 3, 0.7 kg at {frame}",
    ]  # fmt: skip
    assert variants[0].robot is nominal_robot and len({s.robot.model_sha256 for s in variants}) == len(variants)
    for q in random_configurations(nominal_robot.model, 3, name, "payload"):
        M, J = (
            mass_matrix(nominal_robot.model, q),
            frame_jacobian(nominal_robot.model, q, nominal_robot.frame_id(frame))[:3],
        )
        for variant in variants:
            expected = M + (variant.armature_factor - 1) * np.diag(armature)
            if variant.payload is not None:
                expected = expected + payload.mass * J.T @ J
            assert_close(mass_matrix(variant.robot.model, q), expected, 1e-12, variant.name)
            np.testing.assert_allclose(variant.robot.armature, variant.armature_factor * armature, rtol=1e-15)
    del nominal_robot.__dict__["model_sha256"]
    assert nominal_robot.model_sha256 == before, "the robot itself is as it was"
    assert variants[4].to_dict() == {
        "name": f"armature × 0.5, 0.7 kg at {frame}",
        "armature_factor": 0.5,
        "payload": {"frame": frame, "mass": 0.7},
        "model_sha256": variants[4].robot.model_sha256,
    }


def test_which_model_variants_there_are() -> None:
    arm = robot("tilthex_arm")
    assert build_model_variants(arm, None, []) == () == build_model_variants(arm, (1.0, 1.0), [])
    assert [s.armature_factor for s in build_model_variants(arm, (2.0, 2.0), [])] == [1.0, 2.0]
    assert [s.armature_factor for s in build_model_variants(arm, (0.5, 1.0), [])] == [1.0, 0.5]
    two = build_model_variants(arm, None, [Payload("ee", 0.1), Payload("base_link", 0.2)])
    assert [s.payload for s in two] == [None, Payload("ee", 0.1), Payload("base_link", 0.2)]


@pytest.mark.parametrize(
    ("name", "factors", "payloads", "kind", "words"),
    [
        ("panda", None, [("panda_hnd", 1.0)], FrameNotFound, "panda_hand"),
        ("panda", None, [("panda_link0", 1.0)], InputError, "welded to the world"),
        ("panda", None, [("panda_hand", float("nan"))], InputError, "number above zero"),
        ("panda", None, [("panda_hand", 1.0)] * 2, InputError, "given twice"),
        ("panda", (2.0, 0.5), [], InputError, "the lower first"),
        ("panda", (0.0, 2.0), [], InputError, "above zero"),
        ("panda", (0.5, float("inf")), [], InputError, "range"),
        ("anymal_c", (0.5, 2.0), [], InputError, "no armature"),
        ("panda", (0.5, 2.0), [("panda_hand", m) for m in (1.0, 2.0, 3.0, 4.0)], InputError, "15 model variants"),
    ],
)
def test_refusals(
    name: str,
    factors: tuple[float, float] | None,
    payloads: list[tuple[str, float]],
    kind: type[ImpactPostureError],
    words: str,
) -> None:
    with pytest.raises(kind) as caught:
        build_model_variants(robot(name), factors, [Payload(*payload) for payload in payloads])
    assert words in caught.value.line and "\n" not in caught.value.line
    assert MOST_VARIANTS == 12


def test_robots_between_the_model_variants() -> None:
    nominal_robot = robot("talos")
    variants = build_model_variants(
        nominal_robot, (0.5, 4.0), [Payload("gripper_right_base_link", 2.0), Payload("base_link", 9.0)]
    )
    drawn = between(variants, 200, seed=1)
    factors = np.array([(one.armature.sum() / nominal_robot.armature.sum()) for one in drawn])
    assert 0.5 <= factors.min() < 0.6 and 3.5 < factors.max() <= 4.0
    assert 0.3 < (factors < np.sqrt(0.5 * 4)).mean() < 0.7, "evenly in the logarithm"
    more = np.array([one.mass - nominal_robot.mass for one in drawn])
    assert more.min() >= -1e-9 and 8 < more.max() <= 9.0
    hand = nominal_robot.model.frames[nominal_robot.frame_id("gripper_right_base_link")].parentJoint
    at_hand = np.array([one.model.inertias[hand].mass - nominal_robot.model.inertias[hand].mass for one in drawn])
    assert at_hand.max() <= 2.0 and (at_hand > 0).any() and (at_hand == 0).any(), "one payload at a time"
    assert [one.model_sha256 for one in between(variants, 3, seed=1)] == [one.model_sha256 for one in drawn[:3]]


# ---- worst case ---------------------------------------------------------------------------------------------------

MORE: dict[str, dict[str, object]] = {
    "plain": {},
    "kinetic": {"metric": Metric("kinetic")},
    "speed": {"kind": "speed"},
    "sticking": {"kind": "sticking"},
    "energy": {"kind": "energy"},
    "cone": {"normal_cone_deg": 20.0},
    "contacts": {"several": True},
    "pulling": {"several": True, "bilateral": True},
}


def objective_of(name: str, more: dict[str, object], *, feet: bool = False) -> WorstCaseObjective:
    nominal_robot = robot(name)
    others = {"tilthex_arm": "base_link", "panda": "panda_link4", "bolt": "FL_UPPER_LEG"}
    several = {"others": (ImpactContact(others[name], (1, 0, 0.3), impulse=2.0),)} if more.get("several") else {}
    rest = {key: value for key, value in more.items() if key != "several"}
    return WorstCaseObjective(
        nominal_robot,
        ImpactContact(FRAMES[name], (0.2, -0.4, 1.0), (0.02, 0.0, 0.01)),
        supports=nominal_robot.spec.supports if feet else (),
        compliance=1e-3,
        model_variants=build_model_variants(nominal_robot, (0.4, 2.0), [Payload(FRAMES[name], 0.8)]),
        **several,
        **rest,  # type: ignore[arg-type]
    )


def few(objective: WorstCaseObjective) -> ModelSet:
    assert isinstance(objective.worst_case, ModelSet)
    return objective.worst_case


# The smallest robot is tested with all kinds of variants, other robots only with the kinds that feet or bases affect.
EACH = [("tilthex_arm", False, kind) for kind in MORE]
EACH += [(name, name == "bolt", kind) for name in ("panda", "bolt") for kind in ("plain", "pulling")]
EACH += [("bolt", True, "cone")]


@pytest.mark.long(
    but=(
        "bolt-True-cone",
        "panda-False-pulling",
        "tilthex_arm-False-contacts",
        "tilthex_arm-False-sticking",
        "tilthex_arm-False-kinetic",
        "tilthex_arm-False-energy",
    )
)
@pytest.mark.parametrize(("name", "feet", "kind"), EACH)
def test_the_largest_of_separate_objectives(name: str, feet: bool, kind: str) -> None:
    objective = objective_of(name, MORE[kind], feet=feet)
    gradient_fun = objective.gradient_fun()
    seen = set()
    for q in random_configurations(objective.robot.model, 2, name, kind, spread=0.4):
        alone = [replace(objective, robot=s.robot, model_variants=()) for s in objective.model_variants]
        values = np.array([one.value(q) for one in alone])
        value, worst = objective.value(q), int(values.argmax())
        assert value == values.max() and finite_maximum(few(objective).values(q))[0][0] == worst
        seen.add(worst)
        assert np.sort(values)[-2] < value * (1 - 1e-4), "no tie here"
        gradient = objective.gradient(q)
        np.testing.assert_array_equal(gradient, alone[worst].gradient(q))
        assert_close(gradient, central_gradient(objective.value, objective.robot.model, q, 1e-4), 1e-5, kind, value)
        symbolic = [np.array(v).ravel() for v in gradient_fun(q, objective.contact.normal)]
        assert_close(symbolic[0], value, 1e-8, "CasADi's value")
        assert_close(symbolic[1], gradient, 1e-6, "CasADi's gradient", scale=value)
        points = objective.subgradients(q)
        np.testing.assert_array_equal(points.first, gradient)
        evaluated = evaluate(objective, q)
        assert [s.objective for s in evaluated.model_variants] == values.tolist() and evaluated.objective == value
        block = evaluated.to_dict()
        assert block["worst_scenario"] == objective.model_variants[worst].name
    assert seen <= set(range(len(objective.model_variants)))


def test_subgradients_where_two_payloads_are_as_bad() -> None:
    """A payload hangs on one of two sides.  Bisection determines the mass at which both sides are equally bad."""
    nominal_robot = robot("solo12")
    q = random_configurations(nominal_robot.model, 1, "either side", spread=0.3)[0]
    contact = ImpactContact("base_link", (0.0, 0.3, 1.0))

    def objective(mass: float) -> WorstCaseObjective:
        payloads = [Payload("FL_SHOULDER", 1.0), Payload("FR_SHOULDER", mass)]
        return WorstCaseObjective(
            nominal_robot,
            contact,
            Metric("kinetic"),
            "energy",
            model_variants=build_model_variants(nominal_robot, None, payloads),
        )

    def gap(mass: float) -> float:
        _, one, other = few(objective(mass)).values(q)
        return float(other - one)

    tied = objective(float(scipy.optimize.brentq(gap, 0.1, 10.0, xtol=1e-13)))
    points = tied.subgradients(q)
    assert len(points.gradients) == 2 and relative(*points.gradients) > 0.1
    step = 1e-6
    for index in range(20):
        direction = unit(rng("payloads", index), nominal_robot.nv)
        there = np.array(pin.integrate(nominal_robot.model, q, step * direction))
        rise = (tied.value(there) - tied.value(q)) / step
        slopes = points.gradients @ direction
        # The slope equals the largest slope of the gradients, as for a maximum of smooth functions.
        assert rise == pytest.approx(slopes.max(), rel=1e-3, abs=1e-4 * tied.value(q))
        assert rise > slopes.min() - 1e-3 * tied.value(q)


# ---- solving ------------------------------------------------------------------------------------------------------

TASKS: dict[str, dict[str, object]] = {
    "aerial": {"robot": "tilthex_arm", "frame": "ee", "normal": (0, 0, 1), "payload": (("ee", 0.3),)},
    "arm": {"robot": "panda", "frame": "panda_hand_tcp", "normal": (0, 0, 1), "payload": (("panda_hand_tcp", 2.0),)},
    "standing": {"robot": "bolt", "frame": "base_link", "normal": (1, 0, 0), "normal_cone": 10.0},
    "hand and elbow": {
        "robot": "panda", "contact": ("panda_hand_tcp:0,0,1", "panda_link4:1,0,0:2"), "contact_pose": "position",
    },
}  # fmt: skip


def problem_of(task: dict[str, object], **more: object) -> ConstrainedProblem:
    return prepare(make_settings(task | {"armature_range": (0.5, 2.0)} | more)).problem


@pytest.mark.parametrize("name", TASKS)
def test_optima_certify(name: str) -> None:
    problem = problem_of(TASKS[name])
    nominal = solve(replace(problem, objective=problem.impact.by_variant[0]), starts=2, jobs=1, compile="never")
    solution = solve(problem, starts=2, jobs=1, compile="never", guesses=(nominal.q,))
    assert solution.certificate.holds() and solution.certified_starts == solution.feasible_starts
    assert problem.objective.value(solution.q) <= problem.objective.value(nominal.q) * (1 + 1e-9)
    assert problem.objective.value(solution.q) >= nominal.problem.objective.value(nominal.q) * (1 - 1e-9)


def test_how_far_the_optimum_moves() -> None:
    """Recompute every number of the comparison by hand."""
    problem = problem_of(TASKS["aerial"])
    both = solve_robustly(problem, starts=3, seed=4, jobs=1, compile="never")
    robustness, q = both.robustness, both.solution.q
    assert robustness is not None and both.solution.certificate.holds()
    members = problem.impact.by_variant
    at_robust = [member.value(q) for member in members]
    assert [s.name for s in robustness.model_variants] == [s.name for s in problem.impact.model_variants]
    assert [s.at_robust for s in robustness.model_variants] == at_robust and robustness.worst_robust == max(at_robust)
    for one, member in zip(robustness.model_variants, members, strict=True):
        assert one.own_q is not None and one.own_optimum == member.value(one.own_q)
        assert one.own_optimum <= one.at_robust * (1 + 1e-7), "its own optimum is the best for this variant"
        assert one.moved == pytest.approx(np.linalg.norm(pin.difference(problem.robot.model, q, one.own_q)), rel=1e-9)
    first = robustness.model_variants[0]
    assert first.own_optimum is not None and first.own_q is not None
    assert (
        robustness.worst_nominal == problem.objective.value(first.own_q)
        and robustness.worst_nominal >= robustness.worst_robust
    )
    assert robustness.price == pytest.approx(at_robust[0] / first.own_optimum - 1) and robustness.moved == first.moved
    assert robustness.gain == pytest.approx(1 - robustness.worst_robust / robustness.worst_nominal)
    drawn = [
        replace(problem.objective, robot=one, model_variants=()).value(q)
        for one in between(problem.impact.model_variants, robustness.drawn, 4)
    ]
    assert robustness.between == max(drawn)
    words = robustness.line
    assert f"moves by {robustness.moved:.3g} rad" in words and f"{robustness.gain:.1%} lower" in words
    assert ("between the model variants" in words) == (robustness.between > robustness.worst_robust)
    assert json.loads(json.dumps(robustness.to_dict(), allow_nan=False))["worst_nominal"] == robustness.worst_nominal


def test_where_nothing_is_uncertain_nothing_is_compared() -> None:
    problem = prepare(make_settings({"robot": "tilthex_arm", "normal": (0, 0, 1)})).problem
    both = solve_robustly(problem, starts=2, jobs=1, compile="never")
    alone = solve(problem, starts=2, jobs=1, compile="never")
    assert both.robustness is None
    np.testing.assert_array_equal(both.solution.q, alone.q)


def test_words_of_every_finding() -> None:
    def line_of(own: float | None, worst_nominal: float | None, broken: tuple[str, ...] = ()) -> str:
        variant = VariantOptimum(
            "as modeled", 2.0, own, None if own is None else np.zeros(1), None if own is None else 0.5
        )
        return Robustness((variant,), 4.0, worst_nominal, broken, 3.0, 60).line

    assert line_of(1.0, 5.0) == (
        "the optimum moves by 0.5 rad (m); the worst case is 20.0% lower than at the optimum of the nominal "
        "model; the objective of the nominal model is 100.0% above its optimum"
    )
    assert "25.0% higher than at the optimum" in line_of(1.0, 3.2) and "more `starts`" in line_of(1.0, 3.2)
    assert "violates feet that stay (x)" in line_of(1.0, None, ("feet that stay (x)",))
    assert "no certified optimum to compare with" in line_of(None, None)
    assert "50.0% below its optimum" in line_of(4.0, 5.0)


def test_balance_and_feet_hold_in_every_model_variant() -> None:
    """A payload in the hand moves the center of mass: a posture optimized with the payload must not tip over."""
    frame = FRAMES["talos"]
    task = {"robot": "talos", "frame": frame, "normal": (-1, 0, 0), "contact_pose": "position"}
    problem = prepare(make_settings(task | {"payload": ((frame, 16.0),)})).problem
    centers = [c for c in problem.constraints if isinstance(c, CenterOfMassOverFeet)]
    assert [c.name for c in centers] == [
        "center of mass over the feet", f"center of mass over the feet with 16 kg at {frame}"
    ]  # fmt: skip
    solution = solve(problem, starts=2, jobs=1, compile="never")
    for variant in problem.impact.model_variants:
        model = variant.robot.model
        center = pin.centerOfMass(model, model.createData(), solution.q)[:2]
        assert (centers[0].normals @ center - centers[0].offsets).max() <= -centers[0].margin + 1e-8
        rows, jacobian = centers[1].evaluate(Numeric(problem.robot.model).at(solution.q))
        assert rows.shape == centers[1].upper.shape
    expected = central_gradient(
        lambda x: centers[1].evaluate(Numeric(problem.robot.model).at(x))[0], problem.robot.model, solution.q, 1e-4
    )
    assert_close(jacobian, expected, 1e-7, "Jacobian of the loaded center of mass")
    # Without the constraint, the robot would tip over with the payload in the optimum of the unloaded problem.
    plain = prepare(make_settings(task)).problem
    alone = solve(plain, starts=2, jobs=1, compile="never")
    assert centers[1].evaluate(Numeric(plain.robot.model).at(alone.q))[0].max() > -centers[1].margin

    kept = problem_of({"robot": "bolt", "frame": "base_link", "normal": (0, 0, -1)}, keep_contacts=True, com=False)
    names = [c.name for c in kept.constraints if isinstance(c, KeptContacts)]
    assert names == ["feet that stay", "feet that stay (armature × 0.5)", "feet that stay (armature × 2)"]


def test_a_resolved_problem_gives_the_same_again(tmp_path: Path) -> None:
    prepared = prepare(make_settings(TASKS["aerial"] | {"armature_range": (0.25, 1.0)}))
    text = dump_settings(resolved_settings(prepared))
    assert 'payload = [["ee", 0.3]]' in text and "armature_range = [0.25, 1.0]" in text
    (tmp_path / "problem.toml").write_text(text)
    again = prepare(read_settings(tmp_path / "problem.toml"))
    names = [[s.name for s in p.problem.impact.model_variants] for p in (prepared, again)]
    assert names[0] == names[1] and len(names[0]) == 4


@pytest.mark.parametrize("line", ['payload = [["ee", "heavy"]]', "armature_range = [0.5]"])
def test_bad_keys(tmp_path: Path, line: str) -> None:
    path = tmp_path / "problem.toml"
    path.write_text(f'schema = "impact-posture/problem/1"\nrobot = "tilthex_arm"\nnormal = [0.0, 0.0, 1.0]\n{line}\n')
    with pytest.raises(SpecError) as caught:
        prepare(read_settings(path))
    assert line.split()[0] in caught.value.line and "\n" not in caught.value.line
