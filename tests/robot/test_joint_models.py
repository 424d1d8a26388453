"""Joint models: what an impact meets at the joints, against Pinocchio's models without rotors or without joints."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from impact_posture.codegen.export import export
from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.config.settings import JointModel, ObjectiveKind
from impact_posture.errors import ImpactPostureError, InertiaError, InputError, JointNotFound
from impact_posture.impact.friction.contact_stability import contact_stability
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.metric import Metric
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.formulation.problem_file import prepare, read_settings
from impact_posture.posture.program.compiled_solver import _key
from impact_posture.posture.search.multistart import solve
from impact_posture.robot.joint_model import describe_joints, transmissions, with_joint_model
from impact_posture.robot.model_variant import Payload, between, build_model_variants
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import JointTransmissionSpec, TransmissionSpec
from impact_posture.system.libraries import build_library, library_path
from tests.support.arms import TIP, X, Y, Z, arm
from tests.support.command import run
from tests.support.helpers import assert_close, central_gradient, random_configurations, relative, rng, robot, unit
from tests.support.settings import make_settings
from tests.support.tools import need_compiler

FRAMES = {"tilthex_arm": "ee", "panda": "panda_hand_tcp", "talos": "gripper_right_base_link", "solo12": "base_link"}
KINDS: tuple[ObjectiveKind, ...] = ("impulse", "speed", "sticking", "energy")


def stated(found: Robot, **table: object) -> Robot:
    """Return the robot with another ``[transmission]``."""
    return replace(found, spec=replace(found.spec, transmission=TransmissionSpec(**table)))  # type: ignore[arg-type]


def objective(
    found: Robot, frame: str, kind: ObjectiveKind = "impulse", metric: str = "euclidean"
) -> WorstCaseObjective:
    feet = found.spec.supports
    return WorstCaseObjective(found, ImpactContact(frame, (0.2, 0.1, 1.0)), Metric(metric), kind, feet)  # type: ignore[arg-type]


def with_some_locked(found: Robot, count: int = 2) -> Robot:
    """Return the link model of a robot whose last joints are locked and whose first joint is rigid."""
    names = found.joint_names
    joints = {name: JointTransmissionSpec("locked") for name in names[-count:]}
    joints[names[0]] = JointTransmissionSpec("rigid")
    return with_joint_model(stated(found, joints=joints), "link")


# ---- what a joint model is --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FRAMES)
def test_the_armature_of_each_joint_model(name: str) -> None:
    found = stated(robot(name))
    joints = slice(6 if found.floating else 0, None)
    reflected, link = with_joint_model(found, "reflected"), with_joint_model(found, "link")
    np.testing.assert_array_equal(reflected.model.armature, found.armature)
    assert not np.any(link.model.armature)
    for made in (reflected, link):
        np.testing.assert_array_equal(made.armature, found.armature)
        assert made.model_sha256 == found.model_sha256, "the robot is the same"
        back = with_joint_model(made, "reflected")
        np.testing.assert_array_equal(back.model.armature, found.armature)
    some = with_some_locked(found)
    armature = np.array(some.model.armature[joints])
    assert armature[0] == found.armature[joints][0] and np.isinf(armature[-2:]).all() and not armature[1:-2].any()
    assert len({made.impact_sha256 for made in (found, some, *([link] if found.armature.any() else []))}) > 1
    assert "2 of" in describe_joints(some) and "1 rigid" in describe_joints(some)


@pytest.mark.parametrize("name", FRAMES)
@pytest.mark.parametrize("kind", KINDS)
def test_links_alone_are_the_robot_without_armature(name: str, kind: ObjectiveKind) -> None:
    found = stated(robot(name))
    bare = pin.Model(found.model)
    bare.armature = np.zeros(found.nv)
    mine = objective(with_joint_model(found, "link"), FRAMES[name], kind)
    other = objective(replace(found, model=bare), FRAMES[name], kind)
    for q in random_configurations(found.model, 3, name, "link"):
        assert mine.value(q) == pytest.approx(other.value(q), rel=1e-13)
        assert_close(mine.gradient(q), other.gradient(q), 1e-12, name)


@pytest.mark.parametrize("name", ["tilthex_arm", "panda", "talos"])
@pytest.mark.parametrize("metric", ["euclidean", "kinetic"])
@pytest.mark.parametrize("kind", KINDS)
def test_locked_joints_are_those_of_a_model_without_them(name: str, kind: ObjectiveKind, metric: str) -> None:
    """Pinocchio's own reduced model, built anew at each posture, in which locked joints do not exist."""
    found = robot(name)
    supports = () if name == "talos" else found.spec.supports
    joints = {joint: JointTransmissionSpec("locked") for joint in found.joint_names[1::3]}
    some = with_joint_model(stated(found, joints=joints, kind="rigid"), "link")
    mine = replace(objective(some, FRAMES[name], kind, metric), supports=supports)
    ids = [found.joint_id(joint) for joint in joints]
    kept = np.isfinite(some.model.armature)
    for q in random_configurations(found.model, 2, name, "locked"):
        model = pin.buildReducedModel(found.model, ids, q)
        model.armature = found.armature[kept]
        names = tuple(n for n in found.joint_names if n not in joints)
        alone = replace(found, model=model, spec=replace(found.spec, transmission=TransmissionSpec()))
        assert alone.joint_names == names
        other = replace(mine, robot=alone)
        parts = [
            q[found.model.idx_qs[i] : found.model.idx_qs[i] + found.model.nqs[i]]
            for i in range(1, found.model.njoints)
            if i not in ids
        ]
        short = np.concatenate(parts)
        assert mine.value(q) == pytest.approx(other.value(short), rel=1e-9)
        assert not mine.oracle.quantities(q).jump[~kept].any()
        # The gradient along the joints that exist in both.
        assert relative(mine.gradient(q)[kept], other.gradient(short)) < 1e-8


@pytest.mark.parametrize("name", FRAMES)
@pytest.mark.parametrize("metric", ["euclidean", "kinetic"])
@pytest.mark.parametrize("kind", KINDS)
def test_kernel_oracle_and_differences_agree(name: str, kind: ObjectiveKind, metric: str) -> None:
    found = with_some_locked(robot(name))
    mine = objective(found, FRAMES[name], kind, metric)
    tight = 1e-7 if mine.supports else 1e-9
    function = mine.gradient_fun()
    for q in random_configurations(found.model, 2, name, "kernel"):
        value, gradient = function(q, np.array(mine.contact.normal))
        assert float(value) == pytest.approx(mine.value(q), rel=tight)
        assert relative(np.array(gradient).ravel(), mine.gradient(q)) < tight
        measured = central_gradient(mine.value, found.model, q, 1e-4)
        assert relative(measured, mine.gradient(q)) < (1e-5 if mine.supports else 1e-7)


@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_random_arms_with_random_transmissions(data: st.DataObject) -> None:
    count = data.draw(st.integers(2, 5))
    axes = [data.draw(st.sampled_from([X, Y, Z])) for _ in range(count)]
    angles = [data.draw(st.floats(-1.5, 1.5)) for _ in range(count)]
    floating = data.draw(st.booleans())
    kinds = [data.draw(st.sampled_from(["rigid", "elastic", "locked"])) for _ in range(count)]
    made = arm(axes, angles, floating=floating)
    table = {joint: JointTransmissionSpec(kind) for joint, kind in zip(made.joint_names, kinds, strict=True)}
    if not floating and set(kinds) == {"locked"}:
        with pytest.raises(InputError, match="nothing moves"):
            with_joint_model(stated(made, joints=table), "link")
        return
    found = with_joint_model(stated(made, joints=table), "link")
    q = found.posture()
    mine = WorstCaseObjective(found, ImpactContact(TIP, unit(rng("arms", count))))
    value, gradient = mine.gradient_fun()(q, np.array(mine.contact.normal))
    quantities = mine.oracle.quantities(q)
    assert float(value) == pytest.approx(quantities.H, rel=1e-9, abs=1e-12)
    scale = max(np.abs(mine.gradient(q)).max(), 1e-6 * quantities.H, 1e-12)
    assert np.abs(np.array(gradient).ravel() - mine.gradient(q)).max() < 1e-8 * scale + 1e-13
    # More inertia at a joint never makes the contact easier to move.
    if floating:
        rigid = WorstCaseObjective(with_joint_model(made, "locked"), mine.contact).oracle.quantities(q)
        free = WorstCaseObjective(with_joint_model(stated(made), "link"), mine.contact).oracle.quantities(q)
        assert rigid.G <= quantities.G * (1 + 1e-9) <= free.G * (1 + 2e-9)


# ---- what follows from it ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["tilthex_arm", "panda"])
def test_the_export_has_the_numbers_of_its_joint_model(name: str, tmp_path: Path) -> None:
    need_compiler()
    found = with_some_locked(robot(name))
    mine = objective(found, FRAMES[name])
    made = export(mine, tmp_path, prefix="joints", check=False)
    build_library(tmp_path, "joints")
    assert made.manifest["joint_model"] == "link"
    np.testing.assert_array_equal(made.manifest["armature"], found.armature)
    # A controller loads it with the robot as it stands.
    loaded = ImpactGradient.load(tmp_path, robot=robot(name))
    assert library_path(tmp_path, "joints").exists()
    for q in random_configurations(found.model, 3, name, "export"):
        value, gradient = loaded.value_and_gradient(q, np.array(mine.contact.normal))
        assert value == pytest.approx(mine.oracle.quantities(q).H, rel=1e-9)
        assert relative(gradient, mine.oracle.gradient_H(q)) < 1e-8


@pytest.mark.parametrize(
    ("name", "joint_model"), [("tilthex_arm", "locked"), ("tilthex_arm", "link"), ("panda", "link")]
)
def test_the_search_is_certified(name: str, joint_model: JointModel) -> None:
    chosen = make_settings({"robot": name, "normal": (0.0, 0.0, 1.0), "joint_model": joint_model, "starts": 3})
    prepared = prepare(chosen)
    assert prepared.impact.robot.joint_model == joint_model
    reflected = prepare(replace(chosen, joint_model="reflected"))
    assert _key(prepared.problem) != _key(reflected.problem), "other functions, other cache"
    found = solve(prepared.problem, starts=3, compile="never")
    assert found.certificate.holds() and found.certified_starts == 3
    other = solve(reflected.problem, starts=3, compile="never")
    own = prepared.problem.objective.value
    assert own(found.q) <= own(other.q) * (1 + 1e-9), "the optimum of its own model"


def test_variants_keep_the_joint_model() -> None:
    found = with_some_locked(robot("panda"))
    variants = build_model_variants(found, (0.5, 2.0), [Payload("panda_hand", 1.0)])
    for made in (*[v.robot for v in variants], *between(variants, 3, 0)):
        assert made.joint_model == "link"
        np.testing.assert_array_equal(np.isinf(made.model.armature), np.isinf(found.model.armature))
        assert made.model.armature[0] == pytest.approx(made.armature[0])
    with pytest.raises(InputError, match="joint model 'link'"):
        build_model_variants(with_joint_model(robot("panda"), "link"), (0.5, 2.0), [])


def test_feet_under_locked_joints() -> None:
    """With one leg locked the feet still stay, by finite impulses."""
    found = robot("solo12")
    legs = {joint: JointTransmissionSpec("locked") for joint in found.joint_names[:3]}
    mine = objective(with_joint_model(stated(found, joints=legs), "link"), "base_link")
    stability = contact_stability(mine.oracle, mine.supports, found.posture())
    assert all(np.isfinite(foot.impulse).all() for foot in stability.feet)


# ---- refusals and the command -----------------------------------------------------------------------------------


def test_what_a_table_says_by_joint() -> None:
    found = robot("panda")
    first, second = found.joint_names[:2]
    table = transmissions(
        stated(
            found, kind="elastic", stiffness=14000.0, damping=3.0,
            joints={first: JointTransmissionSpec("rigid"), second: JointTransmissionSpec(None, 9000.0, 0.0)},
        )
    )  # fmt: skip
    assert list(table.elastic) == [False] + [True] * (found.nv - 1)
    assert list(table.stiffness[:3]) == [14000.0, 9000.0, 14000.0] and list(table.damping[:3]) == [3.0, 0.0, 3.0]


@pytest.mark.parametrize(
    ("change", "joint_model", "error", "words"),
    [
        ({}, "locked", InputError, "nothing moves"),
        ({"kind": "locked"}, "link", InputError, "nothing moves"),
        ({"joints": {"panda_joint9": JointTransmissionSpec("rigid")}}, "link", JointNotFound, "panda_joint"),
    ],
)
def test_refusals(
    change: dict[str, object], joint_model: JointModel, error: type[ImpactPostureError], words: str
) -> None:
    with pytest.raises(error, match=words):
        with_joint_model(stated(robot("panda"), **change), joint_model)


def test_a_joint_that_cannot_be_driven_moves_in_no_joint_model() -> None:
    table = {"kind": "elastic", "stiffness": 1e4, "joints": {"elbow_joint": JointTransmissionSpec("locked")}}
    found = stated(robot("ur5"), **table)
    for joint_model in ("reflected", "link", "elastic"):
        assert np.isinf(with_joint_model(found, joint_model).model.armature).sum() == 1  # type: ignore[arg-type]
    with pytest.raises(InputError, match="one posture"):
        export(objective(with_joint_model(found, "elastic"), "tool0"), Path())


def test_links_without_inertia_are_named() -> None:
    made = arm([Z, Y], [0.3, 0.4], floating=False)
    model = pin.Model(made.model)
    model.inertias[2] = pin.Inertia(0.2, np.zeros(3), np.zeros((3, 3)))
    with pytest.raises(InertiaError, match=r"joint model 'link'.*joint_1 moves no inertia"):
        with_joint_model(replace(made, model=model), "link")


def test_the_commands(tmp_path: Path) -> None:
    done = run("evaluate", "panda", "--normal", 0, 0, 1, "--joint-model", "link", "--json")
    document = json.loads(done.stdout)
    assert document["robot"]["joint_model"] == "link" and set(document["robot"]["armature"]) == {0.1}
    plain = json.loads(run("evaluate", "panda", "--normal", 0, 0, 1, "--armature", "none", "--json").stdout)
    assert document["evaluation"]["H"] == pytest.approx(plain["evaluation"]["H"], rel=1e-12)
    for asked, words in (
        (("panda", "--joint-model", "locked"), "nothing moves"),
        (("solo12", "--frame", "base_link", "--joint-model", "locked"), "its feet stay, so nothing moves"),
        (("panda", "--joint-model", "soft"), "joint-model"),
    ):
        failed = run("evaluate", *asked, "--normal", 0, 0, 1)
        assert failed.returncode in (1, 2) and words in failed.stderr and "Traceback" not in failed.stderr
    out = tmp_path / "out"
    done = run(
        "optimize",
        "tilthex_arm",
        "--normal",
        0,
        0,
        1,
        "--joint-model",
        "link",
        "--starts",
        2,
        "--no-codegen",
        "--out",
        out,
    )
    assert done.returncode == 0, done.stderr
    assert "links without rotors" in done.stdout
    assert read_settings(out / "problem.toml").joint_model == "link"
