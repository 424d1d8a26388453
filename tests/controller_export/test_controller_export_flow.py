"""The reference flow of an exported controller moves as in Python, and rests if its solver fails."""

from __future__ import annotations

import functools
import subprocess
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.codegen.manifest_reader import read_manifest
from impact_posture.controller_export.compiled_controller import CompiledController
from impact_posture.controller_export.controller_structure import structure_of
from impact_posture.controller_export.default_formulation import default_formulation
from impact_posture.errors import InputError
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.system.arrays import Array
from impact_posture.system.libraries import library_path, load_library
from impact_posture.system.toolchain import find_compiler
from impact_posture.tsid.controller import Controller, Status
from impact_posture.tsid.flow.redundancy import Redundancy
from impact_posture.tsid.flow.reference_flow import UPDATE_TICKS
from impact_posture.tsid.flow.reference_flow_posture import ReferenceFlowPosture
from impact_posture.tsid.flow.zero_moment_point import ZeroMomentPoint
from impact_posture.tsid.point_kinematics import Point
from impact_posture.tsid.support_contact import SupportContact
from impact_posture.tsid.task_formulation import arm_formulation
from impact_posture.tsid.tasks.impact_robust import gradient_of
from tests.controller_export.test_controller_export_hostile import STRICT
from tests.support.exported_controller import KINDS, exported, impact_of
from tests.support.helpers import robot

IMPACTS = {"tilthex_arm": ("ee", (0.0, 0.0, 1.0)), "panda": ("panda_hand_tcp", (0.0, 0.0, 1.0)),
           "solo8": ("base_link", (1.0, 0.0, 0.0)),
           "talos": ("gripper_right_base_link", (-1.0, 0.0, 0.0))}  # fmt: skip
# The arm of panda turns about the line from shoulder to wrist.
ELBOW = (0.3, -0.7, 0.3, -2.3, 0.1, 1.6, 0.9, 0.035, 0.035)
# Pitch of the base of solo8, and joint angles that differ from leg to leg.
LEANING = np.array([0, 0, 0, 0, 0.05, 0, 0.3, -0.15, -0.3, 0.1, 0.15, 0.3, -0.06, 0.12])
DT = 2e-3


@functools.cache
def objective_of(name: str) -> WorstCaseObjective:
    return impact_of(robot(name), *IMPACTS[name])


def both(name: str, path: tuple[float, ...] = ()) -> tuple[Controller, ReferenceFlowPosture, CompiledController]:
    """Return the Python and C controllers after a reset, with the same gradient."""
    r, objective = robot(name), objective_of(name)
    folder = exported(name, objective, path=path)
    gradient = ImpactGradient(load_library(library_path(folder, "ctl")), read_manifest(folder / "ctl_metric.json")[0])
    formulation = default_formulation(r, KINDS[name], objective, flow=True)
    posture = formulation.posture
    assert isinstance(posture, ReferenceFlowPosture)
    posture._function, posture._path = gradient_of(gradient), [np.array(path)] if path else []
    python, c = Controller(r, formulation), CompiledController.load(folder, robot=r)
    for controller in (python, c):
        controller.reset(r.posture(), np.zeros(r.nv))
    return python, posture, c


@pytest.mark.long(but=("talos-path4-options4-300", "tilthex_arm-path0-options0-600", "solo8-path2-options2-600"))
@pytest.mark.parametrize(
    ("name", "path", "options", "ticks"),
    [
        ("tilthex_arm", (), {"duration": 0.5}, 600), ("solo8", (), {}, 300), ("solo8", (), {"tilt": 0.055}, 600),
        ("panda", ELBOW, {}, 300), ("talos", (), {}, 300),
    ],
)  # fmt: skip
def test_the_reference_moves_as_in_python(
    name: str, path: tuple[float, ...], options: dict[str, float], ticks: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each controller moves its simulated robot through all phases."""
    edges: list[int] = []

    def keep(zmp: ZeroMomentPoint, space: Redundancy, period: float, step: Array) -> Array:
        edges.append(sum(float(row @ step) > room * period for row, room in zip(zmp._rows, zmp._room, strict=True)))
        return kept(zmp, space, period, step)

    kept = ZeroMomentPoint.keep
    monkeypatch.setattr(ZeroMomentPoint, "keep", keep)
    r = robot(name)
    python, posture, c = both(name, path)
    posture.options = replace(posture.options, **options)
    for option, value in options.items():
        c.parameters[f"flow_{option}"][:] = value
    # In the default posture with a level base, the flow of solo8 does not tilt the base.
    tilt = options.get("tilt", 0.8)
    start = np.array(pin.integrate(r.model, r.posture(), LEANING)) if tilt < 0.5 else r.posture()
    for controller in (python, c):
        controller.reset(start, np.zeros(r.nv))
    states = [(start, np.zeros(r.nv)) for _ in range(2)]
    first, most = posture.value, 0.0
    for k in range(ticks):
        for phase, at in (("brace", 0), ("contact", ticks // 2), ("brace", ticks // 2 + 20), ("release", ticks - 10)):
            if k == at:
                for target in (posture, c):
                    # The second call of `brace` prepares for an impact whose time is known.
                    getattr(target, phase)(**({"t_impact": posture.settle + 0.1} if phase == "brace" and k else {}))
        for i, controller in enumerate((python, c)):
            q, v = states[i]
            command = controller.tick(k * DT, q, v)
            assert command.status is Status.SOLVED
            v = v + DT * command.acceleration
            states[i] = np.asarray(pin.integrate(r.model, q, DT * v)), v
        np.testing.assert_allclose(c.target, posture.target, rtol=0, atol=1e-9)
        if r.floating:
            most = max(most, float(np.arccos(pin.Quaternion(c.target[3:7]).matrix()[2, 2])))
        report = c.report()
        assert bool(c._report.resting) == posture.flow.resting
        assert report.level == posture.level and report.objective == pytest.approx(posture.value, rel=1e-7)
    away = np.abs(pin.difference(r.model, start, c.target)).max()
    assert away > 0.02 and c.flow_failures == 0
    # Without the tilt limit, the tilt would reach 0.0608.
    assert tilt > 0.5 or 0.0515 < most < tilt
    assert path or posture.value < 0.95 * first
    assert np.abs(posture.flow.velocity).max() < 0.02
    # For talos, the zero moment point reaches two edges of the polygon at once.  Python and C list these edges in the
    # same order.
    assert (max(edges) > 1) == (name == "talos")


def test_the_speed_limit_holds_as_in_python_where_the_tilt_bends_the_flow() -> None:
    r = robot("solo8")
    python, posture, c = both("solo8")
    limits = {"speed": 0.1, "tilt": 0.02}
    posture.options = replace(posture.options, **limits)
    for option, value in limits.items():
        c.parameters[f"flow_{option}"][:] = value
    for controller in (python, c):
        controller.reset(np.array(pin.integrate(r.model, r.posture(), LEANING)), np.zeros(r.nv))
    posture.brace()
    c.brace()
    fastest = 0.0
    for k in range(600):
        q = posture.target.copy()
        for controller in (python, c):
            controller.tick(k * DT, q, np.zeros(r.nv))
        fastest = max(fastest, float(np.abs(posture.flow._governor.flow).max()))
        np.testing.assert_allclose(c.target, posture.target, rtol=0, atol=1e-9)
    assert 0.09 < fastest <= 0.1 * (1 + 1e-9)


def test_a_failed_step_leaves_the_reference_at_rest_and_is_counted() -> None:
    r = robot("panda")
    _, _, c = both("panda", ELBOW)
    c.parameters["flow_path"][:] = 1e300
    c.reset(r.posture(), np.zeros(r.nv))
    c.brace()
    for k in range(5 * UPDATE_TICKS):
        assert c.tick(k * DT, r.posture(), np.zeros(r.nv)).status is Status.SOLVED
    assert c.flow_failures == 5
    np.testing.assert_allclose(c.target, r.posture(), atol=1e-6)


def test_a_flow_that_moves_ends_a_fade_of_the_posture() -> None:
    r = robot("panda")
    python, posture, c = both("panda", ELBOW)
    at_rest, other = np.zeros(r.nv), np.array(r.posture())
    other[0] += 0.3
    posture.brace()
    c.brace()
    for k in range(60):
        if k == 30:
            posture.move_to(other, 0.1)
            c.move_to(other, 0.1)
        commands = [controller.tick(k * DT, r.posture(), at_rest) for controller in (python, c)]
        np.testing.assert_allclose(c.target, posture.target, rtol=0, atol=1e-9)
        np.testing.assert_allclose(commands[1].u, commands[0].u, rtol=0, atol=1e-7)
    assert 1e-4 < np.abs(c.target - r.posture()).max() < 0.1


def test_a_stopped_flow_goes_on_from_a_moved_posture_as_in_python() -> None:
    r = robot("solo8")
    python, posture, c = both("solo8")
    at_rest, other = np.zeros(r.nv), np.array(r.posture())
    other[8] += 0.3
    firsts = []
    for _ in range(2):
        first = [controller.reset(r.posture(), at_rest).u for controller in (python, c)]
        np.testing.assert_allclose(first[1], first[0], rtol=0, atol=1e-7)
        firsts.append(first[1])
        for k in range(500):
            for target in (posture, c):
                if k in (0, 250, 450):
                    target.brace()
                elif k == 60:
                    target.contact()
                elif k == 200:
                    target.move_to(other, 0.2)
            commands = [controller.tick(k * DT, r.posture(), at_rest) for controller in (python, c)]
            np.testing.assert_allclose(commands[1].u, commands[0].u, rtol=0, atol=1e-6)
            if not 200 <= k < 250:
                # During a fade, Python returns the end value of the target, and C returns the start value.
                np.testing.assert_allclose(c.target, posture.target, rtol=0, atol=1e-9)
    np.testing.assert_allclose(firsts[1], firsts[0], rtol=0, atol=1e-9)


def test_a_clock_that_stands_still_moves_nothing() -> None:
    r = robot("panda")
    python, posture, c = both("panda", ELBOW)
    posture.brace()
    c.brace()
    python.tick(0.0, r.posture(), np.zeros(r.nv))
    c.tick(0.0, r.posture(), np.zeros(r.nv))
    for _ in range(12):
        for controller in (python, c):
            assert controller.tick(0.0, r.posture(), np.zeros(r.nv)).status is Status.SOLVED
        np.testing.assert_allclose(c.target, posture.target, rtol=0, atol=1e-9)


def test_invalid_times_parameters_and_tasks_are_refused() -> None:
    r = robot("panda")
    _, _, c = both("panda", ELBOW)
    at_rest: tuple[Array, Array] = (r.posture(), np.zeros(r.nv))
    with pytest.raises(InputError, match="t_impact is not finite"):
        c.brace(t_impact=float("nan"))
    for name, wrong in (("flow_share", 1.5), ("flow_speed", np.inf), ("flow_mu", 0.0), ("flow_rho", -1.0)):
        before = c.parameters[name].copy()
        c.parameters[name][:] = wrong
        with pytest.raises(InputError, match=name):
            c.reset(*at_rest)
        c.parameters[name][:] = before

    class Mine(ReferenceFlowPosture):
        pass

    with pytest.raises(InputError, match=r"'flow posture' \(Mine\) has no C code"):
        structure_of(r, arm_formulation(r, Mine(r, lambda q: (1.0, q[: r.nv]))))
    flow = ReferenceFlowPosture(r, lambda q: (1.0, q[: r.nv]))
    with pytest.raises(InputError, match="'flow posture' with contacts needs a floating base; leave out `contacts`"):
        structure_of(r, replace(arm_formulation(r, flow), contacts=(SupportContact(Point("panda_link4")),)))


# The code of solo8 contains the same parts as the code of talos, so solo8 is left out.
@pytest.mark.parametrize("name", ["tilthex_arm", "panda", "talos"])
def test_the_code_has_no_warnings(name: str) -> None:
    folder = exported(name, objective_of(name), path=ELBOW if name == "panda" else ())
    command = [*(find_compiler() or ["cc"]), "-std=c99", "-isystem", "daqp", *STRICT, "-fsyntax-only", "ctl.c"]
    run = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
