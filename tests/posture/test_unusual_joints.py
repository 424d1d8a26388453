"""Robots with passive, free, held and sliding joints: checks, notes, and pairs of links that need no distance."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.collision.robot_shapes import RobotShapes, load_shapes
from impact_posture.config.problem_settings import ProblemSettings
from impact_posture.config.table_validation import validate
from impact_posture.dynamics.numeric import Numeric
from impact_posture.output.result_reader import _collisions as drawn_collisions
from impact_posture.posture.approach.attainable_speed import AttainableSpeed
from impact_posture.posture.constraints.requirements import Requirements
from impact_posture.posture.formulation.problem_file import Prepared, prepare
from impact_posture.posture.manifold.feasible_start import feasible_start
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.search.growing_search import feasible
from impact_posture.posture.search.multistart import solve
from tests.support.pinocchio_values import central_gradient
from tests.support.urdfs import MOVED, joint, link, load, write

LINKS = (link("stand", 5), link("upper", 2, "0.2 0 0"), link("fore", 1.5, "0.2 0 0"), link("palm", 0.5, "0.05 0 0"))
TIP = (link("tip"), joint("tip_mount", "palm tip", None, "0.1 0 0", "fixed", ""))
BENT = "[postures.bent]\njoints = { a = -0.9, b = 1.2, c = 0.5 }\n"


def prepared(path: Path, **settings: Any) -> Prepared:
    values = {"robot": str(path), "frame": "tip", "normal": (0.0, 0.0, 1.0), "contact_pose": "position"}
    return prepare(validate(ProblemSettings, {**values, **settings}, "options"))


def posed(folder: Path, *elements: str, toml: str = BENT, **settings: Any) -> ConstrainedProblem:
    return prepared(write(folder, *elements, toml=toml), **settings).problem


def test_joints_whose_torque_is_not_checked_are_named(tmp_path: Path) -> None:
    """Effort 0 means that no limit is stated; a floating joint has no actuator."""
    arm = (*LINKS, *TIP, joint("a", "stand upper", at="0 0 0.3"), joint("c", "fore palm", at="0.4 0 0"))
    elbow = joint("b", "upper fore", at="0.4 0 0")
    torque, balance = "the torque of b is not checked", "the balance of load is not checked"
    load = link("crate", 1), joint("load", "upper crate", None, kind="floating", more="")
    assert not [note for note in posed(tmp_path, *arm, elbow).notes if "not checked" in note]
    for parts, expected in (
        ((elbow.replace('effort="100"', 'effort="0"'),), (torque,)),
        ((elbow, *load), (balance,)),
        ((elbow.replace('effort="100"', 'effort="0"'), *load), (torque, balance)),
    ):
        problem = posed(tmp_path, *arm, *parts)
        notes = [note for note in problem.notes if "not checked" in note]
        assert len(notes) == len(expected)
        assert all(words in note for words, note in zip(expected, notes, strict=True))
        assert "joint torques within limits at rest" in [c.describe() for c in problem.constraints]


def test_a_joint_with_equal_limits_is_held_at_them(tmp_path: Path) -> None:
    """The posture of robot.toml does not name the joint; the same joint, held in a wide range, is the reference."""
    arm = (
        *LINKS, *TIP, link("mid", 1, "0.15 0 0"), joint("a", "stand upper", at="0 0 0.3"),
        joint("b", "upper fore", at="0.4 0 0"), joint("c", "mid palm", at="0.3 0 0"),
    )  # fmt: skip
    wide = joint("k", "fore mid", at="0.4 0 0")
    equal = wide.replace('lower="-2.5" upper="2.5"', 'lower="0.4" upper="0.4"')
    problem = posed(tmp_path, *arm, equal)
    k = problem.robot.joint_names.index("k")
    assert [line for line in problem.robot.warnings if "equal position limits are held at them: k" in line]
    assert problem.given[k] == 0.4
    solution = solve(problem, starts=3, jobs=1, compile="never")
    toml = BENT.replace("b = 1.2", "b = 1.2, k = 0.4")
    held = solve(posed(tmp_path, *arm, wide, toml=toml, hold=("k",)), starts=3, jobs=1, compile="never")
    assert solution.q[k] == 0.4
    assert solution.redundancy == held.redundancy == 1
    assert solution.optima[0].objective == pytest.approx(held.optima[0].objective, rel=1e-9)
    assert solution.certificate.stationarity < 1e-6


def gripper(folder: Path, gap: float, **settings: Any) -> ConstrainedProblem:
    """Return a problem with two fingers, a plate each, that are ``gap`` (m) apart when closed."""
    at = 0.006 + gap / 2
    slide = MOVED.replace("-2.5", "0").replace("2.5", "0.04")
    fingers = [
        part
        for side, name in ((1, "left"), (-1, "right"))
        for part in (
            link(name, 0.05, "0.04 0 0", box="0.06 0.012 0.02"),
            joint(f"{name}_joint", f"palm {name}", f"0 {side} 0", f"0.08 {side * at} 0", "prismatic", slide),
        )
    ]
    arm = joint("a", "stand upper", at="0 0 0.3"), joint("b", "upper fore", at="0.4 0 0")
    return posed(folder, *LINKS, *TIP, *arm, joint("c", "fore palm", at="0.4 0 0"), *fingers, **settings)


@pytest.mark.parametrize(("gap", "noted"), [(-0.0004, True), (0.0, True), (0.002, False)])
def test_held_fingers_may_touch(tmp_path: Path, gap: float, noted: bool) -> None:
    """Nothing can open held fingers, so a note names their pair, even if their shapes overlap."""
    problem = gripper(tmp_path, gap, hold=("left_joint", "right_joint"))
    assert any("held joints fix them: left / right" in note for note in problem.notes) == noted
    assert "self-collision" not in [c.name for c in problem.constraints]
    assert problem.surroundings is not None and not problem.surroundings.collisions(problem.given)
    assert feasible(problem, problem.given)


@pytest.mark.parametrize("hold", [(), ("left_joint", "right_joint")])
def test_pictures_show_no_collision_of_held_fingers(tmp_path: Path, hold: tuple[str, ...]) -> None:
    """The problem has no collision constraints, so the figures check for collisions."""
    q = gripper(tmp_path, -0.0004, hold=("left_joint", "right_joint")).given
    unchecked = prepared(tmp_path / "written.urdf", hold=hold, collision=False)
    assert drawn_collisions(unchecked, q) == ([] if hold else [("left", "right")],)


def test_fingers_that_move_are_kept_apart(tmp_path: Path) -> None:
    problem = gripper(tmp_path, 0.0)
    assert not [note for note in problem.notes if "left / right" in note]
    (clearance,) = [c for c in problem.constraints if c.name == "self-collision"]
    assert clearance.rows == 1
    assert clearance.value(Numeric(problem.robot.model).at(problem.given))[0] == pytest.approx(-0.001, abs=1e-7)


def test_parts_of_a_telescope_may_overlap(tmp_path: Path) -> None:
    """Three slides along x form a telescope.  A slide along y does not, so its pairs are still checked."""
    slide = MOVED.replace("-2.5", "0").replace("2.5", "0.25")
    sizes = (0.09, 0.07, 0.05, 0.03)
    links = [link(f"boom{k}", 1, "0.2 0 0", box=f"0.3 {w} {w}") for k, w in enumerate(sizes)]

    def telescope(second_axis: str) -> RobotShapes:
        axes = ("1 0 0", second_axis, "-1 0 0")
        slides = [
            joint(f"slide{k}", f"boom{k - 1} boom{k}", axis, "0.02 0 0", "prismatic", slide)
            for k, axis in enumerate(axes, 1)
        ]
        return load_shapes(load(tmp_path, link("stand", 5), *links, joint("turn", "stand boom0", "0 0 1"), *slides))

    nested = {("boom0", "boom2"), ("boom0", "boom3"), ("boom1", "boom3")}
    assert {*telescope("1 0 0").always_touching} == nested
    assert not len(telescope("1 0 0").pairs)
    assert ("boom0", "boom3") not in telescope("0 1 0").always_touching


def coupled_gripper(folder: Path, frame: str = "right", **settings: Any) -> ConstrainedProblem:
    """Return a problem in which the right finger moves 1.5 times as far as the left finger, upwards."""
    slide = MOVED.replace("-2.5", "0").replace("2.5", "0.04")
    mimic = '<mimic joint="left_joint" multiplier="1.5" offset="0.005"/>'
    fingers = (
        link("left", 0.3, "0.04 0 0"), link("right", 0.4, "0.04 0 0"),
        joint("left_joint", "palm left", "0 1 0.5", "0.08 0 0", "prismatic", slide),
        joint("right_joint", "palm right", "0 -1 0.5", "0.08 0 0", "prismatic", MOVED + mimic),
    )  # fmt: skip
    arm = joint("a", "stand upper", at="0 0 0.3"), joint("b", "upper fore", at="0.4 0 0")
    return posed(folder, *LINKS, *TIP, *arm, joint("c", "fore palm", at="0.4 0 0"), *fingers, frame=frame, **settings)


def test_the_motor_of_the_leader_carries_its_followers(tmp_path: Path) -> None:
    """The torques at rest equal the torques of a Pinocchio model with mimic joints."""
    problem = coupled_gripper(tmp_path)
    reference = pin.buildModelFromUrdf(str(tmp_path / "written.urdf"), mimic=True)
    q = problem.robot.coupled(np.array([-0.4, 1.1, 0.3, 0.02, 0.0]))
    (holdable,) = [c for c in problem.constraints if c.describe() == "joint torques within limits at rest"]
    expected = np.array(pin.computeGeneralizedGravity(reference, reference.createData(), q[:4])) / 100
    rows = holdable.evaluate(Numeric(problem.robot.model).at(q))[0][1:]
    assert rows + 1 == pytest.approx(np.abs(expected), abs=1e-12)
    assert abs(expected[3]) > 0.01
    assert not [note for note in problem.notes if "not checked" in note]


def test_a_follower_moves_with_its_leader_in_program_and_approach(tmp_path: Path) -> None:
    problem = coupled_gripper(tmp_path, contact_pose="box")
    assert "joint 'right_joint' moves with 'left_joint'" in problem.describe()
    solution = solve(problem, starts=4, jobs=1, compile="never")
    assert solution.certificate.holds()
    assert solution.q[4] == pytest.approx(1.5 * solution.q[3] + 0.005, abs=1e-9)
    random = [feasible_start(problem, k, 1) for k in range(1, 12)]
    values = [problem.objective.value(q) for q in random if q is not None]
    assert values and solution.optima[0].objective < min(values)
    # The limit 5 m/s of the right finger bounds the left finger, whose own limit would allow 7.5 m/s.
    assert problem.robot.velocity_limits[3:] == pytest.approx([5 / 1.5, 5])
    attainable = AttainableSpeed(problem.robot, problem.objective, Requirements(contact_pose="position"))
    assert [problem.robot.tangent_names[k] for k in attainable.free] == ["a", "b", "c", "left_joint"]
    numeric = Numeric(problem.robot.model).at(problem.given)
    attained = attainable.at(numeric)
    v = attainable.moves @ attained.velocities
    assert v[4] == pytest.approx(1.5 * v[3]) and np.abs(v[3:]).max() <= 5 + 1e-9
    slope = central_gradient(
        lambda q: attainable.at(Numeric(problem.robot.model).at(q)).speed, problem.robot.model, problem.given, 1e-4
    )
    assert attained.gradient == pytest.approx(slope, abs=1e-5 * np.abs(slope).max())


def test_holding_one_coupled_joint_holds_the_others(tmp_path: Path) -> None:
    problem = coupled_gripper(tmp_path, hold=("right_joint",))
    assert set(problem.requirements.hold) == {"left_joint", "right_joint"}
    assert not [c for c in problem.constraints if c.name.startswith("coupling")]
