"""``evaluate``: numbers compared with dense algebra on Pinocchio matrices, and predictions with impact physics."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from impact_posture.config.problem_settings import ImpactSettings
from impact_posture.config.text_parsers import parse_armature, parse_contact
from impact_posture.errors import ContactError, FrameNotFound, InputError, MetricError
from impact_posture.impact.evaluation.ellipsoids import classical_ellipsoids, ellipsoid_of, force_ellipsoid
from impact_posture.impact.evaluation.evaluation import Evaluation, evaluate
from impact_posture.impact.evaluation.impact_effect import tangent_units
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.resolved_impact import resolve
from impact_posture.impact.support_compliance import default_compliance
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import Support
from tests.support.helpers import assert_close, rng, robot, unit
from tests.support.pinocchio_values import frame_jacobian, frame_placement, mass_matrix
from tests.support.urdfs import joint, link, write

DESIGN_KEYS = {
    "q", "objective", "H", "G", "V", "S", "E", "effective_mass", "gradient", "objective_gradient", "worst_normal",
    "ellipsoid", "pose",
}  # fmt: skip


@pytest.fixture
def planar(tmp_path: Path) -> str:
    """Return a two-link arm that moves in the xy plane."""
    parts = [
        link("base"), link("l1", 2, "0.25 0 0"), link("l2", 1, "0.25 0 0"), link("tip"),
        joint("j1", "base l1", "0 0 1"), joint("j2", "l1 l2", "0 0 1", "0.5 0 0"),
        joint("jt", "l2 tip", None, "0.5 0 0", "fixed", ""),
    ]  # fmt: skip
    return str(write(tmp_path, *parts))


def dense(
    loaded: Robot, contact: ImpactContact, q: np.ndarray, n: np.ndarray, W: np.ndarray | None,
    feet: tuple[Support, ...],
):  # fmt: skip
    """Return H, G, V, S, Λ_c, a and the sticking jump, computed by inverting ``M + J_sᵀJ_s/ε``."""
    M = mass_matrix(loaded.model, q)
    J = frame_jacobian(loaded.model, q, loaded.frame_id(contact.frame), contact.offset)[:3]
    inertia = M.copy()
    for foot in feet:
        Js = frame_jacobian(loaded.model, q, loaded.frame_id(foot.frame), foot.offset)[: foot.rows]
        inertia += Js.T @ Js / default_compliance(loaded)
    # The fingers of panda are coupled, so ν = C ν.  The metric does not count the follower.
    C, followers = loaded.coupling_matrix, loaded.followers
    weight = np.diag(1.0 - followers) if W is None else W
    A = C @ np.linalg.inv(C.T @ inertia @ C + np.diag(1.0 * followers)) @ C.T @ J.T
    mobility = J @ A
    a, G = A @ n, n @ mobility @ n
    stuck = A @ np.linalg.solve(mobility, n)
    H = a @ weight @ a
    return {
        "H": H, "G": G, "V": H / G**2, "S": stuck @ weight @ stuck, "E": 1 / (2 * G), "ellipsoid": A.T @ weight @ A,
        "a": a, "stuck": stuck, "J": J, "M": M,
    }  # fmt: skip


CASES = [
    ("tilthex_arm", "ee", "euclidean"),
    ("tilthex_arm", "ee", "kinetic"),
    ("panda", "panda_hand_tcp", "euclidean"),
    ("solo8", "base_link", "euclidean"),
    ("talos", "gripper_right_base_link", "kinetic"),
]


@pytest.mark.parametrize(("name", "frame", "metric"), CASES)
def test_numbers_against_dense_algebra(name: str, frame: str, metric: str) -> None:
    loaded = robot(name)
    n = unit(rng("normal", name))
    impact = resolve(ImpactSettings(robot=name, frame=frame, normal=tuple(n), metric=metric, impulse=3.0))  # type: ignore[arg-type]
    evaluation = evaluate(impact.objective, impact.q, 0.7, 0.3)
    W = mass_matrix(loaded.model, impact.q) if metric == "kinetic" else None
    expected = dense(loaded, impact.contact, impact.q, n, W, impact.supports)
    # Adding 1/ε to the link masses before inversion reduces the accuracy.
    tolerance = 1e-6 if impact.supports else 1e-10
    for key in ("H", "G", "V", "S", "E"):
        assert_close(evaluation.to_dict()[key], expected[key], tolerance, key)  # type: ignore[arg-type]
    assert evaluation.objective == pytest.approx(9.0 * evaluation.scalars.H, rel=1e-14)
    assert evaluation.scalars.effective_mass == pytest.approx(1 / expected["G"], rel=tolerance)
    axes, radii = evaluation.ellipsoid.axes, evaluation.ellipsoid.radii
    assert_close(axes @ np.diag(radii**2) @ axes.T, expected["ellipsoid"], tolerance, "ellipsoid")
    assert_close(axes @ axes.T, np.eye(3), 1e-12, "axes")
    assert np.linalg.det(axes) > 0 and (np.diff(radii) <= 0).all()
    assert evaluation.frictionless is not None and evaluation.sticking is not None
    assert_close(
        evaluation.frictionless.velocity, expected["a"] * 1.3 * 0.7 / expected["G"], tolerance, "frictionless"
    )
    assert_close(evaluation.sticking.velocity, expected["stuck"] * 1.3 * 0.7, tolerance, "sticking")
    assert evaluation.frictionless.norm == pytest.approx(1.3 * 0.7 * np.sqrt(expected["V"]), rel=tolerance)
    assert evaluation.sticking.norm == pytest.approx(1.3 * 0.7 * np.sqrt(expected["S"]), rel=tolerance)
    pose = frame_placement(loaded.model, impact.q, loaded.frame_id(frame))
    assert_close(evaluation.pose.homogeneous, pose.homogeneous, 1e-12, "pose")


def test_free_values_stand_beside_the_supported_ones() -> None:
    loaded, n = robot("talos"), np.array([-1.0, 0.0, 0.0])
    impact = resolve(ImpactSettings(robot="talos", frame="torso_2_link", normal=(-2.0, 0.0, 0.0)))
    evaluation = evaluate(impact.objective, impact.q)
    assert [s.frame for s in impact.supports] == ["left_sole_link", "right_sole_link"]
    expected = dense(loaded, impact.contact, impact.q, n, None, ())
    assert evaluation.without_supports is not None
    for key in ("H", "G", "V", "S", "E"):
        assert_close(evaluation.without_supports.to_dict()[key], expected[key], 1e-10, key)  # type: ignore[arg-type]
    assert evaluation.to_dict()["free"] == evaluation.without_supports.to_dict()
    assert evaluation.contact_stability is not None
    assert evaluation.to_dict()["footing"] == evaluation.contact_stability.to_dict()
    # The Jacobian of two flat feet has full rank, so their compliance has little effect.
    assert evaluation.compliance_effect is not None and 0 < evaluation.compliance_effect < 1e-2
    without = resolve(ImpactSettings(robot="talos", frame="torso_2_link", normal=(-1.0, 0.0, 0.0), support=()))
    alone = evaluate(without.objective, without.q)
    assert alone.without_supports is None and "free" not in alone.to_dict()
    assert alone.contact_stability is None and "footing" not in alone.to_dict()
    assert alone.scalars.H == pytest.approx(evaluation.without_supports.H, rel=1e-14)


def test_the_predicted_jumps_obey_the_impact() -> None:
    impact = resolve(ImpactSettings(robot="tilthex_arm", normal=(0.3, -0.2, 1.0)))
    speed, e = 0.8, 0.4
    evaluation = evaluate(impact.objective, impact.q, speed, e)
    assert (
        evaluation.frictionless is not None and evaluation.sticking is not None and evaluation.energy_loss is not None
    )
    n = evaluation.worst_normal
    parts = dense(robot("tilthex_arm"), impact.contact, impact.q, n, None, ())
    J, M = parts["J"], parts["M"]
    before = rng("approach").normal(size=9)
    along = n @ J
    before -= along * (along @ before + speed) / (along @ along)
    assert n @ J @ before == pytest.approx(-speed)
    after = before + evaluation.frictionless.velocity
    assert n @ J @ after == pytest.approx(e * speed)
    assert_close(M @ evaluation.frictionless.velocity, J.T @ evaluation.frictionless.impulse, 1e-10, "momentum")
    assert_close(M @ evaluation.sticking.velocity, J.T @ evaluation.sticking.impulse, 1e-10, "momentum")
    assert_close(J @ evaluation.sticking.velocity, (1 + e) * speed * n, 1e-10, "no slip")
    assert evaluation.energy_loss == pytest.approx((before @ M @ before - after @ M @ after) / 2)
    assert evaluation.frictionless.impulse_size == pytest.approx((1 + e) * speed / parts["G"])
    names = [name for name, _, _ in evaluation.frictionless.largest]
    order = np.argsort(-np.abs(evaluation.frictionless.velocity))
    assert names[:3] == [impact.robot.tangent_names[k] for k in order[:3]]


def strict(result: Evaluation) -> dict[str, object]:
    block = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    assert set(block) >= DESIGN_KEYS
    return block


def test_the_block_has_the_keys_of_result_json() -> None:
    impact = resolve(ImpactSettings(robot="panda", normal=(0.0, 0.0, 1.0)))
    block = strict(evaluate(impact.objective, impact.q))
    assert set(block["ellipsoid"]) == {"axes", "radii"}  # type: ignore[call-overload]
    assert set(block["pose"]) == {"position", "quaternion_xyzw"}  # type: ignore[call-overload]
    assert len(block["gradient"]) == 9 and len(block["q"]) == 9  # type: ignore[arg-type]
    options = impact.to_dict()
    assert set(options) == {"robot", "contacts", "scenarios", "supports", "support_compliance", "metric"}
    robot_keys = "name source model_sha256 nq nv joint_names root convention armature locked"
    assert set(options["robot"]) >= set(robot_keys.split())  # type: ignore[call-overload]


def test_where_S_does_not_exist(planar: str) -> None:
    impact = resolve(ImpactSettings(robot=planar, frame="tip", normal=(1.0, 0.0, 0.5), objective="sticking"))
    q = np.array([0.3, 0.9])
    evaluation = evaluate(impact.objective, q)
    block = strict(evaluation)
    assert block["S"] is None and block["objective"] is None and block["objective_gradient"] is None
    assert evaluation.sticking is None and evaluation.scalars.V is not None
    assert any("S is undefined" in line for line in evaluation.warnings)


def test_where_the_contact_cannot_move_along_the_normal(planar: str) -> None:
    impact = resolve(ImpactSettings(robot=planar, frame="tip", normal=(0.0, 0.0, 1.0), objective="speed"))
    evaluation = evaluate(impact.objective, np.array([0.3, 0.9]))
    block = strict(evaluation)
    assert [block[key] for key in ("V", "S", "E", "effective_mass", "objective")] == [None] * 5
    assert evaluation.frictionless is None and evaluation.energy_loss is None
    assert evaluation.scalars.H == pytest.approx(0.0, abs=1e-20)
    assert any("unbounded" in line for line in evaluation.warnings)


def test_effective_mass_where_the_contact_cannot_move(planar: str) -> None:
    settings = ImpactSettings(robot=planar, frame="tip", normal=(0.0, 0.0, 1.0), objective="effective-mass")
    impact = resolve(settings)
    assert strict(evaluate(impact.objective, np.array([0.3, 0.9])))["objective"] is None
    with pytest.raises(MetricError, match="unbounded"):
        impact.objective.value(np.array([0.3, 0.9]))


def test_one_joint_dominates_or_none_does(planar: str) -> None:
    evaluation = evaluate(*_impact(planar, (0.0, 1.0, 0.0), [0.0, 0.0]))
    joint = evaluation.dominance
    a = np.linalg.solve(
        mass_matrix(_impact(planar, (0.0, 1.0, 0.0), [0.0, 0.0])[0].robot.model, np.zeros(2)), [1.0, 0.5]
    )
    assert joint.joint == "j2" and joint.dominates
    assert joint.share == pytest.approx(a[1] ** 2 / (a @ a), rel=1e-10)
    assert joint.line.startswith(f"joint 'j2' contributes {100 * joint.share:.0f} % of H")
    even = resolve(ImpactSettings(robot="talos", frame="torso_2_link", normal=(-1.0, 0.0, 0.0)))
    verdict = evaluate(even.objective, even.q).dominance
    assert not verdict.dominates and verdict.line.startswith("no single joint dominates H")


def _impact(urdf: str, normal: tuple[float, float, float], q: list[float]) -> tuple[WorstCaseObjective, np.ndarray]:
    return resolve(ImpactSettings(robot=urdf, frame="tip", normal=normal)).objective, np.array(q)


def test_units_of_the_tangent_entries() -> None:
    assert tangent_units(robot("tilthex_arm")) == ("m/s",) * 3 + ("rad/s",) * 6
    assert tangent_units(robot("panda")) == ("rad/s",) * 7 + ("m/s",) * 2


@pytest.mark.parametrize(
    ("speed", "restitution"), [(-1.0, 0.0), (np.nan, 0.0), (1.0, -0.1), (1.0, 1.1), (1.0, np.nan)]
)
def test_an_impossible_approach_is_refused(speed: float, restitution: float) -> None:
    impact = resolve(ImpactSettings(robot="ur5", normal=(0.0, 0.0, 1.0)))
    with pytest.raises(InputError, match=r"^speed: |^restitution: "):
        evaluate(impact.objective, impact.q, speed, restitution)


def test_classical_ellipsoids() -> None:
    impact = resolve(ImpactSettings(robot="panda", normal=(0.0, 0.0, 1.0)))
    J = frame_jacobian(impact.robot.model, impact.q, impact.robot.frame_id("panda_hand_tcp"), impact.contact.offset)[
        :3
    ]
    ellipsoids = classical_ellipsoids(impact.objective, impact.q)
    for name, matrix in (("velocity", J @ J.T), ("force", np.linalg.inv(J @ J.T))):
        axes, radii = ellipsoids[name].axes, ellipsoids[name].radii
        assert_close(axes @ np.diag(radii**2) @ axes.T, matrix, 1e-9, name)
        assert (np.diff(radii) <= 0).all()


def test_a_force_without_bound_is_null() -> None:
    J = np.array([[1.0, 0.0], [0.0, 2.0], [0.0, 0.0]])
    assert force_ellipsoid(J).to_dict()["radii"] == [None, 1.0, 0.5]
    assert np.allclose(np.abs(force_ellipsoid(J).axes[:, 0]), [0, 0, 1])
    assert ellipsoid_of(J @ J.T).to_dict()["radii"] == [2.0, 1.0, 0.0]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("ee:0,0,1", ("ee", (0.0, 0.0, 1.0), None)),
        ("ee:-1,0,1e-3:2.5", ("ee", (-1.0, 0.0, 1e-3), 2.5)),
        ("arm::ee:0,0,1", ("arm::ee", (0.0, 0.0, 1.0), None)),
    ],
)
def test_contacts_as_text(text: str, expected: object) -> None:
    assert parse_contact(text) == expected


@pytest.mark.parametrize("text", ["ee", "ee:0,0", ":0,0,1", "ee:a,b,c", "0,0,1"])
def test_invalid_contacts_are_refused(text: str) -> None:
    with pytest.raises(ContactError, match=r"^contact: "):
        parse_contact(text)


def test_armature_as_text() -> None:
    assert parse_armature([]) is None
    assert parse_armature(["none"]) == "none"
    assert parse_armature(["motors.toml"]) == "motors.toml"
    assert parse_armature(["a=0.1", "b=2e-3"]) == {"a": 0.1, "b": 2e-3}
    for texts in (["a=0.1", "motors.toml"], ["a=much"], ["none", "a=1"], ["0.05"]):
        with pytest.raises(InputError, match=r"^armature: "):
            parse_armature(texts)


def test_supports_as_text() -> None:
    def supports(*texts: str) -> tuple[Support, ...]:
        return resolve(ImpactSettings(robot="solo8", normal=(1.0, 0.0, 0.0), support=texts)).supports

    known = {s.frame: s for s in robot("solo8").spec.supports}
    assert supports("FL_FOOT") == (known["FL_FOOT"],)
    assert supports("FL_FOOT:surface")[0].kind == "surface"
    assert supports("FL_FOOT:surface")[0].offset == known["FL_FOOT"].offset
    assert supports("FL_LOWER_LEG:point")[0] == Support("FL_LOWER_LEG")
    with pytest.raises(FrameNotFound, match="FL_FOOT"):
        supports("FL_FOT")
    with pytest.raises(InputError, match="given twice"):
        supports("FL_FOOT", "FL_FOOT:surface")


def test_an_impact_at_a_held_point_is_refused() -> None:
    with pytest.raises(ContactError, match="held by the support at 'FL_FOOT'"):
        resolve(ImpactSettings(robot="solo8", frame="FL_FOOT", normal=(1.0, 0.0, 0.0)))


def test_a_robot_without_a_default_frame_names_some(planar: str) -> None:
    with pytest.raises(
        ContactError, match="frame: written has no default contact frame; give a frame, for example tip"
    ):
        resolve(ImpactSettings(robot=planar, normal=(1.0, 0.0, 0.0)))


def test_impulse_of_the_contact_text_and_the_default_offset() -> None:
    assert resolve(ImpactSettings(robot="panda", contact=("panda_hand_tcp:0,0,2:4",))).contact.impulse == 4.0
    assert (
        resolve(ImpactSettings(robot="panda", contact=("panda_hand_tcp:0,0,2",), impulse=5.0)).contact.impulse == 5.0
    )
    with pytest.raises(ContactError, match="cannot be combined"):
        resolve(ImpactSettings(robot="panda", contact=("panda_hand_tcp:0,0,2",), normal=(0.0, 0.0, 1.0)))
