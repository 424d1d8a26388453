"""The verdict on a posture: predicted jumps in words, better settings, and the objective ``auto``."""

from __future__ import annotations

import json
from dataclasses import replace
from math import sqrt
from pathlib import Path

import numpy as np
import pytest

from impact_posture.impact.elasticity.contact_compression import ContactStiffness
from impact_posture.impact.evaluation.impact_effect import WorstJoint
from impact_posture.impact.evaluation.joint_yield import joint_yield
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.resolved_impact import ResolvedImpact, resolve
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.analysis.verdict import verdict
from impact_posture.posture.analysis.verdict_changes import PredictedImpact, changes, outcome_of
from impact_posture.posture.analysis.verdict_conditions import Circumstances
from impact_posture.posture.approach.approach_speed import ApproachSpeed
from impact_posture.posture.formulation.problem_file import dump_settings, prepare, resolved_settings
from impact_posture.posture.search.multistart import solve
from impact_posture.robot.robot_spec import TransmissionSpec
from tests.support.arms import TIP, Y, arm
from tests.support.command import run, succeed
from tests.support.helpers import random_configurations
from tests.support.settings import make_settings

NORMAL = {"normal": (0.0, 0.0, 1.0)}
CASES = {"panda": {}, "tilthex_arm": {}, "solo12": {"frame": "base_link"}, "talos": {"normal": (-1.0, 0.0, 0.0)}}


def resolved(name: str, **more: object) -> ResolvedImpact:
    return resolve(make_settings({"robot": name, **NORMAL, **CASES[name], **more}))


@pytest.mark.long(but=("5.0-talos", "0.3-tilthex_arm", "0.0-panda", "0.3-solo12"))
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("friction", [0.0, 0.3, 5.0])
def test_the_changes_follow_from_the_predicted_jumps(name: str, friction: float) -> None:
    impact = resolved(name, friction=friction, speed=0.6, contact_stiffness=2e5)
    robot, model = impact.robot, impact.robot.model
    for q in random_configurations(model, 2, name, "verdict", spread=0.3):
        before, after = impact.evaluate(), impact.evaluate(q)
        assert before.coulomb is not None and after.coulomb is not None
        told = verdict(impact, before, after)
        assert told.jump == pytest.approx(after.coulomb.norm / before.coulomb.norm - 1)
        assert told.impulse == pytest.approx(after.coulomb.normal_impulse / before.coulomb.normal_impulse - 1)
        assert told.peak_force == pytest.approx(sqrt(told.impulse + 1) - 1)
        assert told.before is not None and told.after is not None
        felt: dict[str, list[float]] = {"base": [], "joints": [], "force": [told.peak_force or 0.0]}
        for side, evaluation in ((told.before, before), (told.after, after)):
            assert evaluation.coulomb is not None and evaluation.compression is not None
            jump = evaluation.coulomb.velocity
            assert (side.jump, side.impulse) == (evaluation.coulomb.norm, evaluation.coulomb.normal_impulse)
            assert (side.peak_force, side.sticks) == (evaluation.compression.peak_force, evaluation.coulomb.sticks)
            assert (side.base_linear is None) == (not robot.floating) and side.joint is not None
            joints = slice(robot.first_joint, None)
            shares = np.abs(jump[joints]) / robot.velocity_limits[joints]
            assert side.joint.share == pytest.approx(shares.max())
            if robot.floating:
                sizes = np.linalg.norm(jump[:3]), np.linalg.norm(jump[3:6])
                assert (side.base_linear, side.base_angular) == pytest.approx(sizes)
        one, other = told.before, told.after
        assert one.joint is not None and other.joint is not None
        felt["joints"] = [(other.joint.share or 0.0) / (one.joint.share or 1.0) - 1]
        for first, last in ((one.base_linear, other.base_linear), (one.base_angular, other.base_angular)):
            if first is not None and last is not None and abs(last - first) > 0.01 * 0.6:
                felt["base"].append(last / first - 1)
        grow = [key for key, values in felt.items() if any(value >= 0.05 for value in values)]
        fall = [key for key, values in felt.items() if key not in grow and any(value <= -0.05 for value in values)]
        if grow and fall:
            assert told.outcome == f"better for the {listed(fall)} at the price of {listed(grow)}"
        elif told.impulse is not None and abs(told.impulse) < 0.05:
            assert told.outcome == ("better" if fall else "worse" if grow else "no better")
        assert "sticking:" in told.line if after.coulomb.sticks else "slipping:" in told.line
        assert any("max_force" in line for line in told.advice) == ("force" in grow)
        assert told.assumptions[0] == f"rigid impact at 0.6 m/s with restitution 0, with friction {friction:g}"
        assert ("the feet stay on the ground" in told.assumptions) == bool(impact.objective.supports)
        assert told.assumptions[-1] == f"peak force of the stated contact, with friction {friction:g}"


def listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def test_a_joint_norm_that_falls_does_not_hide_a_base_that_jumps_more() -> None:
    """The whole jump falls, but base and force grow, so the posture is not simply better."""
    prepared = prepare(make_settings({"robot": "tilthex_arm", **NORMAL}))
    solution = solve(prepared.problem, starts=2, compile="never")
    told = verdict(prepared.impact, *map(prepared.impact.evaluate, (solution.initial, solution.q)))
    assert told.jump is not None and told.jump < -0.2
    assert told.outcome == "better for the joints at the price of base and force"
    assert told.minimized.startswith("minimized: impulse; the whole jump ‖Δν‖ (euclidean, m/s and rad/s in one norm)")
    assert "falls by 23 %" in told.minimized and "falls by 23 %" not in told.line


def test_small_changes_are_about_the_same() -> None:
    before = PredictedImpact(0.1, 0.2, WorstJoint("elbow", 1.0, "rad/s", 0.5), 1.0, 100.0, 1.5, True)
    after = replace(before, joint=WorstJoint("elbow", 0.5, "rad/s", 0.25), impulse=1.04, peak_force=103.0)
    felt = changes(before, after, 1.0, 0.03)
    assert outcome_of(felt) == "better" and "peak force 100 to 103 N (about the same)" in felt[-1].line
    dearer = changes(before, replace(after, peak_force=110.0), 1.0, 0.1)
    assert outcome_of(dearer) == "better for the joints at the price of force"
    # A base that hardly moves does not affect the outcome, even if its jump doubles.
    still = replace(before, base_linear=1e-4), replace(after, base_linear=1e-3)
    assert outcome_of(changes(*still, 1.0, 0.03)) == "better"
    assert outcome_of(changes(before, before, 1.0, 0.0)) == "no better"
    assert outcome_of(changes(after, before, 1.0, 0.0)) == "worse"


def test_a_posture_that_cannot_arrive_says_so_first() -> None:
    impact = resolved("panda")
    q = impact.evaluate()
    told = verdict(impact, q, q, Circumstances(attainable=0.0163))
    assert told.line.startswith("verdict: cannot arrive at 1 m/s (0.0163 m/s at most)")
    assert told.outcome == "cannot arrive" and any("`approach`" in line for line in told.advice)
    reached = verdict(impact, q, q, Circumstances(attainable=0.999))
    assert "arrival" not in [condition.key for condition in reached.conditions]


def test_a_start_that_was_moved_is_said_with_how_far() -> None:
    impact = resolved("panda")
    told = verdict(impact, impact.evaluate(), impact.evaluate(), Circumstances(moved=0.25))
    assert told.conditions[-1].key == "start" and "0.25 (rad, m) away" in told.line


def test_a_stretched_arm_is_singular_along_its_axis() -> None:
    """Along a stretched arm the joints cannot yield; the singular value equals the norm of the row nᵀJ."""
    loaded = arm([Y, Y, Y], np.zeros(3), floating=False)
    straight, bent = np.zeros(3), np.array([0.3, 0.8, -0.5])
    for q, normal, singular in ((straight, (0.01, 0.0, 1.0), True), (bent, (0.0, 0.0, 1.0), False)):
        objective = WorstCaseObjective(loaded, ImpactContact(TIP, normal))
        motion = joint_yield(objective, q)
        oracle = objective.oracle.at(q)
        assert motion is not None and motion.singular == singular
        assert motion.along == pytest.approx(np.linalg.norm(oracle.n @ oracle.J))
        assert motion.largest == pytest.approx(np.linalg.norm(oracle.J, 2))


def test_joints_of_a_standing_robot_move_the_contact_with_feet_in_place() -> None:
    """The motion along the normal is the largest over velocities that keep the feet, found by a linear program."""
    impact = resolved("solo12")
    motion, oracle = impact.evaluate().joint_yield, impact.objective.oracle.at(impact.q)
    assert motion is not None
    v = np.linalg.pinv(np.vstack([oracle.Js, oracle.n @ oracle.J])) @ np.append(np.zeros(len(oracle.Js)), 1.0)
    # Any motion that keeps the feet and moves the contact at 1 m/s needs joint velocities of at least 1/along.
    assert np.linalg.norm(v[6:]) >= 1 / motion.along * (1 - 1e-6)


def test_feet_that_the_impact_lifts_come_first() -> None:
    impact = resolved("talos")
    evaluation = impact.evaluate()
    told = verdict(impact, evaluation, evaluation)
    standing = evaluation.standing
    assert standing is not None and standing.lifts and standing.holding_time is not None and standing.time == 0
    assert told.line.startswith(f"verdict: holds only if the feet stay; the impact lifts or tips {standing.lifts[0]}")
    assert f"if the contact is shorter than {1e3 * standing.holding_time:.2g} ms, before and after" in told.line
    assert ". No better. At 1 m/s" in told.line and ". With feet that lift or slide: no better, base" in told.line
    assert f"{standing.jump.normal_impulse:.3g} to" in told.line.partition("With feet")[2]


def test_the_weight_counts_if_the_contact_is_stated() -> None:
    impact = resolved("talos")
    duration = 0.05
    stated = replace(impact, contact_stiffness=ContactStiffness(duration=duration))
    evaluation = stated.evaluate()
    assert evaluation.standing is not None and not evaluation.standing.moves and evaluation.standing.time == duration
    told = verdict(stated, evaluation, evaluation)
    assert "feet" not in [condition.key for condition in told.conditions] and "With feet" not in told.line
    brief = replace(impact, contact_stiffness=ContactStiffness(duration=1e-4)).evaluate()
    assert brief.standing is not None and brief.standing.moves
    assert "with the weight over the 0.1 ms of the contact" in brief.standing.line


def test_feet_that_hardly_move_count_if_the_base_feels_them() -> None:
    """The soles of icub tip at less than 1 % of the approach speed, and the base turns more than twice as fast."""
    wall: dict[str, object] = {"robot": "icub", "normal": (-1.0, 0.0, 0.0), "friction": 0.0}
    impact = resolve(make_settings(wall | {"contact_stiffness": 1e6}))
    evaluation = impact.evaluate()
    told = verdict(impact, evaluation, evaluation)
    assert evaluation.standing is not None and not evaluation.standing.moves
    assert told.before is not None and told.unilateral is not None and "With feet that lift or slide" in told.line
    held, free = told.before.base_angular, told.unilateral[0].base_angular
    assert held is not None and free is not None and free > 2 * held
    assert told.unilateral[0].peak_force is not None and told.to_dict()["unilateral"]


def test_in_a_long_contact_the_robot_moves() -> None:
    """The surface moves 15 mm within 30 ms at 0.5 m/s."""
    for duration, long in ((29e-3, False), (31e-3, True)):
        impact = resolved("panda", speed=0.5, contact_duration=duration)
        told = verdict(impact, impact.evaluate(), impact.evaluate())
        assert ("contact time" in [condition.key for condition in told.conditions]) == long
        assert ("the robot moves during the 31 ms of the contact" in told.line) == long


def test_a_posture_against_itself() -> None:
    impact = resolved("panda")
    told = verdict(impact, impact.evaluate(), impact.evaluate())
    assert told.outcome == "no better" and told.jump == told.impulse == told.peak_force == 0
    assert "(linear contact)" in told.line
    still = resolved("panda", speed=0.0)
    told = verdict(still, still.evaluate(), still.evaluate())
    assert told.outcome == "unknown" and "no approach speed" in told.line
    assert told.to_dict()["before"] is None and told.to_dict()["assumptions"] == []


def test_advice_names_the_joint_model_that_fits() -> None:
    plain = resolved("panda", contact_stiffness=1e8)
    robot = replace(plain.robot, spec=replace(plain.robot.spec, transmission=TransmissionSpec("elastic", 14e3)))
    impact = replace(plain, objective=replace(plain.objective, robot=robot))
    (q,) = random_configurations(robot.model, 1, "fits", spread=0.3)
    told = verdict(impact, impact.evaluate(), impact.evaluate(q))
    assert any(line.startswith("with joint model 'link' (x = ") for line in told.advice)
    soft = replace(impact, contact_stiffness=ContactStiffness(linear=1e3))
    told = verdict(soft, soft.evaluate(), soft.evaluate(q))
    assert not any(line.startswith("with joint model") for line in told.advice)


def test_the_hand_of_talos_gets_worse_unless_the_jump_is_minimized() -> None:
    """The objective of the paper decreases, but the jump at a given speed does not."""
    settings = make_settings({"robot": "talos", "normal": (-1.0, 0.0, 0.0), "frame": "gripper_right_base_link"})
    settings = replace(settings, offset=(0.0, 0.0, 0.0))
    for kind, outcome in (("impulse", "worse"), ("coulomb", "better")):
        prepared = prepare(replace(settings, objective=kind))
        solution, evaluate = solve(prepared.problem, starts=4, compile="never"), prepared.impact.evaluate
        told = verdict(prepared.impact, evaluate(solution.initial), evaluate(solution.q))
        assert told.outcome.startswith(outcome) and told.jump is not None and (told.jump < 0) == (kind == "coulomb")
        assert kind == "coulomb" or solution.reduction > 0.5


@pytest.mark.parametrize(
    ("more", "kind", "words"),
    [
        ({}, "coulomb", "friction 0.7"),
        ({"friction": 0.0}, "speed", "slips freely"),
        ({"speed": 0.0}, "impulse", "no approach speed"),
        ({"normal_cone": 10.0}, "sticking", "over a cone"),
    ],
)
def test_auto_chooses_an_objective_and_gives_the_reason(more: dict[str, object], kind: str, words: str) -> None:
    prepared = prepare(make_settings({"robot": "tilthex_arm", **NORMAL, "objective": "auto", **more}))
    assert prepared.impact.objective.kind == kind and words in prepared.impact.choice
    assert f'objective = "{kind}"' in dump_settings(resolved_settings(prepared))


def test_several_contacts_come_at_once() -> None:
    task = {"robot": "talos", "contact": ("gripper_right_base_link:-1,0,0", "gripper_left_base_link:-1,0,0")}
    assert resolve(make_settings(task | {"objective": "auto"})).objective.kind == "impulse"
    strikes = {"path": True, "strike": True}
    pulled = strikes | {"bilateral": True}
    for more, kind in ((strikes, "sticking"), (pulled, "impulse"), ({"speed": 1.0}, "impulse")):
        impact = resolve(make_settings(task | more))
        assert impact.objective.kind == kind
        assert ("strike together" in impact.choice) == (kind == "sticking")
    impact = resolve(make_settings(task))
    known = impact.evaluate()
    line = verdict(impact, known, known).line
    assert ", all contacts at once: " in line
    assert known.together is not None
    size = f"{known.together[0].normal_impulse:.3g}"
    assert f"normal impulse at gripper_right_base_link {size} to {size} N·s (about the same)" in line
    assert known.together is not None and known.coulomb is not None
    # If the combined jump is unknown at one posture, only the first contact is compared, and the line says so.
    unknown = replace(known, together=None)
    pulls = resolve(make_settings(task | {"bilateral": True}))
    for told in (verdict(impact, known, unknown), verdict(impact, unknown, known), verdict(pulls, unknown, unknown)):
        assert told.outcome == "no better" and ", at gripper_right_base_link alone: " in told.line
        assert told.before is not None and told.before == told.after and told.before.jump == known.coulomb.norm


def test_the_command_prints_the_verdict_first(tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = succeed(
        "optimize", "tilthex_arm", "--normal", 0, 0, 1, "--objective", "auto", "--friction", 0.3, "--starts", 4,
        "--no-codegen", "--out", out,
    )  # fmt: skip
    assert "objective coulomb: at 1 m/s with friction 0.3" in done.stdout
    assert done.stdout.index("verdict: better for the ") < done.stdout.index("before")
    document = json.loads((out / "result.json").read_text())
    assert "at the price of base" in document["verdict"]["outcome"] and document["verdict"]["jump"] < -0.5
    assert document["metric"]["objective"] == "coulomb" and document["notes"][0].startswith("objective coulomb")
    told = np.array([document[name]["jump"]["coulomb"]["norm"] for name in ("initial", "optimal")])
    assert document["verdict"]["jump"] == pytest.approx(told[1] / told[0] - 1)
    assert [document["verdict"][side]["jump"] for side in ("before", "after")] == told.tolist()
    assert document["verdict"]["before"]["peak_force"] is None and document["verdict"]["after"]["sticks"] is not None
    free = ("--starts", 2, "--no-collision", "--no-holdable", "--no-codegen", "--out", tmp_path / "talos")
    paper = run("optimize", "talos", "--normal", -1, 0, 0, *free)
    assert (
        " Worse. At" in " ".join(paper.stdout.split())
        and "--objective coulomb minimizes this whole jump" in paper.stdout
    )


@pytest.mark.parametrize(
    ("kind", "more", "better"),
    [
        ("impulse", {}, "coulomb"),
        ("impulse", {"friction": 0.0}, "coulomb"),
        ("impulse", {"normal_cone": 5.0}, "sticking"),
        ("impulse", {"normal_cone": 5.0, "friction": 0.0}, None),
        # If the objective minimizes the compared jump, the verdict does not advise another objective.
        ("speed", {"friction": 0.0}, None),
        ("sticking", {"friction": 5.0}, None),
        ("sticking", {"friction": 0.0}, "coulomb"),
    ],
)
def test_another_objective_is_advised_only_if_it_minimizes_the_jump(
    kind: str, more: dict[str, object], better: str | None
) -> None:
    prepared = prepare(make_settings({"robot": "panda", **NORMAL, "objective": kind, **more}))
    evaluation = prepared.impact.evaluate()
    # If both postures are the same, the verdict states no improvement.
    told = verdict(prepared.impact, evaluation, evaluation)
    assert told.outcome == "no better"
    advised = [line for line in told.advice if "minimizes this whole jump" in line]
    assert [line.split()[1] for line in advised] == ([] if better is None else [better])


@pytest.mark.parametrize(
    ("robot", "more", "approaches"),
    [
        ("panda", {}, False),
        ("panda", {"speed": 0.3}, True),
        ("panda", {"speed": 0.3, "approach": False}, False),
        ("panda", {"approach": True}, True),
        ("tilthex_arm", {"speed": 0.3}, False),
        ("talos", {"speed": 0.3, "normal": (-1.0, 0.0, 0.0), "frame": "gripper_right_base_link"}, True),
    ],
)
def test_a_stated_speed_must_be_reached_unless_the_robot_flies(
    robot: str, more: dict[str, object], approaches: bool
) -> None:
    prepared = prepare(make_settings({"robot": robot, **NORMAL, "objective": "impulse", **more}))
    assert any(isinstance(c, ApproachSpeed) for c in prepared.problem.constraints) == approaches
    assert resolved_settings(prepared).approach == approaches
