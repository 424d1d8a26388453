"""Compression time, peak force and x, compared with integrated contacts; bounds on force and jump in a search."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.integrate
from hypothesis import given, settings
from hypothesis import strategies as st

from impact_posture.codegen.export import export
from impact_posture.config.problem_settings import MATERIALS
from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import InputError, SpecError
from impact_posture.impact.elasticity.contact_compression import (
    HERTZ_TIME,
    ContactStiffness,
    compression,
    hertz_stiffness,
    springs_along,
)
from impact_posture.impact.elasticity.elastic_impact import ElasticImpact
from impact_posture.impact.evaluation.evaluation import evaluate
from impact_posture.impact.friction.coulomb_impact import coulomb_impact
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.analysis.pareto_front import pareto_front
from impact_posture.posture.constraints.impact_bounds import ImpactBounds
from impact_posture.posture.constraints.pose_constraints import AxisInCone
from impact_posture.posture.formulation.problem_file import prepare, read_settings
from impact_posture.posture.search.multistart import solve
from impact_posture.robot.joint_model import with_joint_model
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import TransmissionSpec
from tests.support.command import run, succeed
from tests.support.helpers import random_configurations, relative, robot
from tests.support.pinocchio_values import central_gradient
from tests.support.settings import make_settings

masses, speeds = st.floats(0.05, 500.0), st.floats(0.01, 20.0)


def touch(power: float, stiffness: float, mass: float, speed: float) -> tuple[float, float]:
    """Integrate ``m δ̈ = −k δ^p`` from touch to rest; return the compression time T and the force at T."""
    # Scale depth by the greatest compression, and time by the greatest compression divided by the speed.
    depth = ((power + 1) * mass * speed**2 / (2 * stiffness)) ** (1 / (power + 1))
    ratio = stiffness * depth**power * depth / (mass * speed**2)

    def rest(t: float, y: np.ndarray) -> float:
        return float(y[1])

    rest.terminal = True  # type: ignore[attr-defined]
    run_ = scipy.integrate.solve_ivp(
        lambda t, y: [y[1], -ratio * max(y[0], 0.0) ** power],
        (0, 10),
        [0.0, 1.0],
        events=rest,
        rtol=1e-10,
        atol=1e-12,
    )
    return float(run_.t[-1]) * depth / speed, stiffness * (float(run_.y[0, -1]) * depth) ** power


@settings(max_examples=20, deadline=None)
@given(mass=masses, speed=speeds, stiffness=st.floats(1e2, 1e8))
def test_time_and_force_equal_an_integrated_contact(mass: float, speed: float, stiffness: float) -> None:
    for contact, power in ((ContactStiffness(linear=stiffness), 1.0), (ContactStiffness(hertz=stiffness), 1.5)):
        time, force = touch(power, stiffness, mass, speed)
        assert contact.compression_time(mass, speed) == pytest.approx(time, rel=1e-6)
        assert contact.peak_force(mass, speed) == pytest.approx(force, rel=1e-6)
        # A contact with this compression time T and this G transmits the impulse mv for any force law.
        alike = ContactStiffness(duration=time)
        assert alike.peak_force(mass, speed) == pytest.approx(np.pi / 2 * mass * speed / time)
        for one in (contact, alike):
            largest = one.largest_mass(force, speed)
            assert one.peak_force(largest, speed) == pytest.approx(force, rel=1e-9)


def test_the_constant_of_hertz_and_the_materials() -> None:
    assert pytest.approx(scipy.integrate.quad(lambda z: 1 / np.sqrt(1 - z**2.5), 0, 1)[0], rel=1e-9) == HERTZ_TIME
    # For two steel bodies, E* is half the plane-strain modulus of steel.
    E, nu = MATERIALS["steel"]
    assert hertz_stiffness("steel") == pytest.approx(4 / 3 * E / (2 * (1 - nu**2)) * 0.1)
    order = sorted(MATERIALS, key=hertz_stiffness)
    assert order == ["rubber", "wood", "ground", "steel"]


def elastic(name: str, stiffness: float = 12000.0) -> Robot:
    loaded = robot(name)
    return replace(loaded, spec=replace(loaded.spec, transmission=TransmissionSpec("elastic", stiffness)))


@pytest.mark.parametrize(
    ("name", "frame"), [("panda", "panda_hand_tcp"), ("tilthex_arm", "ee"), ("talos", "gripper_right_base_link")]
)
def test_x_from_plain_matrices(name: str, frame: str) -> None:
    loaded = elastic(name)
    objective = WorstCaseObjective(loaded, ImpactContact(frame, (0.3, 0.1, 1.0), friction=0.0))
    contact = ContactStiffness(linear=3e5)
    for q in random_configurations(loaded.model, 2, name, "x"):
        oracle = objective.oracle.at(q)
        joints = slice(loaded.first_joint, None)
        M = oracle.M - np.diag(loaded.armature) + oracle.Js.T @ oracle.Js / objective.compliance
        j = oracle.n @ oracle.J
        G, C = j @ np.linalg.solve(M, j), np.sum(j[joints] ** 2) / 12000.0
        built = springs_along(objective.case, q)
        assert built is not None and built == pytest.approx((1 / G, C), rel=1e-6)
        squeezed = compression(objective, q, 0.7, contact)
        assert squeezed is not None and squeezed.x == pytest.approx(np.pi / 2 / np.sqrt(3e5 * C), rel=1e-6)
        assert squeezed.peak_force == pytest.approx(0.7 * np.sqrt(3e5 / objective.oracle.quantities(q).G))
        table = compression(objective, q, 0.7, None)
        assert table is not None and table.x is None and list(table.by_material) == list(MATERIALS)


def test_x_of_a_standing_robot_equals_the_elastic_response() -> None:
    loaded = elastic("talos", 2000.0)
    supports = loaded.spec.supports
    for frame in ("torso_2_link", "gripper_right_base_link"):
        objective = WorstCaseObjective(loaded, ImpactContact(frame, (-1, 0, 0)), supports=supports)
        q = loaded.posture()
        links, _ = springs_along(objective.case, q) or (0.0, 0.0)
        squeezed = compression(objective, q, 1.0, ContactStiffness(linear=1e9))
        response = ElasticImpact(objective.case).response(q, 1e9)
        assert squeezed is not None and squeezed.x is not None and links > 0
        # The contact is so stiff that the compression time T depends only on the links, not on the rotors.
        assert squeezed.x == pytest.approx(response.compliance_ratio, rel=0.02)


@pytest.mark.parametrize(
    ("stiffness", "fits"), [(1e8, "link"), (1e6, None), (1e3, "reflected")]
)  # fmt: skip
def test_a_joint_model_that_does_not_fit_is_named_with_both_answers(stiffness: float, fits: str | None) -> None:
    loaded = elastic("panda")
    contact = ImpactContact("panda_hand_tcp", (0, 0, 1))
    values = {
        name: WorstCaseObjective(with_joint_model(loaded, name), contact).oracle.quantities(loaded.posture()).H  # type: ignore[arg-type]
        for name in ("link", "reflected")
    }
    for name in values:
        objective = WorstCaseObjective(with_joint_model(loaded, name), contact)  # type: ignore[arg-type]
        evaluation = evaluate(objective, loaded.posture(), contact_stiffness=ContactStiffness(linear=stiffness))
        assert evaluation.compression is not None and evaluation.compression.fitting == fits
        lines = [line for line in evaluation.warnings if line.startswith("x =")]
        assert len(lines) == (fits != name)
        if lines:
            assert all(f"{value:.4g} with '{other}'" in lines[0] for other, value in values.items())


def test_a_contact_given_by_a_material_names_the_assumed_tip() -> None:
    loaded = elastic("panda")
    objective = WorstCaseObjective(loaded, ImpactContact("panda_hand_tcp", (0, 0, 1)))
    for contact, named in (
        (None, True),
        (ContactStiffness.of("wood", None), True),
        (ContactStiffness.of(1e6, None), False),
        (ContactStiffness.of(None, 0.0125), False),
    ):
        result = compression(objective, loaded.posture(), 1.0, contact)
        assert result is not None and ("steel tip of 10 mm radius" in result.line) == named
        assert ("`contact_duration`" in result.line) == (contact is None)


def test_unknown_values_are_none() -> None:
    loaded = robot("tilthex_arm")
    objective = WorstCaseObjective(loaded, ImpactContact("ee", (0, 0, 1)))
    assert evaluate(objective, loaded.posture()).compression is None
    evaluation = evaluate(objective, loaded.posture(), contact_stiffness=ContactStiffness(linear=1e5)).compression
    assert (
        evaluation is not None and evaluation.x is None and evaluation.peak_force is not None and not evaluation.line
    )


# ---- bounds in a search -----------------------------------------------------------------------------------------


@pytest.mark.long(but=("panda-more1",))
@pytest.mark.parametrize(
    ("name", "more"),
    [("tilthex_arm", {}), ("panda", {"contact_pose": "aligned:25"})],
)
def test_the_bounds_hold_and_cost(name: str, more: dict[str, object]) -> None:
    settings_ = {
        "robot": name,
        "normal": (0.0, 0.0, 1.0),
        "objective": "impulse",
        "approach": False,
        "contact_stiffness": 1e5,
        "speed": 0.8,
        "starts": 3,
        **more,
    }
    plain = prepare(make_settings(settings_))
    free = solve(plain.problem, starts=3, compile="never")
    before, after = plain.impact.evaluate(free.initial), plain.impact.evaluate(free.q)
    assert before.compression is not None and after.compression is not None
    assert after.compression.peak_force is not None and before.coulomb is not None and after.coulomb is not None
    joints = slice(plain.impact.robot.first_joint, None)
    force, jump = 0.97 * after.compression.peak_force, 0.97 * np.abs(after.coulomb.velocity[joints]).max()
    bounded = prepare(
        make_settings({**settings_, "max_force": force, "max_torque": 3.0 * jump, "velocity_gain": 3.0})
    )
    (limits,) = (c for c in bounded.problem.constraints if isinstance(c, ImpactBounds))
    model, numeric = plain.impact.robot.model, Numeric(plain.impact.robot.model)
    _, jacobian = limits.evaluate(numeric.at(free.q))
    measured = central_gradient(lambda q: limits.evaluate(numeric.at(q))[0], model, free.q, 1e-4)
    assert relative(jacobian, measured) < 1e-5
    solution = solve(bounded.problem, starts=3, compile="never")
    evaluation = bounded.impact.evaluate(solution.q)
    assert solution.certificate.holds()
    assert (
        evaluation.compression is not None
        and evaluation.compression.peak_force is not None
        and evaluation.coulomb is not None
    )
    assert evaluation.compression.peak_force <= force * (1 + 1e-6)
    assert np.abs(evaluation.coulomb.velocity[joints]).max() <= jump * (1 + 1e-6)
    assert evaluation.H >= after.H * (1 - 1e-9), "a bound never helps"


@pytest.mark.parametrize(
    ("name", "key", "kind"), [("panda", "contact_pose", "aligned"), ("tilthex_arm", "base", "level")]
)
def test_what_may_tilt_does_at_least_as_well(name: str, key: str, kind: str) -> None:
    settings_ = {"robot": name, "normal": (0.0, 0.0, 1.0), "starts": 4}
    values = []
    for tilted in (kind, f"{kind}:10", f"{kind}:30"):
        prepared = prepare(make_settings({**settings_, key: tilted}))
        solution = solve(prepared.problem, starts=4, compile="never")
        assert solution.certificate.holds()
        values.append(prepared.problem.objective.value(solution.q))
        for constraint in prepared.problem.constraints:
            if isinstance(constraint, AxisInCone):
                degrees = float(tilted.partition(":")[2])
                numeric = Numeric(prepared.problem.robot.model)
                value, jacobian = constraint.evaluate(numeric.at(solution.q))
                assert -value[0] >= np.cos(np.deg2rad(degrees)) - 1e-9
                measured = central_gradient(
                    lambda q, c=constraint, n=numeric: c.evaluate(n.at(q))[0], numeric.model, solution.q, 1e-4
                )
                assert relative(jacobian, measured, scale=1.0) < 1e-9
    assert values[0] * (1 + 1e-9) >= values[1] >= values[2] * (1 - 1e-9)


def test_the_front_of_jump_and_force_equals_searches_with_a_bound() -> None:
    settings_ = {
        "robot": "tilthex_arm",
        "normal": (0, 0, 1),
        "objective": "speed",
        "contact_stiffness": 1e5,
        "speed": 0.6,
    }
    prepared = prepare(make_settings(settings_))
    solution = solve(prepared.problem, starts=4, compile="never")
    contact = ContactStiffness(linear=1e5)
    curve = pareto_front(solution, 4, force=(contact, 0.6), compile="never")
    assert curve.against == "force" and all(point.certified for point in curve.points)
    forces, values = ([getattr(p, key) for p in curve.points] for key in ("distance", "objective"))
    assert forces == sorted(forces) and values == sorted(values, reverse=True)
    for point in curve.points:
        mass = coulomb_impact(prepared.problem.impact.oracle, point.q).mass
        assert point.distance == pytest.approx(0.6 * np.sqrt(1e5 * mass)) and point.distance <= point.within + 1e-6
    assert values[-1] == pytest.approx(prepared.problem.objective.value(solution.q), rel=1e-6)
    middle = curve.points[2]
    bounded = prepare(make_settings({**settings_, "max_force": middle.within}))
    again = solve(bounded.problem, starts=4, compile="never")
    # A second search with the force bound does not reach a better posture.
    assert middle.objective <= bounded.problem.objective.value(again.q) * (1 + 1e-6)


@pytest.mark.parametrize(
    ("values", "error", "words"),
    [
        ({"tradeoff": 3, "tradeoff_against": "force"}, InputError, "needs the elasticity"),
        ({"max_force": 10.0}, InputError, "needs the elasticity"),
        ({"max_torque": 1.0}, InputError, "gain"),
        ({"velocity_gain": 1.0}, InputError, "gain"),
        ({"contact_stiffness": "iron"}, SpecError, "steel, wood"),
        ({"contact_stiffness": -1.0}, SpecError, "1 to 1e"),
        ({"max_force": 1e-300, "contact_stiffness": 1e5}, SpecError, "to 1e"),
        ({"max_force": 5.0, "contact_stiffness": 1e5, "speed": 0.0}, InputError, "approach speed"),
        ({"tradeoff": 3, "tradeoff_against": "force", "contact_duration": 0.01, "speed": 0.0}, InputError, "speed"),
        ({"contact_stiffness": 1e5, "contact_duration": 0.1}, InputError, "one of the two"),
        ({"contact_duration": 0.0}, SpecError, "1e-07 to 100 s"),
        ({"contact_pose": "aligned:90"}, SpecError, "aligned:DEG"),
        ({"contact_pose": "aligned:nan"}, SpecError, "aligned:DEG"),
        ({"base": "level:90"}, SpecError, "level:DEG"),
        ({"base": "level:0.01"}, SpecError, "0.1 degrees or more"),
        ({"base": "aligned:20"}, SpecError, "level:DEG"),
    ],
)
def test_refusals(values: dict[str, object], error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        prepare(make_settings({"robot": "tilthex_arm", "normal": (0.0, 0.0, 1.0), **values}))


def test_bounds_that_cannot_be_met_name_their_rows_and_units() -> None:
    settings_ = {"robot": "panda", "normal": (0, 0, 1), "max_force": 1.0, "contact_stiffness": "steel"}
    problem = prepare(make_settings({**settings_, "max_joint_jump": 1e-3})).problem
    (bounds,) = (c for c in problem.constraints if isinstance(c, ImpactBounds))
    values = bounds.evaluate(Numeric(problem.robot.model).at(problem.given))[0]
    conflicts = bounds.conflicts(values - np.clip(values, bounds.lower, bounds.upper))
    assert bounds.size("peak force", conflicts["peak force"]).endswith(" kg of effective mass")
    jump = "jump of panda_joint1"
    assert bounds.size(jump, 0.25) == "off by 0.25 rad/s (m/s) per m/s of approach" and conflicts[jump] > 0


def test_edges_of_speed_and_of_locked_joints(tmp_path: Path) -> None:
    """At zero speed, no compression time exists for a material.  With all joints locked, no joint jump can be
    bounded.
    """
    still = ("evaluate", "panda", "--normal", 0, 0, 1, "--speed", 0, "--contact-stiffness", "steel", "--json")
    done = json.loads(run(*still).stdout)["evaluation"]["compression"]
    assert done["compression_time"] is None and done["peak_force"] == 0 and done["x"] is None
    rigid = prepare(
        make_settings({"robot": "tilthex_arm", "normal": (0, 0, 1), "joint_model": "locked", "max_joint_jump": 2.0})
    )
    assert not any(isinstance(c, ImpactBounds) for c in rigid.problem.constraints)


def test_an_option_stands_for_the_other_key_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "p.toml"
    path.write_text('robot = "panda"\nnormal = [0.0, 0.0, 1.0]\ncontact_stiffness = 1e5\n')
    assert read_settings(path, {"contact_duration": 0.01}).contact_stiffness is None


def test_the_commands(tmp_path: Path) -> None:
    config = tmp_path / "robot.toml"
    config.write_text(
        'schema = "impact-posture/robot/1"\n[transmission]\nkind = "elastic"\nstiffness = 14000\nsource = "assumed"\n'
    )
    evaluation = run("evaluate", "panda", "--normal", 0, 0, 1, "--config", config, "--contact-stiffness", "wood")
    assert (
        "peak force" in evaluation.stdout
        and "x = 0.06" in evaluation.stdout
        and "use --joint-model link" in evaluation.stderr
    )
    between = ("panda", "--normal", 0, 0, 1, "--config", config, "--joint-model", "elastic")
    shown = run("evaluate", *between, "--contact-stiffness", 1e6)
    assert "elastic joints on 1e+06 N/m" in shown.stdout and "largest torque of panda_joint4" in shown.stdout
    for options, words in (
        (("evaluate", *between), "add --contact-stiffness"),
        (("optimize", *between, "--contact-stiffness", 1e6), "evaluate the optimum with 'elastic'"),
    ):
        failed = run(*options)
        assert failed.returncode == 1 and words in failed.stderr and "Traceback" not in failed.stderr
    out = tmp_path / "out"
    options = ("--contact-stiffness", 1e5, "--max-force", 180, "--max-joint-jump", 3, "--starts", 2, "--no-codegen")
    options = (*options, "--tradeoff", 2, "--tradeoff-against", "force", "--format", "png")
    done = succeed("optimize", "tilthex_arm", "--normal", 0, 0, 1, *options, "--out", out)
    assert "effective mass at most" in done.stdout and "the best posture within a peak force (N)" in done.stdout
    document = json.loads((out / "result.json").read_text())
    assert document["optimal"]["compression"]["peak_force"] <= 180 * (1 + 1e-6)
    assert document["tradeoff_against"] == "force" and document["tradeoff"][-1]["distance"] <= 180 * (1 + 1e-6)
    again = read_settings(out / "problem.toml")
    assert (again.contact_stiffness, again.max_force, again.max_joint_jump) == (1e5, 180, 3)
    assert (again.tradeoff, again.tradeoff_against) == (2, "force")


def test_x_is_unknown_if_the_impact_moves_joints_on_unknown_springs(tmp_path: Path) -> None:
    """Of talos, only the stiffness of the hip roll is known.  A hit on the hand hardly moves the hips."""
    loaded = robot("talos")
    objective = WorstCaseObjective(
        loaded, ImpactContact("gripper_right_base_link", (-1, 0, 0)), supports=loaded.spec.supports
    )
    evaluation = evaluate(objective, loaded.posture(), contact_stiffness=ContactStiffness(linear=1e5))
    squeezed = evaluation.compression
    assert squeezed is not None and squeezed.x is None and squeezed.fitting is None
    assert "arm_right_4_joint" in squeezed.unknown_springs and "leg_left_2_joint" not in squeezed.unknown_springs
    # If only the links move, every joint in ``unknown_springs`` moves more than a tenth of the fastest joint.
    links = WorstCaseObjective(with_joint_model(loaded, "link"), objective.contact, supports=loaded.spec.supports)
    jump = np.abs(links.oracle.quantities(loaded.posture()).jump[6:])
    sizes = dict(zip(loaded.tangent_names[6:], jump, strict=True))
    assert all(sizes[name] >= 0.1 * jump.max() for name in squeezed.unknown_springs)
    (warning,) = (line for line in evaluation.warnings if line.startswith("x is unknown"))
    for name in ("link", "reflected"):
        value = replace(objective, robot=with_joint_model(loaded, name)).value(loaded.posture())  # type: ignore[arg-type]
        assert f"{value:.4g} with '{name}'" in warning
    # The comment in the C header names the same joints.
    (tmp_path / "c").mkdir()
    export(objective, tmp_path / "c", compression=squeezed, check=False)
    (header,) = (path for path in (tmp_path / "c").glob("*.h") if "arm_right_4_joint" in path.read_text())
    assert "x is unknown" in header.read_text()
