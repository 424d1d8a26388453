"""Physical laws of the impact quantities: momentum and energy balances, identities, invariances and limits."""

from __future__ import annotations

import functools
import itertools

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.config.problem_settings import LoadOptions
from impact_posture.errors import ContactError, MetricError
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.metric import Metric
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.impact.quantities.impact_quantities import ImpactQuantities
from impact_posture.impact.support_compliance import default_compliance, support_inertia
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import load_robot
from impact_posture.robot.robot_spec import Support
from tests.support.helpers import (
    NAMES,
    Vector,
    assert_close,
    contact_frame,
    random_configurations,
    relative,
    rng,
    robot,
    uncoupled,
    unit,
)
from tests.support.pinocchio_values import central_gradient, frame_jacobian, mass_matrix

FLOATING = [name for name in NAMES if robot(name).floating]
STANDING = [name for name in NAMES if robot(name).spec.supports]
OFFSET = (0.01, -0.02, 0.03)


def quantities(
    loaded: Robot,
    q: Vector,
    normal: Vector,
    metric: Metric = Metric(),
    supports: tuple[Support, ...] = (),
    compliance: float | None = None,
    frame: str | None = None,
) -> ImpactQuantities:
    contact = ImpactContact(frame or contact_frame(loaded), tuple(normal), OFFSET)
    return ImpactOracle(ImpactCase(loaded, contact, metric, supports, compliance or 0.0)).quantities(q)


def feet(loaded: Robot) -> tuple[Support, ...]:
    return loaded.spec.supports


def jacobians(loaded: Robot, q: Vector, supports: tuple[Support, ...]) -> tuple[Vector, Vector, Vector]:
    """Return ``M``, the 3-row contact Jacobian ``J`` and the stacked support Jacobian ``J_s`` from Pinocchio."""
    J = frame_jacobian(loaded.model, q, loaded.frame_id(contact_frame(loaded)), OFFSET)[:3]
    parts = [
        frame_jacobian(loaded.model, q, loaded.frame_id(s.frame), s.offset)[: s.rows] for s in supports
    ]  # fmt: skip
    return mass_matrix(loaded.model, q), J, np.vstack([np.zeros((0, loaded.nv)), *parts])


# ---- balances ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_an_impact_stops_the_contact_and_dissipates_e(name: str) -> None:
    """The impulse ``λ = v_n/G`` stops the approach and dissipates ``E v_n²``; a sticking impact stops the point."""
    loaded = uncoupled(name)
    generator = rng(name, "energy")
    for q in random_configurations(loaded.model, 2, name, "energy"):
        n, speed = unit(generator), 1.7
        M, J, _ = jacobians(loaded, q, ())
        o = quantities(loaded, q, n)
        before = generator.normal(size=loaded.nv)
        before *= -speed / (n @ J @ before)
        after = before + o.jump * speed / o.G
        assert abs(n @ J @ after) < 1e-9 * speed
        lost = before @ M @ before / 2 - after @ M @ after / 2
        assert lost == pytest.approx(o.E * speed**2, rel=1e-9)
        assert np.sum((after - before) ** 2) == pytest.approx(o.V * speed**2, rel=1e-9)
        assert o.sticking_jump is not None
        assert_close(J @ o.sticking_jump, n, 1e-9, "sticking")
        assert o.S == pytest.approx(float(np.sum(o.sticking_jump**2)), rel=1e-12)
        assert o.sticking_impulse is not None
        assert_close(M @ o.sticking_jump, J.T @ o.sticking_impulse, 1e-9, "sticking momentum")


# ---- identities of the kinetic metric, order and shape ------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_kinetic_identities(name: str) -> None:
    """Without feet ``H = G``, ``V = 1/G = 2E``, ``Λ_c = JM⁻¹Jᵀ``, ``S = nᵀ(JM⁻¹Jᵀ)⁻¹n ≥ 1/G`` (Cauchy–Schwarz)."""
    loaded = robot(name)
    generator = rng(name, "kinetic")
    for q in random_configurations(loaded.model, 3, name, "kinetic"):
        o = quantities(loaded, q, unit(generator), Metric("kinetic"))
        assert pytest.approx(o.G, rel=1e-10) == o.H
        assert pytest.approx(1 / o.G, rel=1e-10) == o.V
        assert pytest.approx(2 * o.E, rel=1e-10) == o.V
        assert_close(o.ellipsoid, o.mobility, 1e-10, "ellipsoid")
        assert o.S is not None
        assert pytest.approx(float(o.normal @ np.linalg.solve(o.mobility, o.normal)), rel=1e-7) == o.S
        assert o.S >= (1 - 1e-10) / o.G
        # For a normal along an eigenvector of Λ_c, frictionless and sticking impacts are equal.
        values, vectors = np.linalg.eigh(o.mobility)
        own = quantities(loaded, q, vectors[:, 1], Metric("kinetic"))
        assert own.S == pytest.approx(own.V, rel=1e-6)
        assert pytest.approx(values[1], rel=1e-9) == own.G


@pytest.mark.parametrize("name", STANDING)
def test_feet_never_add_mobility(name: str) -> None:
    """``G`` decreases with each additional foot and with the stiffness of the feet."""
    loaded = robot(name)
    generator = rng(name, "mobility")
    (q,) = random_configurations(loaded.model, 1, name, "mobility")
    n = unit(generator)
    ladder = [quantities(loaded, q, n, supports=feet(loaded)[:k]).G for k in range(len(feet(loaded)) + 1)]
    assert all(later <= earlier * (1 + 1e-9) for earlier, later in itertools.pairwise(ladder))
    stiffness = [quantities(loaded, q, n, supports=feet(loaded), compliance=c).G for c in (1.0, 1e-2, 1e-4)]
    assert stiffness[0] >= stiffness[1] * (1 - 1e-9) >= stiffness[2] * (1 - 1e-9) ** 2


@pytest.mark.parametrize("metric", ["euclidean", "kinetic", "weighted"])
@pytest.mark.parametrize("name", ["solo8", "panda", "tilthex_arm", "talos"])
def test_root_h_is_the_ellipsoids_half_width(name: str, metric: str) -> None:
    """The image of the unit ball under ``JM⁻¹W^½`` is an ellipsoid, whose largest extent along n is ``√H``."""
    loaded, generator = uncoupled(name), rng(name, metric, "width")
    weights = generator.uniform(0.5, 2.0, loaded.nv)
    chosen = Metric("weighted", tuple(weights)) if metric == "weighted" else Metric(metric)  # type: ignore[arg-type]
    (q,) = random_configurations(loaded.model, 1, name, metric, "width")
    n = unit(generator)
    o = quantities(loaded, q, n, chosen)
    M, J, _ = jacobians(loaded, q, ())
    root = {"euclidean": np.eye(loaded.nv), "weighted": np.diag(np.sqrt(weights)), "kinetic": np.linalg.cholesky(M)}
    image = J @ np.linalg.solve(M, root[metric])
    assert_close(image @ image.T, o.ellipsoid, 1e-9, "ellipsoid")
    ball = generator.normal(size=(loaded.nv, 2000))
    ball /= np.linalg.norm(ball, axis=0)
    reach = n @ image @ ball
    assert reach.max() <= np.sqrt(o.H)
    farthest = image.T @ n / np.linalg.norm(image.T @ n)
    assert n @ image @ farthest == pytest.approx(np.sqrt(o.H), rel=1e-10)
    # The distance from the center to the surface of the ellipsoid along n is smaller than ``√H``.
    radius = 1 / np.sqrt(n @ np.linalg.solve(o.ellipsoid, n))
    assert radius < np.sqrt(o.H)


# ---- invariances ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FLOATING)
def test_moving_the_base(name: str) -> None:
    """The quantities do not change if the robot is translated, or if robot and normal are rotated together."""
    loaded = robot(name)
    generator = rng(name, "moved")
    for supports in {(), feet(loaded)}:
        (q,) = random_configurations(loaded.model, 1, name, "moved")
        n = unit(generator)
        here = quantities(loaded, q, n, supports=supports)
        shifted = q.copy()
        shifted[:3] += [3.0, -2.0, 1.0]
        turn = pin.Quaternion(unit(generator, 4))
        turned = q.copy()
        base = turn * pin.Quaternion(q[3:7])
        turned[:3], turned[3:7] = turn.matrix() @ q[:3], base.coeffs()
        tolerance = 1e-9
        for there in (
            quantities(loaded, shifted, n, supports=supports),
            quantities(loaded, turned, turn.matrix() @ n, supports=supports),
        ):
            for letter in "HGVSE":
                value, expected = getattr(there, letter), getattr(here, letter)
                assert_close(value, expected, tolerance, f"{letter}, {len(supports)} supports")
        R = turn.matrix()
        there = quantities(loaded, turned, n, supports=supports)
        assert_close(there.ellipsoid, R @ here.ellipsoid @ R.T, tolerance, "ellipsoid turns with the robot")


@pytest.mark.parametrize("name", ["talos", "panda", "solo8"])
def test_the_sign_of_the_normal_does_not_matter(name: str) -> None:
    loaded = robot(name)
    (q,) = random_configurations(loaded.model, 1, name, "sign")
    n = unit(rng(name, "sign"))
    one, other = quantities(loaded, q, n), quantities(loaded, q, -n)
    for letter in "HGVSE":
        assert_close(getattr(one, letter), getattr(other, letter), 1e-12, letter)


def test_the_kinetic_metric_does_not_depend_on_the_base_point() -> None:
    """The euclidean metric depends on the choice of the base origin."""
    loaded = robot("borinot")
    moved = loaded.model.copy()
    shift = pin.SE3(np.eye(3), np.array([0.2, -0.1, 0.3]))
    # If the base origin is shifted, everything on the body moves in the opposite direction.
    moved.inertias[1] = shift.actInv(moved.inertias[1])
    for k in range(2, moved.njoints):
        if moved.parents[k] == 1:
            moved.jointPlacements[k] = shift.inverse() * moved.jointPlacements[k]
    for k in range(moved.nframes):
        if moved.frames[k].parentJoint == 1:
            moved.frames[k].placement = shift.inverse() * moved.frames[k].placement
    other = Robot(loaded.name, loaded.source, moved, loaded.root, {}, "", loaded.spec)
    (q,) = random_configurations(loaded.model, 1, "base point")
    q_moved = q.copy()
    q_moved[:3] += pin.Quaternion(q[3:7]).matrix() @ shift.translation
    n = unit(rng("base point"))
    for metric, same in ((Metric("kinetic"), True), (Metric(), False)):
        one, there = quantities(loaded, q, n, metric), quantities(other, q_moved, n, metric)
        assert_close(there.G, one.G, 1e-9, "G")
        assert (relative(there.V, one.V) < 1e-9) == same


# ---- feet: the limit of zero compliance ---------------------------------------------------------------------------


def test_feet_are_heavier_links() -> None:
    """Fixed feet have the inertia of point masses 1/ε welded to the feet of solo8, computed by Pinocchio's CRBA."""
    loaded = robot("solo8")
    epsilon = default_compliance(loaded)
    heavy = loaded.model.copy()
    for support in feet(loaded):
        frame = heavy.frames[loaded.frame_id(support.frame)]
        point = pin.Inertia(1 / epsilon, np.zeros(3), np.zeros((3, 3)))
        heavy.appendBodyToJoint(
            frame.parentJoint, point, frame.placement * pin.SE3(np.eye(3), np.array(support.offset))
        )
    extra = support_inertia(loaded, feet(loaded), epsilon)
    assert len(extra) == 4
    for joint, inertia in extra.items():
        added = heavy.inertias[joint].matrix() - loaded.model.inertias[joint].matrix()
        assert_close(inertia, added, 1e-9, "inertia")
    (q,) = random_configurations(loaded.model, 1, "heavy")
    M, _, J_s = jacobians(loaded, q, feet(loaded))
    assert_close(mass_matrix(heavy, q), M + J_s.T @ J_s / epsilon, 1e-9, "M")


@pytest.mark.parametrize("normal", [(1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)])
def test_solo8_on_its_feet_is_not_solo8_in_the_air(normal: tuple[float, float, float]) -> None:
    """When solo8 crouches, ``H`` computed with feet and ``H`` computed without feet change in opposite directions."""
    loaded = robot("solo8")
    contact, q = ImpactContact("base_link", normal), loaded.posture()
    free, standing = WorstCaseObjective(loaded, contact), WorstCaseObjective(loaded, contact, supports=feet(loaded))
    assert relative(standing.value(q), free.value(q)) > 0.1
    # The motion ``crouch`` lowers the base without any other base motion, and the feet do not move.
    _, _, J_s = jacobians(loaded, q, feet(loaded))
    allowed = np.linalg.svd(J_s)[2][np.linalg.matrix_rank(J_s, tol=1e-9) :].T
    crouch = allowed @ np.linalg.lstsq(allowed[:6], np.array([0, 0, -1.0, 0, 0, 0]), rcond=None)[0]
    np.testing.assert_allclose(crouch[:6], [0, 0, -1, 0, 0, 0], atol=1e-9)
    assert (free.gradient(q) @ crouch) * (standing.gradient(q) @ crouch) < 0
    if normal == (1.0, 0.0, 0.0):
        assert free.gradient(q) @ crouch < 0 < standing.gradient(q) @ crouch
    # Fixed feet cannot increase the mobility of the contact.
    assert standing.oracle.quantities(q).G < free.oracle.quantities(q).G


def test_point_feet_lose_rank_and_stay_smooth() -> None:
    """Four point feet of solo8 constrain 9 to 11 directions.  With compliance, the gradient exists and is correct."""
    loaded = robot("solo8")
    q = loaded.posture("standing")
    _, _, J_s = jacobians(loaded, q, feet(loaded))
    assert J_s.shape[0] == 12
    assert np.linalg.matrix_rank(J_s, tol=1e-9) < 12
    objective = WorstCaseObjective(loaded, ImpactContact("base_link", (0.0, 1.0, 0.0)), supports=feet(loaded))
    differences = central_gradient(objective.value, loaded.model, q, 2e-4)
    assert_close(objective.gradient(q), differences, 1e-6, "gradient", scale=objective.value(q))


# ---- undefined S --------------------------------------------------------------------------------------------------


@functools.cache
def pendulum() -> Robot:
    """Return a robot with two parallel joint axes, whose tip moves in a vertical plane."""
    return load_robot(
        "example-robot-data:double_pendulum_description/urdf/double_pendulum.urdf", LoadOptions(root="fixed")
    )


def _plane(loaded: Robot, q: Vector) -> tuple[Vector, Vector]:
    """Return the contact Jacobian, and the normal of the plane in which the contact moves."""
    J = frame_jacobian(loaded.model, q, loaded.frame_id("link2"), OFFSET)[:3]
    return J, np.linalg.svd(J)[0][:, 2]


def test_s_is_undefined_out_of_the_plane() -> None:
    loaded = pendulum()
    (q,) = random_configurations(loaded.model, 1, "plane")
    _, out = _plane(loaded, q)
    for tilt in (1.0, 0.1, 1e-3):
        n = out * tilt + np.sqrt(1 - tilt**2) * np.cross(out, unit(rng("in plane")))
        o = quantities(loaded, q, n, frame="link2")
        assert o.S is None
        assert o.sticking_jump is None
        assert o.sticking_impulse is None
    objective = WorstCaseObjective(loaded, ImpactContact("link2", tuple(out), OFFSET), kind="sticking")
    with pytest.raises(MetricError, match="S does not exist"):
        objective.value(q)
    with pytest.raises(MetricError, match="S does not exist"):
        objective.gradient(q)


def test_s_in_the_plane_by_the_pseudo_inverse() -> None:
    loaded = pendulum()
    for q in random_configurations(loaded.model, 3, "in the plane"):
        J, out = _plane(loaded, q)
        n = np.cross(out, unit(rng("tangent")))
        n /= np.linalg.norm(n)
        o = quantities(loaded, q, n, frame="link2")
        M = mass_matrix(loaded.model, q)
        # Two joints move the tip in two directions, so the Jacobian J alone determines the sticking jump.
        jump = np.linalg.pinv(J) @ n
        assert o.S is not None
        assert o.S == pytest.approx(float(jump @ jump), rel=1e-8)
        assert_close(o.sticking_jump if o.sticking_jump is not None else np.nan, jump, 1e-8, "jump")
        kinetic = quantities(loaded, q, n, Metric("kinetic"), frame="link2")
        assert kinetic.S == pytest.approx(float(jump @ M @ jump), rel=1e-8)
        objective = WorstCaseObjective(loaded, ImpactContact("link2", tuple(n), OFFSET), kind="sticking")
        differences = central_gradient(objective.value, loaded.model, q, 2e-4)
        assert_close(objective.gradient(q), differences, 1e-6, "gradient", scale=objective.value(q))
        value, gradient = (np.array(o) for o in objective.gradient_fun()(q, n))
        assert_close(value, objective.value(q), 1e-9, "symbolic value")
        assert_close(gradient, objective.gradient(q), 1e-8, "symbolic gradient", scale=objective.value(q))


def test_a_frame_that_cannot_move_is_refused() -> None:
    objective = WorstCaseObjective(robot("panda"), ImpactContact("panda_link0", (1.0, 0.0, 0.0)))
    with pytest.raises(ContactError, match="welded to the world"):
        objective.value(robot("panda").posture())
