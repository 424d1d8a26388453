"""Whether feet lift or slip, compared with statics by hand and with the impulse dynamics of Pinocchio."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import Tree
from impact_posture.impact.friction.contact_stability import FrictionCones, contact_stability
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.metric import Metric
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.constraints.kept_contacts import KeptContacts
from impact_posture.posture.formulation.problem_file import prepare
from impact_posture.posture.search.multistart import solve
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import Support
from tests.support.command import run
from tests.support.helpers import assert_close, robot
from tests.support.pinocchio_values import central_gradient, frame_jacobian, mass_matrix
from tests.support.settings import make_settings

FEET = {"solo8": 4, "solo12": 4, "talos": 2}


def standing(name: str) -> tuple[Robot, tuple[Support, ...]]:
    loaded = robot(name)
    return loaded, loaded.spec.supports


def oracle_of(name: str, normal: tuple[float, float, float], frame: str = "base_link") -> ImpactOracle:
    loaded, supports = standing(name)
    return ImpactOracle(ImpactCase(loaded, ImpactContact(frame, normal), Metric(), supports, 1e-6))


def test_a_sole_without_size_bears_no_moment() -> None:
    """A sole of 10 × 6 cm (half extents) bears 0.06 N·m s of a unit impulse about x, 0.1 about y, 0.056 about z."""
    moments = np.array([[0.05, 0, 0], [0, 0.09, 0], [0, 0, 0.05], [0, 0, 0]])
    impulses = np.hstack([np.tile([0.0, 0.0, 1.0], (4, 1)), moments])
    for size, borne in (((0.1, 0.06), [True] * 4), ((0.0, 0.0), [False] * 3 + [True])):
        A, _ = FrictionCones((Support("foot", "surface", size=size),), [np.eye(3)]).matrix(0.7)
        assert (A @ impulses.T <= 1e-12).all(axis=0).tolist() == borne


@pytest.mark.parametrize("name", ["solo8", "solo12"])
def test_an_impact_from_above_presses_all_feet(name: str) -> None:
    """The foot impulses point up.  Their sum is less than the impulse of the impact, because the knees yield."""
    loaded, supports = standing(name)
    q = loaded.posture()
    result = contact_stability(oracle_of(name, (0.0, 0.0, -1.0)), supports, q)
    assert result.friction is not None and 0 <= result.friction < 3
    assert len(result.feet) == FEET[name]
    assert not any(foot.lifts for foot in result.feet)
    total = sum(foot.impulse[2] for foot in result.feet)
    assert 0.0 < total < 1.0
    for foot in result.feet:
        assert np.linalg.norm(foot.impulse[:2]) <= (result.friction + 1e-3) * foot.impulse[2] + 1e-6


@pytest.mark.parametrize("name", ["solo8", "solo12"])
def test_an_impact_from_below_lifts(name: str) -> None:
    loaded, supports = standing(name)
    result = contact_stability(oracle_of(name, (0.0, 0.0, 1.0)), supports, loaded.posture())
    assert result.friction is None
    assert any(foot.lifts for foot in result.feet)
    assert "lifts" in result.line and result.to_dict()["stays"] is False


@pytest.mark.parametrize(("name", "normal"), [("solo12", (0.3, 0.2, -1.0)), ("talos", (1.0, 0.2, -0.4))])
def test_impulses_equal_impulse_dynamics(name: str, normal: tuple[float, float, float]) -> None:
    """If the foot impulses are unique, Pinocchio's rigid impulse dynamics gives the same impulses."""
    loaded, supports = standing(name)
    frame = "base_link"
    q = np.asarray(
        pin.integrate(loaded.model, loaded.posture(), 0.05 * np.random.default_rng(0).normal(size=loaded.nv))
    )
    oracle = ImpactOracle(ImpactCase(loaded, ImpactContact(frame, normal), Metric(), supports, 1e-9))
    result = contact_stability(oracle, supports, q)
    assert result.freedom == 0
    Js = np.vstack([frame_jacobian(loaded.model, q, loaded.frame_id(s.frame), s.offset)[: s.rows] for s in supports])
    n = np.array(normal) / np.linalg.norm(normal)
    J = frame_jacobian(loaded.model, q, loaded.frame_id(frame))[:3]
    free = np.linalg.solve(mass_matrix(loaded.model, q), J.T @ n)
    data = loaded.model.createData()
    after = np.array(pin.impulseDynamics(loaded.model, data, q, free, Js, 0.0, 1e-12))
    np.testing.assert_allclose(after, oracle.quantities(q).jump, atol=1e-5 * np.abs(after).max())
    expected = np.linalg.lstsq(Js.T, mass_matrix(loaded.model, q) @ (after - free), rcond=None)[0]
    own = np.concatenate(
        [np.concatenate([f.impulse, f.moment])[: s.rows] for f, s in zip(result.feet, supports, strict=True)]
    )
    np.testing.assert_allclose(own, expected, atol=1e-4 * np.abs(expected).max())


def test_the_set_matters_where_the_rank_drops() -> None:
    """The support impulses that pull the ground least include internal forces between the planar legs of solo8."""
    loaded, supports = standing("solo8")
    q = loaded.posture()
    oracle = oracle_of("solo8", (0.0, 1.0, -0.6))
    result = contact_stability(oracle, supports, q)
    assert result.freedom > 0
    own = oracle.quantities(q).support_impulse.reshape(-1, 3)
    before = max(0.0, float(-own[:, 2].min()))
    after = max(0.0, float(-min(foot.impulse[2] for foot in result.feet)))
    assert after <= before + 1e-9
    total = np.concatenate([foot.impulse for foot in result.feet])
    np.testing.assert_allclose(oracle.Js.T @ total, oracle.Js.T @ own.ravel(), atol=1e-6 * np.abs(own).max())


def test_soles_tip_over_their_edges() -> None:
    """An impact at the torso of talos tips the soles; more friction does not replace a larger sole."""
    loaded, supports = standing("talos")
    q = loaded.posture()
    frame = "torso_2_link"
    oracle = ImpactOracle(ImpactCase(loaded, ImpactContact(frame, (1.0, 0.0, -0.2)), Metric(), supports, 1e-6))
    wide = tuple(Support(s.frame, "surface", s.offset, (5.0, 5.0)) for s in supports)
    narrow = tuple(Support(s.frame, "surface", s.offset, (1e-4, 1e-4)) for s in supports)
    assert contact_stability(oracle, narrow, q).friction is None
    large = contact_stability(oracle, wide, q)
    assert any(foot.lifts for foot in large.feet) or large.friction is not None


# ---- use as a constraint ------------------------------------------------------------------------------------------


@pytest.mark.long(but=("solo12-base_link", "solo8-base_link"))
@pytest.mark.parametrize(
    ("name", "frame"), [("solo12", "base_link"), ("solo8", "base_link"), ("talos", "torso_2_link")]
)
def test_kept_feet_as_expression_and_in_numbers_agree(name: str, frame: str) -> None:
    """Compare the CasADi expression, the Pinocchio computation and finite differences."""
    loaded, supports = standing(name)
    contact = ImpactContact(frame, (0.3, -0.2, -1.0))
    objective = WorstCaseObjective(loaded, contact, supports=supports, compliance=1e-2 / loaded.mass)
    numeric = Numeric(loaded.model)
    kept = KeptContacts(objective, numeric.at(loaded.posture()), 0.7)
    q_symbol, n_symbol = ca.SX.sym("q", loaded.nq), ca.SX.sym("n", 3)
    symbolic = ca.Function("rows", [q_symbol, n_symbol], [kept.symbolic(Tree(loaded.model, q_symbol), n_symbol)])
    step = 0.2 * np.random.default_rng(3).normal(size=loaded.nv)
    q = np.asarray(pin.integrate(loaded.model, loaded.posture(), step))
    values, jacobian = kept.evaluate(numeric.at(q))
    assert values.shape == kept.upper.shape and len({kept.row_name(k) for k in range(kept.rows)}) >= 2
    assert_close(np.array(symbolic(q, contact.normal)).ravel(), values, 1e-7, "expression")
    expected = central_gradient(lambda x: kept.evaluate(numeric.at(x))[0], loaded.model, q, 1e-4)
    assert_close(jacobian, expected, 1e-5, "Jacobian")


def test_kept_feet_change_the_optimum() -> None:
    """Without `keep_contacts`, the optimum pulls at the ground.  With it, the given friction keeps the feet."""
    values = {"robot": "solo12", "frame": "base_link", "normal": (0.0, 0.0, -1.0)}
    free = prepare(make_settings(dict(values)))
    kept = prepare(make_settings({**values, "keep_contacts": True, "friction": 1.0}))
    assert any(isinstance(c, KeptContacts) for c in kept.problem.constraints)
    supports = free.problem.objective.supports
    without = solve(free.problem, starts=2, jobs=1)
    solution = solve(kept.problem, starts=2, jobs=1)
    assert solution.certificate.holds()
    oracle = kept.problem.impact.oracle
    before, after = contact_stability(oracle, supports, without.q), contact_stability(oracle, supports, solution.q)
    assert before.friction is None or before.friction > 1.0
    assert after.friction is not None and after.friction <= 1.02


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("tilthex_arm", "--normal", "0", "0", "1", "--keep-contacts"), "no feet to keep"),
        (("solo12", "--normal", "0", "0", "1", "--keep-contacts", "--friction", "0"), "above zero"),
    ],
)
def test_refusals(tmp_path: Path, arguments: tuple[str, ...], message: str) -> None:
    done = run("optimize", *arguments, cwd=tmp_path)
    assert done.returncode in (1, 2)
    assert message in done.stderr and "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())


def test_the_line_stands_in_evaluate(tmp_path: Path) -> None:
    done = run("evaluate", "solo12", "--frame", "base_link", "--normal", "0", "0", "1", cwd=tmp_path)
    assert done.returncode == 0 and "the impact lifts" in done.stdout
