"""Joint models: their inertia in an impact, compared with Pinocchio models without rotors or without joints."""

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
from impact_posture.config.problem_settings import JointModel, ObjectiveKind
from impact_posture.errors import ImpactPostureError, InertiaError, InputError, JointNotFound
from impact_posture.impact.friction.contact_stability import contact_stability
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.metric import Metric
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.formulation.problem_file import prepare, read_settings
from impact_posture.posture.program.compiled_solver import _key
from impact_posture.posture.search.multistart import solve
from impact_posture.robot.joint_coupling import present, with_partners
from impact_posture.robot.joint_model import describe_joints, transmissions, with_joint_model
from impact_posture.robot.model_joints import q_slice
from impact_posture.robot.model_variant import Payload, between, build_model_variants
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import JointTransmissionSpec, TransmissionSpec
from impact_posture.system.libraries import build_library
from tests.support.arms import TIP, X, Y, Z, arm
from tests.support.command import run, succeed
from tests.support.helpers import assert_close, random_configurations, relative, rng, robot, unit
from tests.support.pinocchio_values import central_gradient
from tests.support.settings import make_settings
from tests.support.tools import need_compiler

FRAMES = {"tilthex_arm": "ee", "panda": "panda_hand_tcp", "talos": "gripper_right_base_link", "solo12": "base_link"}
KINDS: tuple[ObjectiveKind, ...] = ("impulse", "speed", "sticking", "energy")


def stated(loaded: Robot, **table: object) -> Robot:
    return replace(loaded, spec=replace(loaded.spec, transmission=TransmissionSpec(**table)))  # type: ignore[arg-type]


def objective(
    loaded: Robot, frame: str, kind: ObjectiveKind = "impulse", metric: str = "euclidean"
) -> WorstCaseObjective:
    feet = loaded.spec.supports
    return WorstCaseObjective(loaded, ImpactContact(frame, (0.2, 0.1, 1.0)), Metric(metric), kind, feet)  # type: ignore[arg-type]


def with_some_locked(loaded: Robot, count: int = 2) -> Robot:
    """Return the link model of a robot with locked last joints and a rigid first joint."""
    names = loaded.joint_names
    joints = {name: JointTransmissionSpec("locked") for name in names[-count:]}
    joints[names[0]] = JointTransmissionSpec("rigid")
    return with_joint_model(stated(loaded, joints=joints), "link")


# ---- armature of joint models -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FRAMES)
def test_the_armature_of_each_joint_model(name: str) -> None:
    loaded = stated(robot(name))
    joints = slice(loaded.first_joint, None)
    reflected, link = with_joint_model(loaded, "reflected"), with_joint_model(loaded, "link")
    np.testing.assert_array_equal(reflected.model.armature, loaded.armature)
    assert not np.any(link.model.armature)
    for changed in (reflected, link):
        np.testing.assert_array_equal(changed.armature, loaded.armature)
        assert changed.model_sha256 == loaded.model_sha256, "the robot is the same"
        back = with_joint_model(changed, "reflected")
        np.testing.assert_array_equal(back.model.armature, loaded.armature)
    some = with_some_locked(loaded)
    armature = np.array(some.model.armature[joints])
    assert armature[0] == loaded.armature[joints][0] and np.isinf(armature[-2:]).all() and not armature[1:-2].any()
    assert some.impact_sha256 != loaded.impact_sha256
    assert "2 of" in describe_joints(some) and "1 rigid" in describe_joints(some)


@pytest.mark.parametrize("name", FRAMES)
@pytest.mark.parametrize("kind", KINDS)
def test_links_alone_are_the_robot_without_armature(name: str, kind: ObjectiveKind) -> None:
    loaded = stated(robot(name))
    bare = pin.Model(loaded.model)
    bare.armature = np.zeros(loaded.nv)
    mine = objective(with_joint_model(loaded, "link"), FRAMES[name], kind)
    other = objective(replace(loaded, model=bare), FRAMES[name], kind)
    for q in random_configurations(loaded.model, 3, name, "link"):
        assert mine.value(q) == pytest.approx(other.value(q), rel=1e-13)
        assert_close(mine.gradient(q), other.gradient(q), 1e-12, name)


@pytest.mark.parametrize("name", ["tilthex_arm", "panda", "talos"])
@pytest.mark.parametrize("metric", ["euclidean", "kinetic"])
@pytest.mark.parametrize("kind", KINDS)
def test_locked_joints_equal_a_model_without_them(name: str, kind: ObjectiveKind, metric: str) -> None:
    """Pinocchio builds the reduced model separately for each posture."""
    loaded = robot(name)
    supports = () if name == "talos" else loaded.spec.supports
    # Locking one finger of panda locks both.
    locked = with_partners(loaded.couplings, loaded.joint_names[1::3])
    joints = {joint: JointTransmissionSpec("locked") for joint in locked}
    some = with_joint_model(stated(loaded, joints=joints, kind="rigid"), "link")
    mine = replace(objective(some, FRAMES[name], kind, metric), supports=supports)
    ids = [loaded.joint_id(joint) for joint in joints]
    kept = np.isfinite(some.model.armature)
    for q in random_configurations(loaded.model, 2, name, "locked"):
        model = pin.buildReducedModel(loaded.model, ids, q)
        model.armature = loaded.armature[kept]
        names = tuple(n for n in loaded.joint_names if n not in joints)
        spec = replace(loaded.spec, transmission=TransmissionSpec())
        alone = replace(loaded, model=model, spec=spec, couplings=present(loaded.couplings, model))
        assert alone.joint_names == names
        other = replace(mine, robot=alone)
        short = np.concatenate([q[q_slice(loaded.model, i)] for i in range(1, loaded.model.njoints) if i not in ids])
        assert mine.value(q) == pytest.approx(other.value(short), rel=1e-9)
        assert not mine.oracle.quantities(q).jump[~kept].any()
        # The gradients are compared only along joints of both models.
        assert relative(mine.gradient(q)[kept], other.gradient(short)) < 1e-8


@pytest.mark.long(
    but=(
        "impulse-euclidean-talos",
        "sticking-kinetic-solo12",
        "speed-kinetic-tilthex_arm",
        "energy-euclidean-solo12",
        "sticking-euclidean-panda",
        "speed-euclidean-solo12",
        "impulse-kinetic-panda",
        "energy-kinetic-tilthex_arm",
        "sticking-euclidean-tilthex_arm",
        "energy-kinetic-panda",
    )
)
@pytest.mark.parametrize("name", FRAMES)
@pytest.mark.parametrize("metric", ["euclidean", "kinetic"])
@pytest.mark.parametrize("kind", KINDS)
def test_kernel_oracle_and_differences_agree(name: str, kind: ObjectiveKind, metric: str) -> None:
    loaded = with_some_locked(robot(name))
    mine = objective(loaded, FRAMES[name], kind, metric)
    tight = 1e-7 if mine.supports else 1e-9
    function = mine.gradient_fun()
    for q in random_configurations(loaded.model, 2, name, "kernel"):
        value, gradient = function(q, np.array(mine.contact.normal))
        assert float(value) == pytest.approx(mine.value(q), rel=tight)
        assert relative(np.array(gradient).ravel(), mine.gradient(q)) < tight
        measured = central_gradient(mine.value, loaded.model, q, 1e-4)
        assert relative(measured, mine.gradient(q)) < (1e-5 if mine.supports else 1e-7)


@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_random_arms_with_random_transmissions(data: st.DataObject) -> None:
    count = data.draw(st.integers(2, 5))
    axes = [data.draw(st.sampled_from([X, Y, Z])) for _ in range(count)]
    angles = [data.draw(st.floats(-1.5, 1.5)) for _ in range(count)]
    floating = data.draw(st.booleans())
    kinds = [data.draw(st.sampled_from(["rigid", "elastic", "locked"])) for _ in range(count)]
    plain = arm(axes, angles, floating=floating)
    table = {joint: JointTransmissionSpec(kind) for joint, kind in zip(plain.joint_names, kinds, strict=True)}
    if not floating and set(kinds) == {"locked"}:
        with pytest.raises(InputError, match="nothing moves"):
            with_joint_model(stated(plain, joints=table), "link")
        return
    changed = with_joint_model(stated(plain, joints=table), "link")
    q = changed.posture()
    mine = WorstCaseObjective(changed, ImpactContact(TIP, unit(rng("arms", count))))
    value, gradient = mine.gradient_fun()(q, np.array(mine.contact.normal))
    quantities = mine.oracle.quantities(q)
    assert float(value) == pytest.approx(quantities.H, rel=1e-9, abs=1e-12)
    scale = max(np.abs(mine.gradient(q)).max(), 1e-6 * quantities.H, 1e-12)
    assert np.abs(np.array(gradient).ravel() - mine.gradient(q)).max() < 1e-8 * scale + 1e-13
    # Additional inertia at a joint never increases the mobility of the contact.
    if floating:
        rigid = WorstCaseObjective(with_joint_model(plain, "locked"), mine.contact).oracle.quantities(q)
        free = WorstCaseObjective(with_joint_model(stated(plain), "link"), mine.contact).oracle.quantities(q)
        assert rigid.G <= quantities.G * (1 + 1e-9) <= free.G * (1 + 2e-9)


# ---- exports, searches and variants -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["tilthex_arm", "panda"])
def test_the_export_has_the_numbers_of_its_joint_model(name: str, tmp_path: Path) -> None:
    need_compiler()
    loaded = with_some_locked(robot(name))
    mine = objective(loaded, FRAMES[name])
    manifest = export(mine, tmp_path, prefix="joints", check=False).manifest
    build_library(tmp_path, "joints")
    assert manifest["joint_model"] == "link"
    np.testing.assert_array_equal(manifest["armature"], loaded.armature)
    # A controller loads the export together with the robot in its reflected joint model.
    compiled = ImpactGradient.load(tmp_path, robot=robot(name))
    for q in random_configurations(loaded.model, 3, name, "export"):
        value, gradient = compiled.value_and_gradient(q, np.array(mine.contact.normal))
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
    assert _key(prepared.problem) != _key(reflected.problem), "other functions need another cache key"
    solution = solve(prepared.problem, starts=3, compile="never")
    assert solution.certificate.holds() and solution.certified_starts == 3
    other = solve(reflected.problem, starts=3, compile="never")
    value = prepared.problem.objective.value
    assert value(solution.q) <= value(other.q) * (1 + 1e-9), "the optimum of this joint model"


def test_variants_keep_the_joint_model() -> None:
    loaded = with_some_locked(robot("panda"))
    variants = build_model_variants(loaded, (0.5, 2.0), [Payload("panda_hand", 1.0)])
    for variant in (*[v.robot for v in variants], *between(variants, 3, 0)):
        assert variant.joint_model == "link"
        np.testing.assert_array_equal(np.isinf(variant.model.armature), np.isinf(loaded.model.armature))
        assert variant.model.armature[0] == pytest.approx(variant.armature[0])
    with pytest.raises(InputError, match="joint model 'link'"):
        build_model_variants(with_joint_model(robot("panda"), "link"), (0.5, 2.0), [])


def test_feet_under_locked_joints() -> None:
    """If one leg is locked, the support impulses at the feet are still finite."""
    loaded = robot("solo12")
    legs = {joint: JointTransmissionSpec("locked") for joint in loaded.joint_names[:3]}
    mine = objective(with_joint_model(stated(loaded, joints=legs), "link"), "base_link")
    stability = contact_stability(mine.oracle, mine.supports, loaded.posture())
    assert all(np.isfinite(foot.impulse).all() for foot in stability.feet)


# ---- rejected input and command ---------------------------------------------------------------------------------


def test_transmissions_by_joint() -> None:
    loaded = robot("panda")
    first, second = loaded.joint_names[:2]
    table = transmissions(
        stated(
            loaded, kind="elastic", stiffness=14000.0, damping=3.0,
            joints={first: JointTransmissionSpec("rigid"), second: JointTransmissionSpec(None, 9000.0, 0.0)},
        )
    )  # fmt: skip
    # The motor of the fingers drives the leader.
    assert list(table.elastic) == [False] + [True] * (loaded.nv - 2) + [False]
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
    loaded = stated(robot("ur5"), **table)
    for joint_model in ("reflected", "link", "elastic"):
        assert np.isinf(with_joint_model(loaded, joint_model).model.armature).sum() == 1  # type: ignore[arg-type]
    with pytest.raises(InputError, match="one posture"):
        export(objective(with_joint_model(loaded, "elastic"), "tool0"), Path())


def test_links_without_inertia_are_named() -> None:
    plain = arm([Z, Y], [0.3, 0.4], floating=False)
    model = pin.Model(plain.model)
    model.inertias[2] = pin.Inertia(0.2, np.zeros(3), np.zeros((3, 3)))
    with pytest.raises(InertiaError, match=r"joint model 'link'.*joint_1 moves no inertia"):
        with_joint_model(replace(plain, model=model), "link")


def test_the_commands(tmp_path: Path) -> None:
    done = run("evaluate", "panda", "--normal", 0, 0, 1, "--joint-model", "link", "--json")
    document = json.loads(done.stdout)
    assert document["robot"]["joint_model"] == "link" and set(document["robot"]["armature"]) == {0.1}
    plain = json.loads(run("evaluate", "panda", "--normal", 0, 0, 1, "--armature", "none", "--json").stdout)
    assert document["evaluation"]["H"] == pytest.approx(plain["evaluation"]["H"], rel=1e-12)
    for arguments, words in (
        (("panda", "--joint-model", "locked"), "nothing moves"),
        (("solo12", "--frame", "base_link", "--joint-model", "locked"), "its feet stay, so nothing moves"),
        (("panda", "--joint-model", "soft"), "joint-model"),
    ):
        failed = run("evaluate", *arguments, "--normal", 0, 0, 1)
        assert failed.returncode in (1, 2) and words in failed.stderr and "Traceback" not in failed.stderr
    out = tmp_path / "out"
    options = ("--joint-model", "link", "--starts", 2, "--no-codegen", "--out", out)
    done = succeed("optimize", "tilthex_arm", "--normal", 0, 0, 1, *options)
    assert "links without rotors" in done.stdout
    assert read_settings(out / "problem.toml").joint_model == "link"
