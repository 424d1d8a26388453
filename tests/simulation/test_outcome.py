"""Outcome of runs: limits on synthetic series, robots that fall, and unsupported robots."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.errors import SpecError
from impact_posture.simulation.metrics import measure
from impact_posture.simulation.outcome import Event, doubts, judge, links_behind
from impact_posture.simulation.recorder import STATUSES
from impact_posture.simulation.run import Run
from impact_posture.simulation.scenario_file import Bounds, read_scenario
from impact_posture.simulation.series import Window
from impact_posture.simulation.setup import Setup, set_up
from impact_posture.system.optional_package import import_mujoco
from impact_posture.tsid.controller import Status
from tests.simulation.factories import SHIPPED, by_hand, controller_factory, driven, shared_setup, shortened

RELAXED, HELD = STATUSES.index(Status.RELAXED), STATUSES.index(Status.INFEASIBLE)
HEXTILT = Path(__file__).parent / "hextilt.toml"


def judged(setup: Setup, columns: dict[str, Any], **run: Any) -> tuple[Event, ...]:
    windows = run.pop("windows", (Window("impact", 0, 0.2, 0.5, True),))
    return judge(setup, Run(by_hand(setup, 1000, **columns), windows, **run))


def turned(setup: Setup, axis: tuple[float, float, float], degrees: float) -> np.ndarray[Any, Any]:
    """Return postures in which the base is rotated about an axis of the world from tick 400 on."""
    q = np.tile(setup.q, (1000, 1))
    turn = pin.AngleAxis(np.radians(degrees), np.array(axis)).matrix() @ pin.Quaternion(setup.q[3:7]).matrix()
    q[400:, 3:7] = pin.Quaternion(turn).coeffs()
    return q


@pytest.mark.parametrize("name", SHIPPED)
def test_a_robot_at_rest_completes(name: str) -> None:
    assert judged(shared_setup(name), {}) == ()


@pytest.mark.parametrize("name", SHIPPED)
def test_tilt_is_measured_from_the_start_without_yaw(name: str) -> None:
    setup = shared_setup(name)
    assert judged(setup, {"q": turned(setup, (0, 0, 1), 170)}) == ()
    assert judged(setup, {"q": turned(setup, (1, 0, 0), 59)}) == ()
    (event,) = judged(setup, {"q": turned(setup, (0, 1, 0), -61)})
    assert event.status == "fell" and "tilted beyond 60°" in event.what and event.time == pytest.approx(0.401)


def test_links_without_shapes_behind_a_surface_are_a_warning() -> None:
    setup = shared_setup("aerial-vertical")
    surface = setup.scenario.surfaces[0].name
    n, point = setup.world.built.normals[surface], setup.world.built.points[surface]
    data = setup.robot.model.createData()
    pin.forwardKinematics(setup.robot.model, data, setup.q)
    elbow = n @ (data.oMi[setup.robot.joint_id("elbow_pitch")].translation - point)
    for depth, reported in ((0.01, False), (0.05, True)):
        q = np.tile(setup.q, (1000, 1))
        q[600:700, :3] -= (elbow + depth) * n
        # Move the elbow behind the surface.  The surface stops the shape at the elbow, and the joints above the elbow
        # are still in front of the surface.
        assert links_behind(setup, [Run(by_hand(setup, 1000, q=q), ())]) == ()
        q[600:700, :3] = setup.q[:3] - ((setup.q[:3] - point) @ n + depth) * n
        warnings = links_behind(setup, [Run(by_hand(setup, 1000, q=q), ())])
        assert bool(warnings) and f"the surface '{surface}'" in warnings[0] and "shoulder" in warnings[0]
        assert ("root_joint" in warnings[0]) is reported
    assert links_behind(setup, [Run(by_hand(setup, 1000), ())]) == ()


@pytest.mark.parametrize("name", SHIPPED)
def test_a_base_below_the_surface_or_its_start_fell(name: str) -> None:
    setup = shared_setup(name)
    surface = setup.scenario.surfaces[0].name
    n, point = setup.world.built.normals[surface], setup.world.built.points[surface]
    q = np.tile(setup.q, (1000, 1))
    q[600:, :3] -= ((setup.q[:3] - point) @ n + 1e-3) * n
    events = judged(setup, {"q": q})
    assert f"went into the surface '{surface}'" in "; ".join(e.what for e in events)
    assert {e.status for e in events} == {"fell"} and events[0].time == pytest.approx(0.601)
    q = np.tile(setup.q, (1000, 1))
    q[700:, 2] -= 1.001
    events = judged(setup, {"q": q})
    assert "sank by more than 1 m" in "; ".join(e.what for e in events)
    # The base may sink if the reference moves the arm down.
    if n[2] == 1 and "aerial" in name:
        reference = np.where(np.arange(1000) < 700, 0.0, 0.5)
        assert "sank" not in "; ".join(e.what for e in judged(setup, {"q": q, "reference": reference}))


@pytest.mark.parametrize(
    ("status", "begin", "length", "words"),
    [
        (RELAXED, 100, 500, None),
        (RELAXED, 100, 501, "50 % of all ticks"),
        (HELD, 300, 50, None),
        (HELD, 300, 51, "the controller had no command for 0.051 s"),
    ],
)
def test_relaxed_and_held_ticks(status: int, begin: int, length: int, words: str | None) -> None:
    column = np.zeros(1000, int)
    column[begin : begin + length] = status
    for name in ("aerial-lateral", "solo8-push"):
        events = judged(shared_setup(name), {"status": column})
        if words is None:
            assert events == ()
        else:
            assert [e.status for e in events] == ["control lost"] and words in events[0].what
            assert events[0].time == pytest.approx(1e-3 * (begin + 1))


def test_lifted_feet_and_missed_contacts() -> None:
    setup = shared_setup("solo8-push")
    feet = np.ones((1000, 4), bool)
    feet[200:300, 1] = False
    assert judged(setup, {"feet": feet}) == ()
    feet[200:301, 1], feet[400:900, 2] = False, False
    (event,) = judged(setup, {"feet": feet})
    assert event.status == "lost contact" and event.what == "FR_FOOT left the ground for 0.101 s"
    windows = [Window("impact", k, 0.1 + 0.2 * k, 0.2 + 0.2 * k, k != 2) for k in range(4)]
    (event,) = judged(shared_setup("aerial-vertical"), {}, windows=tuple(windows))
    assert event.status == "lost contact" and event.what.startswith("1 of 4 contacts") and event.time == 0.5


def test_the_scenario_sets_the_bounds() -> None:
    setup = shared_setup("solo8-push")
    feet, status = np.ones((1000, 4), bool), np.zeros(1000, int)
    feet[200:400, 1], status[500:600] = False, HELD
    columns = {"feet": feet, "status": status, "q": turned(setup, (0, 1, 0), 70)}
    assert {e.status for e in judged(setup, columns)} == {"lost contact", "control lost", "fell"}
    wide = replace(setup.scenario, bounds=Bounds(tilt_deg=80, lifted=0.3, held=0.2))
    assert judged(replace(setup, scenario=wide), columns) == ()


# ---- simulated runs -----------------------------------------------------------------------------------------------


def test_a_strongly_pushed_robot_fell() -> None:
    factory = controller_factory(shortened("solo8-push", 2, force=(60.0, 0.0, 0.0), after=0.5))
    record = driven(factory, "nominal")
    events = judge(factory.setup, record)
    assert "fell" in {e.status for e in events}
    assert all(record.waited < e.time <= record.series.t[-1] for e in events)


def test_a_run_ends_when_the_state_diverges(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("aerial-lateral", "solo8-push"):
        factory = controller_factory(shortened(name, 2))
        world, step = factory.setup.world, factory.setup.world.step

        def away(command: Any, count: int = 1, world: Any = world, step: Any = step) -> None:
            if world.time > 0.05:
                world._data.qvel[0] = 1e9
            step(command, count)

        monkeypatch.setattr(world, "step", away)
        record = driven(factory, "nominal")
        assert record.away is not None and 0.05 < record.away < 0.06 and record.series.t[-1] < record.away
        assert ("control lost", record.away) in [(e.status, e.time) for e in judge(factory.setup, record)]
        assert measure(factory.setup, record).contacts == 0


@pytest.mark.long(but=("robust",))
@pytest.mark.parametrize("controller", ["nominal", "robust"])
def test_a_hextilt_flies_and_touches_the_floor(controller: str) -> None:
    factory = controller_factory(set_up(read_scenario(HEXTILT)))
    record = driven(factory, controller)
    assert judge(factory.setup, record) == ()
    metrics = measure(factory.setup, record)
    assert metrics.contacts == 1 and metrics.failed_ticks == 0 and 0 < metrics.q_total_impact < 2
    assert np.abs(record.series.q[:, :3] - factory.setup.q[:3]).max() < 0.2


# ---- unsupported robots -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("robot", "frame", "config", "words"),
    [
        ("borinot", "flying_arm_2__ee", None, "push and turn its base in 4 of 6 directions"),
        ("hextilt", "flying_arm_5__gripper", "", r"no rotors and its data names no feet; add \[propulsion\]"),
        ("solo8", "FL_FOOT", None, r"no \[control.footing\]; add \[control.footing\]"),
    ],
)
def test_a_robot_that_would_fall_is_refused(
    tmp_path: Path, robot: str, frame: str, config: str | None, words: str
) -> None:
    text = HEXTILT.read_text(encoding="utf-8").replace('"hextilt"', f'"{robot}"')
    text = text.replace("flying_arm_5__gripper", frame)
    if config is not None:
        text = text.replace('armature = "none"', 'armature = "none"\nconfig = "bare.toml"')
        (tmp_path / "bare.toml").write_text(
            'name = "bare"\n[model]\nroot = "free-flyer"\n'
            'urdf = "example-robot-data:hextilt_description/urdf/hextilt_flying_arm_5.urdf"\n',
            encoding="utf-8",
        )
    path = tmp_path / "falls.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SpecError, match=words) as caught:
        set_up(read_scenario(path))
    assert "\n" not in caught.value.line and str(path) in caught.value.line


def test_rotors_that_touch_a_surface_and_limits_in_a_window_are_warnings() -> None:
    """A wall 5 cm before the rotors: the arm is held back, so the base runs into the wall."""
    setup = set_up(read_scenario("aerial-lateral"))
    run_ = driven(controller_factory(shortened("aerial-lateral", 2, settle=0.2)), "nominal")
    assert not [line for line in doubts(setup, [run_], [measure(setup, run_)], 1.0) if "touched" in line]
    forward = replace(run_.series, q=run_.series.q + 0.4 * np.eye(setup.robot.nq)[0])
    moved = replace(run_, series=forward)
    (line,) = (line for line in doubts(setup, [moved], [measure(setup, moved)], 1.0) if "touched" in line)
    assert line.startswith("base_link or a rotor on it touched the surface 'wall' at t = ")
    (fit,) = (line for line in doubts(setup, [run_], [measure(setup, run_)], 1.6) if "predicted" in line)
    assert fit.startswith("the measured jump is 1.6 times the predicted jump")
    assert not [line for line in doubts(setup, [run_], [measure(setup, run_)], 1.4) if "predicted" in line]


def test_the_wall_stops_the_rotors() -> None:
    """Contact pairs of the rotor link: none at the start, some if the base is moved into the wall."""
    setup = set_up(read_scenario("aerial-lateral"))
    mujoco, model = import_mujoco(), setup.world.built.mjcf.compile()
    data, layout = mujoco.MjData(model), setup.world.built.mjcf.layout
    for shift, touches in ((0.0, False), (0.4, True)):
        q = setup.q.copy()
        q[0] += shift
        data.qpos[:] = layout.qpos(q)
        mujoco.mj_forward(model, data)
        names = {model.geom(contact.geom1).name + model.geom(contact.geom2).name for contact in data.contact}
        assert any("rotor link" in name for name in names) is touches
