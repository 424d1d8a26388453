"""The impact-robust posture task: its gain, phases and rest, and the offline optimum that the task reaches."""

from __future__ import annotations

import functools
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.codegen.export import export
from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.errors import InputError, ManifestMismatch, MetricError
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.constraints.requirements import Requirements
from impact_posture.posture.formulation.build_problem import build_problem
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.search.multistart import solve
from impact_posture.robot.joint_model import with_joint_model
from impact_posture.robot.robot_loader import load_robot
from impact_posture.robot.robot_spec import Support
from impact_posture.simulation.scenario_objective import interpreted
from impact_posture.tsid.controller import Controller, Status
from impact_posture.tsid.flow.reference_flow_posture import ReferenceFlowPosture
from impact_posture.tsid.limits.acceleration_bounds import LimitLaw
from impact_posture.tsid.state import State
from impact_posture.tsid.task_formulation import aerial_formulation, legged_formulation
from impact_posture.tsid.tasks.activation import Activation, Phase
from impact_posture.tsid.tasks.impact_robust import ImpactRobustPosture, curvature_scale, gradient_of
from impact_posture.tsid.tasks.joint_posture import JointPosture
from tests.support.helpers import rng, robot
from tests.support.pinocchio_values import central_gradient
from tests.support.step_bounds import step_bound
from tests.support.tools import need_compiler
from tests.tsid.test_tsid_controller import DT, assert_dynamics, assert_limits, integrate, run

ARM = "tilthex_arm"
UP = (0.0, 0.0, 1.0)


@functools.cache
def problem(objective: str = "impulse") -> ConstrainedProblem:
    r = robot(ARM)
    value = WorstCaseObjective(r, ImpactContact("ee", UP), kind=objective)  # type: ignore[arg-type]
    return build_problem(r, value, r.posture(), Requirements(base="level", limit_margin=0.05))


@pytest.fixture(scope="session")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return the folders of the exports, with the objective as key."""
    need_compiler()
    paths = {name: tmp_path_factory.mktemp(name) for name in ("impulse", "speed")}
    for name, folder in paths.items():
        export(problem(name).objective, folder, check=False)
    return paths


@pytest.fixture(scope="session")
def exported(folders: dict[str, Path]) -> dict[str, ImpactGradient]:
    """Return the compiled exports, built once, with the objective as key."""
    return {name: ImpactGradient.load(folder, robot=robot(ARM)) for name, folder in folders.items()}


def flying(posture: JointPosture) -> tuple[Controller, np.ndarray, np.ndarray]:
    r = robot(ARM)
    controller = Controller(r, aerial_formulation(r, posture))
    q, v = r.posture(), np.zeros(r.nv)
    controller.reset(q, v)
    return controller, q, v


def test_scale_is_the_curvature_along_the_redundancy(exported: dict[str, ImpactGradient]) -> None:
    posture = ImpactRobustPosture(robot(ARM), gradient_of(exported["impulse"]))
    controller, q, _ = flying(posture)
    Z = controller.assembly.redundancy(controller.state)
    assert Z.shape == (9, 1)
    for level in controller.formulation.levels:
        for task in level:
            assert np.abs(task.jacobian(controller.state) @ Z).max() < 1e-9
    plain, model = gradient_of(exported["impulse"]), robot(ARM).model
    hessian = central_gradient(lambda x: np.array(plain(x)[1]), model, q, 1e-4)
    assert posture.scale == pytest.approx(abs(float(Z[:, 0] @ hessian @ Z[:, 0])), rel=1e-4)


def test_the_compiled_gradient_differentiates_its_value(exported: dict[str, ImpactGradient]) -> None:
    """Check both gradients of the export: for a given normal, and of the problem's objective."""
    model = robot(ARM).model
    q = np.array(pin.integrate(model, robot(ARM).posture(), 0.1 * rng("g").normal(size=model.nv)))
    for function in (gradient_of(exported["impulse"], UP), gradient_of(exported["speed"])):
        numeric = central_gradient(lambda x: function(x)[0], model, q, 1e-4)  # noqa: B023
        assert np.allclose(function(q)[1], numeric, rtol=1e-6, atol=1e-6 * np.abs(numeric).max())


@functools.cache
def _offline(objective: str) -> tuple[np.ndarray, ...]:
    solution = solve(problem(objective), starts=6, jobs=1, compile="never")
    return tuple(optimum.q for optimum in solution.optima)


@pytest.mark.parametrize(("objective", "K"), [("impulse", 4.0), ("speed", 100.0)])
def test_online_meets_offline(exported: dict[str, ImpactGradient], objective: str, K: float) -> None:
    """With damping only, ``K H/λ + ½‖ν‖²`` decreases until the robot reaches an optimum of the offline program."""
    r, dt = robot(ARM), 4e-3
    posture = ImpactRobustPosture(
        r,
        gradient_of(exported[objective]),
        K=K,
        kp=0.0,
        kd=max(4.0, K / 10),
        every=1,
        fade=(1e-6, 2e-6),
        reach=1e6,
        activation=Activation(ramp=1e-6),
    )
    # The offline problem uses the same margin to the joint limits.
    formulation = aerial_formulation(r, posture, law=LimitLaw(margin=0.05))
    controller = Controller(r, formulation, period=dt)
    q, v = r.posture(), np.zeros(r.nv)
    controller.reset(q, v)
    posture.brace()
    energy, value, slow = [], gradient_of(exported[objective]), 0
    for k in range(8000):
        energy.append(K / posture.scale * value(q)[0] + 0.5 * float(v @ v))
        command = controller.tick(k * dt, q, v)
        assert command.status is Status.SOLVED
        v = v + dt * command.acceleration
        q = np.array(pin.integrate(r.model, q, dt * v))
        # The motion may reverse, so the robot counts as at rest only after a hundred slow ticks.
        slow = slow + 1 if np.abs(v).max() < 2e-4 else 0
        if slow > 100:
            break
    # The integration in time steps may raise the energy by a millionth.
    assert np.diff(energy).max() <= 1e-6 * energy[0]
    assert energy[-1] < energy[0]
    distances = [np.abs(pin.difference(r.model, q, best)).max() for best in _offline(objective)]
    assert min(distances) < 1e-2, distances


def test_with_the_spring_it_rests_where_the_two_pulls_are_equal(exported: dict[str, ImpactGradient]) -> None:
    posture = ImpactRobustPosture(robot(ARM), gradient_of(exported["impulse"]), K=20.0, kp=10.0, reach=100.0)
    controller, q, v = flying(posture)
    posture.brace()
    *_, (_, command, q, v) = run(controller, q, v, 4000)
    assert np.abs(v).max() < 1e-4 and command.status is Status.SOLVED
    Z = controller.assembly.redundancy(controller.state)
    pull = 10.0 * pin.difference(robot(ARM).model, q, posture.target)
    push = 20.0 / posture.scale * np.array(gradient_of(exported["impulse"])(q)[1])
    assert np.abs(Z.T @ (pull - push)).max() < 1e-3 * np.abs(Z.T @ pull).max()
    assert np.abs(q[7:] - robot(ARM).posture()[7:]).max() > 0.05


def rest(exported: dict[str, ImpactGradient], spring: str) -> float:
    """Return the ratio of ``H`` at rest to ``H`` at the start."""
    posture = ImpactRobustPosture(
        robot(ARM), gradient_of(exported["impulse"]), K=20.0, kp=10.0, spring=spring  # type: ignore[arg-type]
    )  # fmt: skip
    controller, q, v = flying(posture)
    start = posture.value
    posture.brace()
    for _ in run(controller, q, v, 5000):
        pass
    return posture.value / start


def test_a_spring_that_lets_go_or_follows_reaches_further(exported: dict[str, ImpactGradient]) -> None:
    kept, released, followed = (rest(exported, spring) for spring in ("keep", "release", "follow"))
    assert released < 0.9 * kept and followed < 0.9 * kept
    assert followed == pytest.approx(released, rel=0.05)


@pytest.mark.long(but=("follow",))
@pytest.mark.parametrize("spring", ["keep", "follow"])
def test_the_course_of_an_impact_makes_no_step(exported: dict[str, ImpactGradient], spring: str) -> None:
    posture = ImpactRobustPosture(
        robot(ARM), gradient_of(exported["impulse"]), K=20.0, kp=10.0, spring=spring, every=1  # type: ignore[arg-type]
    )  # fmt: skip
    controller, q, v = flying(posture)
    events = {200: posture.brace, 900: posture.contact, 1000: posture.release}
    phases, largest, bound = [], 0.0, 0.0
    for k in range(1600):
        if k in events:
            events[k]()
        state = State(robot(ARM), controller.formulation.points).update(q, v)
        before = posture.desired(state)
        level = posture.activation.level
        bound = step_bound(posture, state, DT)
        command = controller.tick(k * DT, q, v)
        # If the state does not change, only ramps, fades and the new gradient change the acceleration.
        step = float(np.abs(posture.desired(controller.state) - before).max())
        allowed = max(bound, step_bound(posture, state, DT)) + 0.05 * max(level, posture.activation.level)
        assert step <= allowed + 1e-9, (k, step, allowed)
        largest = max(largest, step)
        phases.append(posture.activation.phase)
        q, v = integrate(robot(ARM), q, v, command)
        if k == 899:
            reached = q.copy()
    assert [phases[k] for k in (0, 500, 950, 1050, 1599)] == [
        Phase.FREE, Phase.BRACE, Phase.CONTACT, Phase.RELEASE, Phase.FREE,
    ]  # fmt: skip
    # The task holds the reached posture.
    assert np.abs(posture.target[7:] - reached[7:]).max() < 0.05
    assert np.abs(q[7:] - reached[7:]).max() < 0.1
    assert np.abs(q[7:] - robot(ARM).posture()[7:]).max() > 0.1
    assert posture.activation.level == 0


def test_live_keeps_the_term_through_the_contact(exported: dict[str, ImpactGradient]) -> None:
    posture = ImpactRobustPosture(
        robot(ARM), gradient_of(exported["impulse"]), activation=Activation(ramp=0.05, live=True)
    )
    controller, q, v = flying(posture)
    target = posture.target.copy()
    with pytest.raises(InputError, match="'contact' does not follow 'free'"):
        posture.contact()
    posture.brace()
    *_, (_, _, q, v) = run(controller, q, v, 100)
    posture.contact()
    *_, (_, _, q, v) = run(controller, q, v, 100)
    assert posture.activation.level == 1 and np.array_equal(posture.target, target)
    posture.release()
    *_, (_, _, q, v) = run(controller, q, v, 100)
    assert posture.activation.level == 0 and posture.activation.phase is Phase.FREE
    assert not np.array_equal(posture.target, target)


def test_the_term_fades_out_before_a_limit_and_is_bounded() -> None:
    r = robot(ARM)
    upper = np.asarray(r.model.upperPositionLimit)[7:]
    push = np.zeros(r.nv)
    push[6:] = -1.0
    posture = ImpactRobustPosture(r, lambda q: (1.0, push), K=3.0, scale=1.0, reach=1e3, every=1)
    state = State(r)
    posture.reset(state)
    posture.brace()
    for distance, share in ((0.5, 1.0), (0.2, 1.0), (0.125, 0.5), (0.05, 0.0), (0.01, 0.0)):
        q = r.posture()
        q[7] = upper[0] - distance
        posture.advance(state.update(q, np.zeros(r.nv)), 0.0)
        posture.activation.advance(1.0)
        posture.advance(state, 0.0)
        assert posture.term[6] == pytest.approx(3.0 * share, abs=1e-12)
        assert posture.term[7] == pytest.approx(3.0)
    # If the impact term pushes away from the joint limit, the term is not faded.
    push[6] = 1.0
    posture.advance(state, 0.0)
    assert posture.term[6] == pytest.approx(-3.0)
    short = ImpactRobustPosture(r, lambda q: (1.0, 100 * push), K=3.0, scale=1.0, reach=2.0, every=1)
    short.reset(state.update(r.posture(), np.zeros(r.nv)))
    short.brace()
    short.advance(state, 1.0)
    assert np.linalg.norm(short.term) == pytest.approx(6.0)


def test_a_posture_task_goes_to_the_offline_optimum_without_a_gradient() -> None:
    r = robot(ARM)
    best = _offline("impulse")[0]
    # The end effector holds its pose, so the test compares only the joints.
    controller, q, v = flying(JointPosture(r, best, kp=10.0))
    *_, (_, _, q, _) = run(controller, q, v, 4000)
    assert np.abs(q[7:] - best[7:]).max() < 1e-2


def test_a_standing_robot_braces_on_its_feet() -> None:
    """The contact-consistent H of a push at the base of solo8 decreases, and the feet do not move."""
    r = robot("solo8")
    supports = tuple(Support(s.frame, s.kind, s.offset) for s in r.spec.supports)
    value = WorstCaseObjective(r, ImpactContact("base_link", (1.0, 0.0, 0.0)), supports=supports)
    posture = ImpactRobustPosture(r, interpreted(value), K=80.0, kp=20.0, weight=0.1, base_weight=0.0)
    controller = Controller(r, legged_formulation(r, posture))
    q, v = r.posture(), np.zeros(r.nv)
    controller.reset(q, v)
    start, places = (
        posture.value,
        [controller.state.at(c.point).position.copy() for c in controller.formulation.contacts],
    )
    posture.brace()
    for k, command, _, _ in run(controller, q, v, 600):
        assert command.status is Status.SOLVED
        if k % 50 == 0:
            assert_dynamics(controller, command)
            assert_limits(controller, command)
    assert posture.value < 0.99 * start
    for contact, place in zip(controller.formulation.contacts, places, strict=True):
        assert np.linalg.norm(controller.state.at(contact.point).position - place) < 1e-3


def test_an_export_of_another_robot_is_refused(exported: dict[str, ImpactGradient]) -> None:
    """The other robot has the same joints, so only the check of the manifest can detect the difference."""
    other = load_robot(ARM, armature={joint: 0.5 for joint in robot(ARM).joint_names})
    for make in (ImpactRobustPosture, ReferenceFlowPosture):
        with pytest.raises(ManifestMismatch, match="armature"):
            make(other, exported["impulse"])
        make(with_joint_model(robot(ARM), "link"), exported["impulse"])
        # The gradient is a plain Python function, so its robot is not checked.
        make(other, gradient_of(exported["impulse"]))


@pytest.mark.parametrize(
    "options",
    [{"K": -1.0}, {"K": np.inf}, {"fade": (0.2, 0.1)}, {"every": 0}, {"spring": "Release"}, {"base_weight": -1.0}],
    ids=str,
)
def test_invalid_options_of_the_term_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        ImpactRobustPosture(robot(ARM), lambda q: (1.0, q), **options)


def test_a_normal_of_another_length_and_a_flat_objective_are_refused(exported: dict[str, ImpactGradient]) -> None:
    with pytest.raises(InputError, match="normal"):
        gradient_of(exported["impulse"], (0, 0, 2))
    with pytest.raises(MetricError):
        flying(ImpactRobustPosture(robot(ARM), lambda q: (0.0, np.zeros(robot(ARM).nv))))


def test_the_example_of_the_documentation_runs(folders: dict[str, Path]) -> None:
    script = Path(__file__).parents[2] / "docs" / "examples" / "brace.py"
    done = subprocess.run([sys.executable, script, folders["impulse"]], capture_output=True, text=True, check=True)
    before, after = (float(line.split(":")[1].split(";")[0]) for line in done.stdout.splitlines()[:2])
    assert after < 0.5 * before
    assert "free, solved" in done.stdout


def test_the_scale_of_the_term_does_not_depend_on_the_basis_of_the_redundancy() -> None:
    """The exported controller uses another null-space basis, and finite differences along a basis have an error."""
    r, generator = robot("panda"), rng("basis")
    Z, turn = (np.linalg.qr(generator.normal(size=shape))[0] for shape in ((r.nv, 3), (3, 3)))

    def gradient(q: np.ndarray) -> tuple[float, np.ndarray]:
        return 1.0, np.sin(30.0 * q)

    first, other = (curvature_scale(gradient, r.model, r.posture(), basis, "term") for basis in (Z, Z @ turn))
    assert first > 1.0 and other == pytest.approx(first, rel=1e-13)
