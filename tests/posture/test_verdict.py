"""The verdict on a posture: predicted jumps in words, better settings, and the objective ``auto``."""

from __future__ import annotations

import json
from dataclasses import replace
from math import sqrt
from pathlib import Path

import numpy as np
import pytest

from impact_posture.impact.elasticity.contact_compression import ContactStiffness
from impact_posture.impact.resolved_impact import ResolvedImpact, resolve
from impact_posture.posture.analysis.verdict import verdict
from impact_posture.posture.formulation.problem_file import dump_settings, prepare, resolved_settings
from impact_posture.posture.search.multistart import solve
from impact_posture.robot.robot_spec import TransmissionSpec
from tests.support.command import run
from tests.support.helpers import random_configurations
from tests.support.settings import make_settings

NORMAL = {"normal": (0.0, 0.0, 1.0)}
CASES = {"panda": {}, "tilthex_arm": {}, "solo12": {"frame": "base_link"}, "talos": {"normal": (-1.0, 0.0, 0.0)}}


def resolved(name: str, **more: object) -> ResolvedImpact:
    return resolve(make_settings({"robot": name, **NORMAL, **CASES[name], **more}))


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("friction", [0.0, 0.3, 5.0])
def test_the_changes_follow_from_the_predicted_jumps(name: str, friction: float) -> None:
    impact = resolved(name, friction=friction, speed=0.6, contact_stiffness=2e5)
    model = impact.robot.model
    for q in random_configurations(model, 2, name, "verdict", spread=0.3):
        before, after = impact.evaluate(), impact.evaluate(q)
        assert before.coulomb is not None and after.coulomb is not None
        told = verdict(impact, before, after)
        assert told.jump == pytest.approx(after.coulomb.norm / before.coulomb.norm - 1)
        assert told.impulse == pytest.approx(after.coulomb.normal_impulse / before.coulomb.normal_impulse - 1)
        assert told.peak_force == pytest.approx(sqrt(told.impulse + 1) - 1)
        assert told.jump is not None and told.impulse is not None and told.peak_force is not None
        expected = "better at the price of impulse" if told.impulse > 0.01 else "better"
        expected = "better at the price of force" if told.peak_force > 0.01 else expected
        if told.jump > -0.01:
            expected = "worse" if told.jump > 0.01 else "no better"
        assert told.outcome == expected and told.line.startswith(f"verdict: {expected}.")
        assert ("sticking)" if after.coulomb.sticks else "slipping)") in told.line
        assert any("`objective` coulomb" in line for line in told.advice) == (expected in ("worse", "no better"))
        assert any("max_force" in line for line in told.advice) == (expected == "better at the price of force")
        assert told.before is not None and told.after is not None
        for side, quantities in ((told.before, before), (told.after, after)):
            assert quantities.coulomb is not None and quantities.compression is not None
            assert (side.jump, side.impulse) == (quantities.coulomb.norm, quantities.coulomb.normal_impulse)
            assert (side.peak_force, side.sticks) == (quantities.compression.peak_force, quantities.coulomb.sticks)
        assert told.assumptions[0] == f"rigid impact at 0.6 m/s with restitution 0, with friction {friction:g}"
        assert ("the feet stay on the ground" in told.assumptions) == bool(impact.objective.supports)
        assert told.assumptions[-1] == f"peak force of the stated contact, with friction {friction:g}"


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
        ({"normal_cone": 10.0}, "sticking", "cone of normals"),
    ],
)
def test_auto_chooses_an_objective_and_gives_the_reason(more: dict[str, object], kind: str, words: str) -> None:
    prepared = prepare(make_settings({"robot": "tilthex_arm", **NORMAL, "objective": "auto", **more}))
    assert prepared.impact.objective.kind == kind and words in prepared.impact.choice
    assert f'objective = "{kind}"' in dump_settings(resolved_settings(prepared))


def test_several_contacts_come_at_once() -> None:
    task = {"robot": "talos", "contact": ("gripper_right_base_link:-1,0,0", "gripper_left_base_link:-1,0,0")}
    assert resolve(make_settings(task | {"objective": "auto"})).objective.kind == "impulse"
    impact = resolve(make_settings(task))
    known = impact.evaluate()
    line = verdict(impact, known, known).line
    assert ", all contacts at once, the jump stays" in line
    assert "the normal impulse at gripper_right_base_link stays" in line
    assert known.together is not None and known.coulomb is not None
    # If the combined jump is unknown at one posture, only the first contact is compared, and the line says so.
    unknown = replace(known, together=None)
    pulls = resolve(make_settings(task | {"bilateral": True}))
    for told in (verdict(impact, known, unknown), verdict(impact, unknown, known), verdict(pulls, unknown, unknown)):
        assert told.outcome == "no better" and ", at gripper_right_base_link alone, the jump stays" in told.line
        assert told.before is not None and told.before == told.after and told.before.jump == known.coulomb.norm


def test_the_command_prints_the_verdict_first(tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = run(
        "optimize", "tilthex_arm", "--normal", 0, 0, 1, "--objective", "auto", "--friction", 0.3, "--starts", 4,
        "--no-codegen", "--out", out,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "objective coulomb: at 1 m/s with friction 0.3" in done.stdout
    assert done.stdout.index("verdict: better.") < done.stdout.index("before")
    document = json.loads((out / "result.json").read_text())
    assert document["verdict"]["outcome"] == "better" and document["verdict"]["jump"] < -0.5
    assert document["metric"]["objective"] == "coulomb" and document["notes"][0].startswith("objective coulomb")
    told = np.array([document[name]["jump"]["coulomb"]["norm"] for name in ("initial", "optimal")])
    assert document["verdict"]["jump"] == pytest.approx(told[1] / told[0] - 1)
    assert [document["verdict"][side]["jump"] for side in ("before", "after")] == told.tolist()
    assert document["verdict"]["before"]["peak_force"] is None and document["verdict"]["after"]["sticks"] is not None
    free = ("--starts", 2, "--no-collision", "--no-holdable", "--no-codegen", "--out", tmp_path / "talos")
    paper = run("optimize", "talos", "--normal", -1, 0, 0, *free)
    assert "verdict: worse." in paper.stdout and "--objective coulomb minimizes this jump" in paper.stdout


@pytest.mark.parametrize(
    ("kind", "more", "better"),
    [
        ("impulse", {}, "coulomb"),
        ("impulse", {"friction": 0.0}, "coulomb"),
        ("impulse", {"normal_cone": 5.0}, "sticking"),
        ("impulse", {"normal_cone": 5.0, "friction": 0.0}, None),
        # The verdict does not blame an objective that minimizes the compared jump.
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
    # For the given posture itself, the verdict is not an improvement.
    told = verdict(prepared.impact, evaluation, evaluation)
    assert told.outcome == "no better"
    advised = [line for line in told.advice if "minimizes this jump" in line]
    assert [line.split()[1] for line in advised] == ([] if better is None else [better])
