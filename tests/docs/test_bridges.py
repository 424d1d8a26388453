"""Examples of docs/bridges.md and docs/frameworks.md, compared with independent numbers."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import impact_posture as ip
from impact_posture.codegen.c_literals import DOUBLE, FLOAT, Real
from impact_posture.codegen.export import export
from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.errors import CompilerError
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot_loader import load_robot
from impact_posture.system.toolchain import run_compiler
from tests.support.helpers import Vector, assert_close, random_configurations, robot, unit
from tests.support.pinocchio_values import central_gradient, frame_placement
from tests.support.tools import cxx_compiler, eigen_headers, need_compiler

DOCS = Path(__file__).parents[2] / "docs"
EXAMPLES = DOCS / "examples"


def shown_output() -> dict[str, list[str]]:
    """Return the output lines that the page shows for pink, with the contact as key."""
    page = (DOCS / "bridges.md").read_text(encoding="utf-8")
    lines: dict[str, list[str]] = {}
    for line in re.findall(r"^```text\n(.*?)^```", page, re.MULTILINE | re.DOTALL)[0].splitlines():
        if line.startswith(" "):
            lines[list(lines)[-1]].append(line.strip())
        else:
            lines[line] = []
    return lines


@pytest.mark.parametrize("file", sorted(EXAMPLES.rglob("*.py")), ids=lambda p: p.stem)
def test_examples_need_no_file_of_the_checkout(file: Path) -> None:
    """Readers download the examples, so they must not import the package ``tests``, which is not installed."""
    assert not re.search(r"^\s*(from|import) tests\b", file.read_text(encoding="utf-8"), re.MULTILINE)


# ---- pink ---------------------------------------------------------------------------------------------------------


def load_example(name: str, package: str, installed: str) -> ModuleType:
    """Return the module of an example; skip the test if its package is not installed."""
    pytest.importorskip(package, reason=f"needs {package}: pip install {installed}", exc_type=ImportError)
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # The decorator of dataclasses requires that their module is in ``sys.modules``.
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def example() -> ModuleType:
    return load_example("pink_impact", "pink", "pin-pink")


@dataclass(frozen=True)
class PinkRun:
    outcomes: dict[str, Any]
    printed: str


@pytest.fixture(scope="module")
def pink_run(example: ModuleType) -> PinkRun:
    need_compiler()
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        outcomes = example.main()
    return PinkRun({o.contact.name: o for o in outcomes}, printed.getvalue())


FLOOR, WALL, TABLE = "tilthex_arm on a floor", "tilthex_arm against a wall", "ur5, ball tip on a table"


@pytest.mark.parametrize(("name", "fall"), [(FLOOR, 0.65), (WALL, 0.40), (TABLE, 0.43)])
def test_pink_lowers_H_at_every_tick(pink_run: PinkRun, name: str, fall: float) -> None:
    outcome = pink_run.outcomes[name]
    H, oracle = outcome.H, outcome.prepared.impact.objective.oracle
    assert H[0] == pytest.approx(oracle.quantities(outcome.offline.initial).H, rel=1e-9)
    assert H[-1] == pytest.approx(oracle.quantities(outcome.q).H, rel=1e-9)
    assert H[-1] <= (1 - fall) * H[0]
    assert np.diff(H).max() <= 1e-9 * H[0]


@pytest.mark.parametrize("name", [FLOOR, WALL, TABLE])
def test_pink_holds_the_frame(pink_run: PinkRun, name: str) -> None:
    outcome = pink_run.outcomes[name]
    arm, start = outcome.prepared.impact.robot, outcome.offline.initial
    model, frame = arm.model, arm.frame_id(outcome.prepared.impact.contact.frame)
    before, after = (frame_placement(model, q, frame) for q in (start, outcome.q))
    turned = np.linalg.norm(pin.log3(before.rotation.T @ after.rotation))
    assert np.abs(after.translation - before.translation).max() <= 1e-9
    # Each tick linearizes the constraints, which causes a small error.
    assert 0 < outcome.errors.max() <= 1e-5
    if name == TABLE:
        assert turned > 0.5, "the ball tip must turn, because it is redundant"
    else:
        assert turned <= 1e-9
        tilt = frame_placement(model, outcome.q, arm.frame_id("base_link")).rotation[:, 2]
        np.testing.assert_allclose(tilt, [0, 0, 1], rtol=0, atol=1e-9)
    joints = slice(7 if arm.floating else 0, None)
    margin = outcome.prepared.problem.requirements.limit_margin - 1e-6
    assert (outcome.q[joints] >= model.lowerPositionLimit[joints] + margin).all()
    assert (outcome.q[joints] <= model.upperPositionLimit[joints] - margin).all()


@pytest.mark.parametrize(("name", "rad"), [(FLOOR, 1e-5), (WALL, 1e-5), (TABLE, 1e-2)])
def test_pink_rests_at_an_offline_optimum(pink_run: PinkRun, name: str, rad: float) -> None:
    outcome = pink_run.outcomes[name]
    distances, optima = outcome.distances(), outcome.offline.optima
    k = int(np.argmin(distances))
    assert distances[k] <= rad
    assert outcome.H[-1] == pytest.approx(optima[k].objective, rel=1e-5)
    moved = np.linalg.norm(pin.difference(outcome.prepared.impact.robot.model, outcome.offline.initial, outcome.q))
    assert moved > 1, "the start must not be optimal"
    if name == TABLE:
        assert optima[0].objective < 0.5 * outcome.H[-1], "the page says that this optimum is local"
    else:
        assert k == 0
        assert outcome.speed < 1e-6


def test_pink_prints_what_the_page_shows(pink_run: PinkRun) -> None:
    shown = shown_output()
    assert list(shown) == [FLOOR, WALL, TABLE]
    blocks = re.split(r"^(?=\S)", pink_run.printed, flags=re.MULTILINE)[1:]
    for block, (name, lines) in zip(blocks, shown.items(), strict=True):
        assert block.startswith(name)
        assert len(lines) == 2
        assert all(line in block for line in lines), f"the page shows {lines}, printed is\n{block}"


def test_held_tasks_have_the_jacobian_of_their_error(example: ModuleType) -> None:
    """In pink, ``J Δq = −e``, so J is the derivative of the error e on the manifold."""
    arm = robot("tilthex_arm")
    model = arm.model.copy()
    pink = importlib.import_module("pink")
    q = np.array(pin.integrate(model, arm.posture(), np.random.default_rng(3).uniform(-0.5, 0.5, model.nv)))
    configuration = pink.Configuration(model, model.createData(), q)
    for task in (example.PointTask("ee", configuration), example.LevelTask("base_link")):

        def error(at: Vector, task: Any = task) -> Vector:
            return np.array(task.compute_error(pink.Configuration(model, model.createData(), at)))

        assert_close(task.compute_jacobian(configuration), central_gradient(error, model, q, 1e-3), 1e-9, repr(task))


def test_pink_lowers_the_effective_mass(example: ModuleType, tmp_path: Path) -> None:
    need_compiler()
    pink = importlib.import_module("pink")
    arm = robot("ur5")
    contact = ImpactContact("tool0", (0, 0, 1), friction=0.0)
    export(WorstCaseObjective(arm, contact, kind="effective-mass"), tmp_path, prefix="arm", check=False)
    gradient = ImpactGradient.load(tmp_path, robot=arm)
    configuration = pink.Configuration(arm.model, arm.model.createData(), arm.posture())
    task, held = example.ImpactTask(gradient, 5.0, configuration.q), example.point("tool0", configuration)
    masses = [gradient.objective(configuration.q)[0]]
    for _ in range(20):
        v = pink.solve_ik(configuration, [task], example.DT, solver="daqp", constraints=held)
        configuration.integrate_inplace(v, example.DT)
        masses.append(1 / WorstCaseObjective(arm, contact).oracle.quantities(configuration.q).G)
    assert np.diff(masses).max() < 0 and masses[-1] < 0.99 * masses[0]


# ---- mink, MuJoCo, PyTorch ----------------------------------------------------------------------------------------


def test_mink_lowers_the_effective_mass_to_the_offline_optimum() -> None:
    need_compiler()
    example = load_example("mink_impact", "mink", "mink")
    outcome = example.main()
    arm = load_robot(str(example.MJCF))
    objective = ip.ImpactObjective(arm, ImpactContact("tool", (0, 0, 1), friction=0.0), kind="effective-mass")
    assert outcome.mass[-1] == pytest.approx(1 / objective.oracle.quantities(outcome.q).G, rel=1e-9)
    assert np.diff(outcome.mass).max() <= 0 and outcome.error < 2e-4
    task = {"collision": False, "holdable": False, "contact_pose": "position"}
    best = ip.optimize(ip.PostureProblem(objective, **task), starts=6, jobs=1, search="multistart")
    assert outcome.mass[-1] == pytest.approx(objective.value(best.q), rel=2e-3)
    assert f"{outcome.mass[0]:.4g} kg to {outcome.mass[-1]:.4g} kg" in (DOCS / "bridges.md").read_text()


def test_a_null_space_torque_lowers_H_in_mujoco(monkeypatch: pytest.MonkeyPatch) -> None:
    need_compiler()
    example = load_example("mujoco_null_space", "mujoco", "mujoco")
    monkeypatch.setattr(example, "DURATION", 1.0)
    with_term, without = example.main()
    arm = load_robot(str(example.MJCF))
    assert with_term.error < 2e-4 and without.error < 1e-4
    assert with_term.H[-1] < 0.8 * with_term.H[0] and np.diff(with_term.H).max() < 1e-6
    assert without.H[-1] == pytest.approx(without.H[0], rel=1e-3)
    oracle = WorstCaseObjective(arm, ImpactContact("tool", (0, 0, 1))).oracle
    assert with_term.H[-1] == pytest.approx(oracle.quantities(with_term.q).H, rel=1e-2)
    rng = np.random.default_rng(1)
    J, root = rng.normal(size=(3, 7)), rng.normal(size=(7, 7))
    M = root @ root.T + np.eye(7)
    torque = example.null_space_torque(M, J, rng.normal(size=7))
    np.testing.assert_allclose(J @ np.linalg.solve(M, torque), 0, atol=1e-12)


def test_a_penalty_in_pytorch_lowers_the_effective_mass() -> None:
    need_compiler()
    example = load_example("torch_reward", "torch", "torch")
    torch = importlib.import_module("torch")
    arm = load_robot(str(example.MJCF))
    postures = random_configurations(arm.model, 3, "reward")
    ours = example.tool_position(torch.tensor(np.array(postures)))
    theirs = [frame_placement(arm.model, q, arm.frame_id("tool")).translation for q in postures]
    np.testing.assert_allclose(ours, theirs, atol=1e-12)
    without, with_penalty = example.main()
    assert with_penalty.mass < 0.85 * without.mass
    assert without.distance < 0.02 and with_penalty.distance < 0.02


# ---- C++ ----------------------------------------------------------------------------------------------------------


def eigen_program(folder: Path, floating: bool) -> Path:
    """Build the C++ example and the export in a folder; skip the test without a compiler or Eigen."""
    compiler, eigen = cxx_compiler(), eigen_headers()
    if compiler is None or eigen is None:
        pytest.skip("no C++ compiler (g++, clang++, $CXX), or no Eigen headers (cmeel-eigen, $EIGEN3_INCLUDE_DIR)")
    target = folder / "posture_acceleration"
    flags = ["-std=c++17", "-O0", "-Wall", "-Wextra", "-Werror", f"-DFLOATING_BASE={int(floating)}"]
    headers = ["-I", str(folder), "-isystem", str(eigen)]
    objects = [str(p) for p in folder.glob("*.o")]
    main = str(EXAMPLES / "cpp" / "main.cpp")
    run_compiler([*compiler, *flags, *headers, main, *objects, "-o", str(target), "-lm"], folder)
    return target


def accelerations(program: Path, states: list[tuple[Vector, ...]]) -> list[str]:
    text = "\n".join(" ".join(f"{x:.17g}" for part in state for x in part) for state in states)
    return subprocess.run([str(program)], input=text, capture_output=True, text=True, check=True).stdout.splitlines()


def exported(name: str, frame: str, folder: Path, real: Real) -> WorstCaseObjective:
    objective = WorstCaseObjective(robot(name), ImpactContact(frame, (0, 0, 1)))
    export(objective, folder, prefix="arm", real=real, check=False)
    run_compiler([*need_compiler(), "-std=c99", "-O0", "-c", "arm.c", "-o", "arm.o"], folder)
    return objective


def pairs(model: pin.Model, floating: bool) -> list[tuple[Vector, Vector]]:
    """Return pairs ``(q, q_des)`` whose base rotations cover every branch of the logarithm."""
    rng = np.random.default_rng(11)

    def step(q: Vector, angle: float) -> Vector:
        v = rng.uniform(-1, 1, model.nv)
        if floating:
            v[3:6] = angle * unit(rng)
        return np.array(pin.integrate(model, q, v))

    states = []
    for angle in (0.0, 1e-12, 1e-6, 0.0499, 0.0501, 1.0, 3.0, 3.14159):
        q = step(pin.neutral(model), 2.0)
        states.append((q, step(q, angle)))
    q, q_des = states[5]
    if floating:
        other = q_des.copy()
        other[3:7] *= -1
        states.append((q, other))
    return [*states, (q, q)]


@pytest.mark.long(but=("floating base, double",))
@pytest.mark.parametrize(
    ("name", "frame", "real", "tolerance"),
    [("tilthex_arm", "ee", DOUBLE, 1e-10), ("panda", "panda_hand_tcp", FLOAT, 1e-4)],
    ids=["floating base, double", "fixed base, float"],
)
def test_cpp_computes_the_posture_acceleration(
    name: str, frame: str, real: Real, tolerance: float, tmp_path: Path
) -> None:
    objective = exported(name, frame, tmp_path, real)
    arm, rng = objective.robot, np.random.default_rng(12)
    program = eigen_program(tmp_path, arm.floating)
    n, gains = np.array([0.0, 0.0, 1.0]), np.array([20.0, 9.0, 0.3])
    states = [(q, rng.normal(size=arm.nv), q_des) for q, q_des in pairs(arm.model, arm.floating)]
    printed = accelerations(program, [(*state, n, gains) for state in states])
    assert len(printed) == len(states)
    for (q, v, q_des), line in zip(states, printed, strict=True):
        expected = gains[0] * pin.difference(arm.model, q, q_des) - gains[1] * v
        # The gradient is computed with Pinocchio, not by the export.
        expected -= gains[2] * objective.oracle.gradient_H(q)
        assert_close(np.array(line.split(), dtype=float), expected, tolerance, f"{name}, {line}")
    if arm.floating:
        broken = states[0][0].copy()
        broken[3:7] *= 1.1
        assert accelerations(program, [(broken, *states[0][1:], n, gains)]) == ["code 2"]
    if arm.floating and real is DOUBLE:
        with pytest.raises(CompilerError, match="FLOATING_BASE does not fit"):
            eigen_program(tmp_path, floating=False)


def test_cpp_leaves_out_a_gradient_that_does_not_exist(tmp_path: Path) -> None:
    (tmp_path / "arm.h").write_text(
        "#define ARM_NQ 2\n#define ARM_NV 2\ntypedef double arm_real;\n"
        "static inline int arm_eval(const double *, const double *, double *H, double *grad)\n"
        "{ *H = grad[0] = grad[1] = 0.0 / 0.0; return 3; }\n"
    )
    program = eigen_program(tmp_path, floating=False)
    state = tuple(np.array(x, dtype=float) for x in ([0.1, 0.2], [1, 2], [0.4, 0.1], [0, 0, 1], [10, 3, 5]))
    (line,) = accelerations(program, [state])
    np.testing.assert_allclose(np.array(line.split(), dtype=float), [0.0, -7.0], rtol=0, atol=1e-12)
