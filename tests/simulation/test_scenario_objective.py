"""Impact objective of a scenario and its gradient, interpreted and compiled."""

from __future__ import annotations

import gc
import hashlib
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.config.problem_settings import ObjectiveKind
from impact_posture.errors import MetricError
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.metric import Metric
from impact_posture.impact.supports import resolve_supports
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.simulation import scenario_objective as module
from impact_posture.simulation.controllers.controller_factory import ControllerFactory
from impact_posture.simulation.controllers.driver import RobustDriver
from impact_posture.simulation.scenario_file import read_scenario
from impact_posture.simulation.scenario_objective import compiled, interpreted, scenario_objective
from impact_posture.simulation.setup import set_up
from impact_posture.system.libraries import hash_path
from tests.simulation.factories import shared_factory
from tests.support.helpers import Vector, assert_close, rng
from tests.support.helpers import robot as known_robot
from tests.support.pinocchio_values import central_gradient, frame_jacobian, mass_matrix
from tests.support.tools import need_compiler

# Robots with fixed and floating bases, with joints of several coordinates, with and without feet.
OBJECTIVES: tuple[tuple[str, str, ObjectiveKind, bool], ...] = (
    ("tilthex_arm", "ee", "speed", False),
    ("panda", "panda_hand_tcp", "sticking", False),
    ("ur5", "tool0", "impulse", False),
    ("solo8", "base_link", "impulse", True),
    ("go2", "base", "speed", True),
    ("talos", "torso_2_link", "sticking", True),
)


def objective_of(name: str, frame: str, kind: ObjectiveKind, feet: bool) -> WorstCaseObjective:
    robot = known_robot(name)
    supports = resolve_supports(robot, None) if feet else ()
    return WorstCaseObjective(robot, ImpactContact(frame, (1.0, -0.5, 2.0)), Metric(), kind, supports)


def near(objective: WorstCaseObjective, *key: object) -> Vector:
    """Return a random posture near the default posture."""
    step = 0.1 * rng(*key).normal(size=objective.robot.nv)
    return np.array(pin.integrate(objective.robot.model, objective.robot.posture(), step))


# ---- interpreted --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("which", OBJECTIVES, ids=lambda w: f"{w[0]}-{w[2]}")
def test_the_gradient_agrees_with_the_oracle_and_finite_differences(which: Any) -> None:
    objective = objective_of(*which)
    call = interpreted(objective)
    for k in range(3):
        q = near(objective, which, k)
        value, gradient = call(q)
        gradient = np.array(gradient)
        assert value == pytest.approx(objective.value(q), rel=1e-9)
        assert_close(gradient, objective.gradient(q), 1e-7, "oracle", scale=value)
        differences = central_gradient(lambda at: call(at)[0], objective.robot.model, q, 1e-4)
        assert_close(gradient, differences, 1e-5, "finite differences", scale=value)


def test_the_value_follows_the_formula_of_the_paper() -> None:
    objective = objective_of("ur5", "tool0", "impulse", False)
    robot, q = objective.robot, near(objective, "formula")
    J, n = frame_jacobian(robot.model, q, robot.frame_id("tool0"))[:3], np.array([1, -0.5, 2]) / np.sqrt(5.25)
    a = np.linalg.solve(mass_matrix(robot.model, q), J.T @ n)
    assert interpreted(objective)(q)[0] == pytest.approx(a @ a, rel=1e-9)


def test_a_gradient_outlives_its_objective() -> None:
    objective = objective_of("panda", "panda_hand_tcp", "impulse", False)
    calls = [interpreted(objective) for _ in range(8)]
    points = [near(objective, "kept", k) for k in range(8)]
    expected = [objective.gradient(q) for q in points]
    del objective
    # Allocate new arrays, which overwrite freed memory.
    for _ in range(3):
        gc.collect()
        rubbish = [np.full(n, 7.7) for n in (1, 3, 9, 12) for _ in range(500)]
        for call, q, gradient in zip(calls, points, expected, strict=True):
            assert_close(call(q)[1], gradient, 1e-7, "after collection")
        del rubbish


def test_results_are_not_shared() -> None:
    objective = objective_of("ur5", "tool0", "impulse", False)
    first, second = interpreted(objective), interpreted(objective)
    a, b = near(objective, "a"), near(objective, "b")
    kept = first(a)[1]
    copy = np.array(kept)
    second(b)
    np.testing.assert_array_equal(kept, copy)
    first(b)
    np.testing.assert_array_equal(kept, copy)


def test_an_undefined_objective_is_an_error() -> None:
    call = interpreted(objective_of("ur5", "tool0", "impulse", False))
    with pytest.raises(MetricError, match="is undefined at this posture") as caught:
        call(np.full(6, np.nan))
    assert "\n" not in caught.value.line


# ---- objective of a scenario --------------------------------------------------------------------------------------


def test_the_contact_is_the_shape_or_the_pushed_frame() -> None:
    for name, frame, normal, feet in (
        ("aerial-vertical", "ee", (0, 0, 1), 0),
        ("aerial-lateral", "ee", (-1, 0, 0), 0),
        ("solo8-push", "base_link", (1, 0, 0), 4),
        ("talos-push", "torso_2_link", (1, 0, 0), 2),
    ):
        objective = scenario_objective(shared_factory(name).setup)
        assert (objective.contact.frame, objective.kind, len(objective.supports)) == (frame, "impulse", feet)
        np.testing.assert_allclose(objective.contact.normal, normal)


def test_the_feet_change_the_objective() -> None:
    setup = shared_factory("solo8-push").setup
    held, free = scenario_objective(setup), scenario_objective(setup, free=True)
    assert held.supports and not free.supports
    assert abs(free.value(setup.q) / held.value(setup.q) - 1) > 0.1


def test_the_contact_has_the_offset_of_the_shape() -> None:
    setup = shared_factory("aerial-vertical").setup
    scenario = setup.scenario
    moved = replace(scenario.shapes[0], offset=(0.0, 0.01, 0.02))
    moved_scenario = replace(scenario, shapes=(moved, *scenario.shapes[1:]))
    objective = scenario_objective(replace(setup, scenario=moved_scenario))
    assert objective.contact.offset == (0.0, 0.01, 0.02)
    assert objective.value(setup.q) != pytest.approx(scenario_objective(setup).value(setup.q), rel=1e-3)


# ---- compiled -----------------------------------------------------------------------------------------------------


@pytest.fixture
def builds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Return the cache folders after builds in a new cache."""
    need_compiler()
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(tmp_path / "cache"))
    folders: list[Path] = []
    write: Callable[..., Any] = module.write_export

    def counted(objectives: Any, folder: Path, **options: Any) -> Any:
        folders.append(folder)
        return write(objectives, folder, **options)

    monkeypatch.setattr(module, "write_export", counted)
    return folders


@pytest.mark.parametrize("which", [OBJECTIVES[0], OBJECTIVES[3]], ids=lambda w: f"{w[0]}-{w[2]}")
def test_compiled_equals_interpreted_and_is_built_once(which: Any, builds: list[Path]) -> None:
    objective = objective_of(*which)
    fast, slow = compiled(objective), interpreted(objective)
    for k in range(5):
        q = near(objective, which, "compiled", k)
        (value, gradient), (expected, slope) = fast(q), slow(q)
        assert value == pytest.approx(expected, rel=1e-9)
        assert_close(gradient, slope, 1e-9, "gradient", scale=expected)
    again = compiled(objective_of(*which))
    assert len(builds) == 1
    assert again(q)[0] == fast(q)[0]


def test_another_robot_or_normal_is_built_separately(builds: list[Path]) -> None:
    scenario = read_scenario("aerial-vertical")
    heavier = replace(scenario, armature={"elbow_pitch": 0.05})
    first, other = scenario_objective(shared_factory("aerial-vertical").setup), scenario_objective(set_up(heavier))
    turned = replace(first, contact=ImpactContact("ee", (0.0, 0.1, 1.0)))
    q = first.robot.posture()
    for objective in (first, other, turned):
        assert compiled(objective)(q)[0] == pytest.approx(objective.value(q), rel=1e-9)
    assert len({folder.name for folder in builds}) == 3


def test_a_damaged_build_is_repeated(builds: list[Path]) -> None:
    objective = objective_of("ur5", "tool0", "impulse", False)
    compiled(objective)
    library = builds[0] / "libimpact.so"
    # This process has mapped the library, so the damaged library must be a new file.
    library.write_bytes(library.rename(builds[0].parents[1] / "mapped.so").read_bytes()[:5000])
    (builds[0] / "impact.c").write_text("half")
    q = near(objective, "again")
    assert compiled(objective)(q)[0] == pytest.approx(objective.value(q), rel=1e-9)
    assert len(builds) == 2


@pytest.mark.parametrize("fault", ["no compiler", "no cache", "failing compiler", "foreign library"])
def test_a_gradient_that_cannot_be_compiled_is_interpreted(
    fault: str, builds: list[Path], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The user gets one warning, and the numbers equal the numbers of the compiled gradient."""
    setup = shared_factory("aerial-vertical").setup
    if fault == "no compiler":
        monkeypatch.setenv("PATH", str(tmp_path))
        monkeypatch.delenv("CC", raising=False)
    elif fault == "no cache":
        (tmp_path / "file").touch()
        monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(tmp_path / "file"))
    elif fault == "failing compiler":
        monkeypatch.setenv("CC", "false")
    else:
        write: Callable[..., Any] = module.write_export

        def elsewhere(objectives: Any, folder: Path, **options: Any) -> Any:
            """Make builds return a library of another machine: the library is complete, but cannot be loaded."""
            written = write(objectives, folder, **options)
            written.library.unlink()
            written.library.write_text("of another machine")
            hash_path(written.library).write_text(hashlib.sha256(written.library.read_bytes()).hexdigest())
            return written

        monkeypatch.setattr(module, "write_export", elsewhere)
    factory = ControllerFactory(setup)
    expected = interpreted(factory.objective())
    driver = factory.driver("robust")
    assert isinstance(driver, RobustDriver) and len(factory.warnings) == 1
    assert "the gradient is interpreted, not compiled, which is slower: " in factory.warnings[0]
    assert "\n" not in factory.warnings[0]
    for k in range(3):
        q = near(factory.objective(), fault, k)
        value, gradient = factory.gradient()(q)
        np.testing.assert_array_equal(np.r_[value, gradient], np.r_[expected(q)[0], expected(q)[1]])
    factory.driver("robust")
    assert len(factory.warnings) == 1
    factory.driver("nominal")
    assert not factory.warnings


def test_two_processes_build_once(tmp_path: Path) -> None:
    need_compiler()
    program = (
        "import sys; from impact_posture.robot.robot_loader import load_robot\n"
        "from impact_posture.impact.impact_contact import ImpactContact\n"
        "from impact_posture.impact.metric import Metric\n"
        "from impact_posture.impact.worst_case_objective import WorstCaseObjective\n"
        "from impact_posture.simulation import scenario_objective\n"
        "write = scenario_objective.write_export\n"
        "def counted(*a, **k):\n    print('built'); return write(*a, **k)\n"
        "scenario_objective.write_export = counted\n"
        "o = WorstCaseObjective(load_robot('ur5'), ImpactContact('tool0', (0, 0, 1)), Metric(), 'impulse', ())\n"
        "print(repr(scenario_objective.compiled(o)(o.robot.posture())[0]))\n"
    )
    environment = {**os.environ, "IMPACT_POSTURE_CACHE": str(tmp_path)}
    started = [
        subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, env=environment, text=True)
        for _ in range(2)
    ]
    outputs = [process.communicate(timeout=120)[0].split() for process in started]
    assert [process.returncode for process in started] == [0, 0]
    assert sorted(len(words) for words in outputs) == [1, 2]
    assert outputs[0][-1] == outputs[1][-1]
