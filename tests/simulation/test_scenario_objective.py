"""The objective of a scenario's impact and its gradient: interpreted, compiled, and against independent numbers."""

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

from impact_posture.config.settings import ObjectiveKind
from impact_posture.errors import CompilerError, MetricError, OutputError
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
from tests.simulation.factories import factory, needs_mujoco
from tests.support.helpers import Vector, assert_close, central_gradient, frame_jacobian, mass_matrix, rng, robot
from tests.support.tools import need_compiler

# Fixed and floating bases, joints of several numbers, with feet and without.
OBJECTIVES: tuple[tuple[str, str, ObjectiveKind, bool], ...] = (
    ("tilthex_arm", "ee", "impulse", False),
    ("tilthex_arm", "ee", "speed", False),
    ("panda", "panda_hand_tcp", "sticking", False),
    ("ur5", "tool0", "impulse", False),
    ("solo8", "base_link", "impulse", True),
    ("go2", "base", "speed", True),
    ("talos", "torso_2_link", "sticking", True),
)


def objective_of(name: str, frame: str, kind: ObjectiveKind, feet: bool) -> WorstCaseObjective:
    found = robot(name)
    supports = resolve_supports(found, None) if feet else ()
    return WorstCaseObjective(found, ImpactContact(frame, (1.0, -0.5, 2.0)), Metric(), kind, supports)


def near(objective: WorstCaseObjective, *key: object) -> Vector:
    """A posture near the robot's own."""
    step = 0.1 * rng(*key).normal(size=objective.robot.nv)
    return np.array(pin.integrate(objective.robot.model, objective.robot.posture(), step))


# ---- interpreted --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("which", OBJECTIVES, ids=lambda w: f"{w[0]}-{w[2]}")
def test_the_gradient_is_the_oracles_and_that_of_finite_differences(which: Any) -> None:
    objective = objective_of(*which)
    call = interpreted(objective)
    for k in range(3):
        q = near(objective, which, k)
        value, gradient = call(q)
        gradient = np.array(gradient)
        assert value == pytest.approx(objective.value(q), rel=1e-9)
        assert_close(gradient, objective.gradient(q), 1e-7, "oracle", scale=value)
        apart = central_gradient(lambda at: call(at)[0], objective.robot.model, q, 1e-4)
        assert_close(gradient, apart, 1e-5, "finite differences", scale=value)


def test_the_value_is_the_papers_formula() -> None:
    objective = objective_of("ur5", "tool0", "impulse", False)
    found, q = objective.robot, near(objective, "formula")
    J, n = frame_jacobian(found.model, q, found.frame_id("tool0"))[:3], np.array([1, -0.5, 2]) / np.sqrt(5.25)
    a = np.linalg.solve(mass_matrix(found.model, q), J.T @ n)
    assert interpreted(objective)(q)[0] == pytest.approx(a @ a, rel=1e-9)


def test_a_gradient_outlives_its_objective() -> None:
    objective = objective_of("panda", "panda_hand_tcp", "impulse", False)
    calls = [interpreted(objective) for _ in range(8)]
    points = [near(objective, "kept", k) for k in range(8)]
    expected = [objective.gradient(q) for q in points]
    del objective
    # Whatever was freed is written over by these.
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


def test_where_the_objective_does_not_exist_it_says_so() -> None:
    call = interpreted(objective_of("ur5", "tool0", "impulse", False))
    with pytest.raises(MetricError, match="does not exist there") as caught:
        call(np.full(6, np.nan))
    assert "\n" not in caught.value.line


# ---- of a scenario ------------------------------------------------------------------------------------------------


def test_the_impact_is_the_shapes_or_the_pushs() -> None:
    needs_mujoco()
    for name, frame, normal, feet in (
        ("aerial-vertical", "ee", (0, 0, 1), 0),
        ("aerial-lateral", "ee", (-1, 0, 0), 0),
        ("solo8-push", "base_link", (1, 0, 0), 4),
        ("talos-push", "torso_2_link", (1, 0, 0), 2),
    ):
        found = scenario_objective(factory(name).setup)
        assert (found.contact.frame, found.kind, len(found.supports)) == (frame, "impulse", feet)
        np.testing.assert_allclose(found.contact.normal, normal)


def test_without_the_feet_the_objective_is_another() -> None:
    needs_mujoco()
    setup = factory("solo8-push").setup
    held, free = scenario_objective(setup), scenario_objective(setup, free=True)
    assert held.supports and not free.supports
    assert abs(free.value(setup.q) / held.value(setup.q) - 1) > 0.1


def test_the_shapes_offset_is_the_contacts() -> None:
    needs_mujoco()
    setup = factory("aerial-vertical").setup
    scenario = setup.scenario
    moved = replace(scenario.shapes[0], offset=(0.0, 0.01, 0.02))
    moved_scenario = replace(scenario, shapes=(moved, *scenario.shapes[1:]))
    found = scenario_objective(replace(setup, scenario=moved_scenario))
    assert found.contact.offset == (0.0, 0.01, 0.02)
    assert found.value(setup.q) != pytest.approx(scenario_objective(setup).value(setup.q), rel=1e-3)


# ---- compiled -----------------------------------------------------------------------------------------------------


@pytest.fixture
def builds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """A cache folder of one's own, and what is built in it."""
    need_compiler()
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(tmp_path / "cache"))
    made: list[Path] = []
    write: Callable[..., Any] = module.write_export

    def counted(objectives: Any, folder: Path, **options: Any) -> Any:
        made.append(folder)
        return write(objectives, folder, **options)

    monkeypatch.setattr(module, "write_export", counted)
    return made


@pytest.mark.parametrize("which", [OBJECTIVES[1], OBJECTIVES[4]], ids=lambda w: f"{w[0]}-{w[2]}")
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


def test_a_changed_robot_normal_or_objective_is_built_anew(builds: list[Path]) -> None:
    needs_mujoco()
    scenario = read_scenario("aerial-vertical")
    heavier = replace(scenario, armature={"elbow_pitch": 0.05})
    first, other = scenario_objective(factory("aerial-vertical").setup), scenario_objective(set_up(heavier))
    turned = replace(first, contact=ImpactContact("ee", (0.0, 0.1, 1.0)))
    q = first.robot.posture()
    for objective in (first, other, turned):
        assert compiled(objective)(q)[0] == pytest.approx(objective.value(q), rel=1e-9)
    assert len({folder.name for folder in builds}) == 3


def test_a_damaged_build_is_done_again(builds: list[Path]) -> None:
    objective = objective_of("ur5", "tool0", "impulse", False)
    compiled(objective)
    library = builds[0] / "libimpact.so"
    # Mapped in this process: another file takes its name.
    library.write_bytes(library.rename(builds[0].parents[1] / "mapped.so").read_bytes()[:5000])
    (builds[0] / "impact.c").write_text("half")
    q = near(objective, "again")
    assert compiled(objective)(q)[0] == pytest.approx(objective.value(q), rel=1e-9)
    assert len(builds) == 2


@pytest.mark.parametrize("fault", ["no compiler", "no cache", "failing compiler", "foreign library"])
def test_what_cannot_be_compiled_or_loaded_is_interpreted(
    fault: str, builds: list[Path], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """With one warning, however often the gradient is asked for; the numbers are the same."""
    needs_mujoco()
    setup = factory("aerial-vertical").setup
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
            """Another machine that shares the folder builds it: the library is whole, but of no use here."""
            written = write(objectives, folder, **options)
            written.library.unlink()
            written.library.write_text("of another machine")
            hash_path(written.library).write_text(hashlib.sha256(written.library.read_bytes()).hexdigest())
            return written

        monkeypatch.setattr(module, "write_export", elsewhere)
    made = ControllerFactory(setup)
    expected = interpreted(made.objective())
    driver = made.driver("robust")
    assert isinstance(driver, RobustDriver) and len(made.warnings) == 1
    assert "the gradient is interpreted, not compiled, which is slower: " in made.warnings[0]
    assert "\n" not in made.warnings[0]
    for k in range(3):
        q = near(made.objective(), fault, k)
        value, gradient = made.gradient()(q)
        np.testing.assert_array_equal(np.r_[value, gradient], np.r_[expected(q)[0], expected(q)[1]])
    made.driver("robust")
    assert len(made.warnings) == 1
    made.driver("nominal")
    assert not made.warnings


def test_a_cache_that_cannot_be_written_is_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    need_compiler()
    (tmp_path / "file").touch()
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(tmp_path / "file"))
    with pytest.raises(OutputError, match="cannot be written") as caught:
        compiled(objective_of("ur5", "tool0", "impulse", False))
    assert "\n" not in caught.value.line and "IMPACT_POSTURE_CACHE" in caught.value.line


def test_a_compiler_that_fails_is_an_error_and_leaves_nothing(
    builds: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    objective = objective_of("ur5", "tool0", "impulse", False)
    monkeypatch.setenv("CC", "false")
    with pytest.raises(CompilerError):
        compiled(objective)
    monkeypatch.delenv("CC")
    q = near(objective, "after")
    assert compiled(objective)(q)[0] == pytest.approx(objective.value(q), rel=1e-9)


def test_two_processes_that_build_at_once_do_it_once(tmp_path: Path) -> None:
    need_compiler()
    program = (
        "import sys; from impact_posture.robot.robot_loader import load_robot\n"
        "from impact_posture.impact.impact_contact import ImpactContact\n"
        "from impact_posture.impact.metric import Metric\n"
        "from impact_posture.impact.worst_case_objective import WorstCaseObjective\n"
        "from impact_posture.simulation import scenario_objective\n"
        "write = scenario_objective.write_export\n"
        "def told(*a, **k):\n    print('built'); return write(*a, **k)\n"
        "scenario_objective.write_export = told\n"
        "o = WorstCaseObjective(load_robot('ur5'), ImpactContact('tool0', (0, 0, 1)), Metric(), 'impulse', ())\n"
        "print(repr(scenario_objective.compiled(o)(o.robot.posture())[0]))\n"
    )
    environment = {**os.environ, "IMPACT_POSTURE_CACHE": str(tmp_path)}
    started = [
        subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, env=environment, text=True)
        for _ in range(2)
    ]
    said = [process.communicate(timeout=120)[0].split() for process in started]
    assert [process.returncode for process in started] == [0, 0]
    assert sorted(len(words) for words in said) == [1, 2]
    assert said[0][-1] == said[1][-1]
