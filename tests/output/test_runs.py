"""Figures of simulated runs, from short synthetic runs of real robots."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from impact_posture.errors import InputError
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.output.plot import (
    FORMATS,
    Bar,
    RunView,
    bars_figure,
    figures_of_comparison,
    figures_of_run,
    save,
    save_all,
)
from impact_posture.output.plot.run_axes import AT_LIMIT, LIMIT, STOP
from impact_posture.output.plot.run_figures import (
    comparison_figure,
    controls_comparison_figure,
    controls_figure,
    joints_figure,
    metric_figure,
)
from impact_posture.output.plot.run_panels import SHOWN
from impact_posture.output.plot.skeleton import build_skeleton
from impact_posture.output.plot.snapshots_figure import instants, snapshots_figure
from impact_posture.output.plot.style import SHADES, framed
from impact_posture.robot.robot_loader import load_robot
from impact_posture.simulation.series import Window
from tests.output.page import check_page
from tests.output.views import PENDULUM, text_of

TICKS = 400


def make_run(name: str, *, push: bool = False) -> RunView:
    """A robot that oscillates about its posture for 4 s, with impacts at 1 s and 2.5 s, or a push at 1 s."""
    robot = load_robot(name)
    t = np.arange(1, TICKS + 1) * 0.01
    base = robot.first_joint
    swings = np.outer(np.sin(2 * t), 0.05 * np.random.default_rng(5).uniform(0.2, 1.0, robot.nv))
    q = np.array([pin.integrate(robot.model, robot.posture(), swing) for swing in swings])
    rotors = 0 if robot.spec.propulsion is None else len(robot.spec.propulsion.rotors)
    hits = (1.0,) if push else (1.0, 2.5)
    windows = [Window("impact", k, at, at + 0.3, True) for k, at in enumerate(hits)]
    windows += [] if push else [Window("dwell", k, at, at + 0.8, True) for k, at in enumerate(hits)]
    force = np.zeros((TICKS, 3))
    inside = np.any([(t > at) & (t <= at + 0.3) for at in hits], axis=0)
    force[inside] = (6.0, 0.0, 0.0)
    contact = ImpactContact(robot.spec.contact.frame or robot.frame_names[-1], (1, 0, 0))
    return RunView(
        "made-up", "nominal", robot, contact, t, q, np.gradient(swings, t, axis=0),
        torque=0.5 * np.outer(np.sin(3 * t), np.ones(robot.nv - base)),
        rotor_command=np.full((TICKS, rotors), 60.0),
        rotor_speed=np.full((TICKS, rotors), 59.0),
        force=force,
        peak=np.linalg.norm(force, axis=1),
        objective=np.where(np.arange(TICKS) % 10 == 0, 3.0 + np.cos(t), np.nan),
        level=np.zeros(TICKS),
        at_stop=np.zeros((TICKS, robot.nv), dtype=bool),
        windows=tuple(windows),
        surface=None if push else np.array([-0.5, 0.0, 0.0]),
        supports=robot.spec.supports,
    )  # fmt: skip


@pytest.fixture(scope="module")
def flying() -> RunView:
    return make_run("tilthex_arm")


@pytest.fixture(scope="module")
def pushed() -> RunView:
    return make_run("solo8", push=True)


@pytest.fixture(scope="module")
def fixed() -> RunView:
    return make_run(PENDULUM)


@pytest.fixture(scope="module")
def humanoid() -> RunView:
    return make_run("talos", push=True)


def panels(figure: Figure) -> list[Axes]:
    return [axes for axes in figure.axes if axes.axison and axes.get_visible()]


def curves(axes: Axes) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the labeled lines of a panel."""
    named = [line for line in axes.lines if not str(line.get_label()).startswith("_")]
    return {str(line.get_label()): (np.asarray(line.get_xdata()), np.asarray(line.get_ydata())) for line in named}


def shaded(axes: Axes, kind: str) -> np.ndarray:
    """Return begin and end of each shaded interval, sorted."""
    spans: list[Any] = [p for p in axes.patches if to_hex(p.get_facecolor()) == SHADES[kind]["facecolor"]]
    return np.array(sorted((p.get_x(), p.get_x() + p.get_width()) for p in spans))


def limits(axes: Axes) -> list[float]:
    """Return the y values of the dashed lines."""
    lines = [
        line for line in axes.lines if line.get_linestyle() == "--" and line.get_linewidth() == LIMIT["linewidth"]
    ]
    return sorted(float(np.asarray(line.get_ydata())[0]) for line in lines)


def test_windows_are_shaded_when_they_are(flying: RunView) -> None:
    whole, first = panels(metric_figure(flying))[:2]
    np.testing.assert_allclose(shaded(whole, "impact"), [(1.0, 1.3), (2.5, 2.8)])
    np.testing.assert_allclose(shaded(whole, "dwell"), [(1.0, 1.8), (2.5, 3.3)])
    # The right panel shows milliseconds since the first touch.
    np.testing.assert_allclose(shaded(first, "impact"), [(0.0, 300.0)], atol=1e-9)
    np.testing.assert_allclose(first.get_xlim(), (-60.0, 405.0))
    assert "ms" in panels(metric_figure(flying))[-1].get_xlabel()


def test_metric_shows_H_speed_and_force(flying: RunView) -> None:
    H, _, speed, _, force, _ = panels(metric_figure(flying))
    known = np.isfinite(flying.objective)
    np.testing.assert_array_equal(H.lines[0].get_xdata(), flying.t[known])
    np.testing.assert_array_equal(H.lines[0].get_ydata(), flying.objective[known])
    np.testing.assert_allclose(speed.lines[0].get_ydata(), np.linalg.norm(flying.v, axis=1))
    np.testing.assert_allclose(curves(force)["force: normal, peak"][1], flying.peak)
    np.testing.assert_allclose(curves(force)["force: friction"][1], 0.0, atol=1e-12)
    assert H.get_yscale() == "linear" and H.get_ylim()[0] == 0.0
    names = ["H  [‖Δν‖²/(N·s)²]", "‖ν‖  [m/s, rad/s]", "force  [N]"]
    assert [axes.get_ylabel() for axes in (H, speed, force)] == names
    ramped = dataclasses.replace(flying, level=np.linspace(0, 1, TICKS))
    assert "activation of the term" in text_of(metric_figure(ramped))


def test_H_over_more_than_a_decade_gets_a_log_axis(flying: RunView) -> None:
    fallen = dataclasses.replace(flying, objective=np.geomspace(40, 2, TICKS))
    assert [axes.get_yscale() for axes in panels(metric_figure(fallen))[:3]] == ["log", "log", "linear"]
    assert panels(comparison_figure([flying, fallen]))[0].get_yscale() == "log"


def test_controls_show_rotors_torques_limits_and_saturation(flying: RunView) -> None:
    propulsion = flying.robot.spec.propulsion
    assert propulsion is not None
    command = flying.rotor_command.copy()
    command[120, 2] = propulsion.speed_max
    torque = np.outer(np.sin(flying.t), flying.torque_limits)
    figure = controls_figure(dataclasses.replace(flying, rotor_command=command, torque=torque))
    rotors, _, joints, _ = panels(figure)
    # Rotor speeds are relative to the largest speed, because a robot.toml does not define the unit.
    assert limits(rotors) == [propulsion.speed_min / propulsion.speed_max, 1.0]
    share = flying.rotor_speed[:, 0] / propulsion.speed_max
    np.testing.assert_allclose(curves(rotors)["rotor 1"][1], share)
    # Noisy curves are drawn thin and without dashes.
    lines = [line for line in rotors.lines if line.get_label()[:5] == "rotor"]
    assert {(line.get_linestyle(), line.get_linewidth()) for line in lines} == {("-", 0.7)}
    assert limits(joints) == [-1.0, 1.0] and joints.get_ylabel() == "torque / limit  [1]"
    assert set(curves(rotors)) == {f"rotor {k}" for k in range(1, 7)}
    assert rotors.get_ylabel() == "rotor speed / highest  [1]"
    for k, name in enumerate(flying.joint_names):
        np.testing.assert_allclose(curves(joints)[name][1], torque[:, k] / flying.torque_limits[k])
    marks = [line for line in rotors.lines if line.get_marker() == AT_LIMIT["marker"]]
    assert [list(line.get_xdata()) for line in marks] == [[], [flying.t[120]]]
    assert "command at a limit" in text_of(figure)
    assert "command at a limit" not in text_of(controls_figure(flying))


def test_one_limit_for_all_is_drawn_in_newton_meters(pushed: RunView) -> None:
    near = dataclasses.replace(pushed, torque=pushed.torque * 2)
    axes = panels(controls_figure(near))[0]
    assert limits(axes) == [-2.7, 2.7] and axes.get_ylabel() == "joint torque  [N·m]"
    far = controls_figure(dataclasses.replace(pushed, torque=pushed.torque / 100))
    assert limits(panels(far)[0]) == [] and "limits (±2.7 N·m) lie outside" in text_of(far)


def test_of_many_joints_those_that_move_most_are_shown(humanoid: RunView) -> None:
    assert humanoid.positions.shape == (TICKS, 32)
    figure = joints_figure([humanoid])
    moved = np.ptp(humanoid.positions, axis=0)
    expected = {humanoid.joint_names[k] for k in np.argsort(-moved)[:SHOWN]}
    drawn = curves(panels(figure)[0])
    assert set(drawn) == expected and len(drawn) == SHOWN
    assert f"{SHOWN} of 32 joints that move most" in text_of(figure)
    name = sorted(expected)[0]
    model = humanoid.robot.model
    np.testing.assert_array_equal(drawn[name][1], humanoid.q[:, model.joints[model.getJointId(name)].idx_q])
    assert f"{SHOWN} of 32 joints that come closest" in text_of(controls_figure(humanoid))


def test_endless_joints_are_unwrapped_and_stops_are_marked() -> None:
    turns, run = np.linspace(0.0, 9.0, TICKS), make_run("kinova")
    model = run.robot.model
    endless = next(i for i in range(1, model.njoints) if model.nqs[i] == 2)
    at, entry = int(model.idx_qs[endless]), int(model.idx_vs[endless])
    q = run.q.copy()
    q[:, at], q[:, at + 1] = np.cos(turns), np.sin(turns)
    stop = run.at_stop.copy()
    stop[100:200, entry] = True
    run = dataclasses.replace(run, q=q, at_stop=stop)
    np.testing.assert_allclose(run.positions[:, entry - run.robot.first_joint], turns, atol=1e-9)
    figure = joints_figure([run])
    thick = [line for line in panels(figure)[0].lines if line.get_linewidth() == STOP["linewidth"]]
    assert len(thick) == 1 and np.isfinite(thick[0].get_ydata()).sum() == 100
    assert "joint at its stop" in text_of(figure)


def test_one_joint_and_no_limit(fixed: RunView) -> None:
    robot = load_robot(PENDULUM)
    model = pin.buildReducedModel(robot.model, [robot.model.njoints - 1], pin.neutral(robot.model))
    model.effortLimit = np.zeros(1)
    one = dataclasses.replace(robot, model=model, postures={})
    keys = {"torque": fixed.torque[:, :1], "at_stop": fixed.at_stop[:, :1], "q": fixed.q[:, : model.nq]}
    run = dataclasses.replace(fixed, robot=one, v=fixed.v[:, :1], windows=(), **keys)
    axes = panels(controls_figure(run))
    assert len(axes) == 1 and limits(axes[0]) == [] and len(curves(axes[0])) == 1
    assert len(curves(panels(joints_figure([run]))[0])) == 1


def test_H_that_was_never_evaluated_and_a_run_without_contact(flying: RunView, tmp_path: Path) -> None:
    run = dataclasses.replace(flying, objective=np.full(TICKS, np.nan), windows=(), force=np.zeros((TICKS, 3)))
    assert "H was not evaluated" in text_of(metric_figure(run))
    assert len(panels(metric_figure(run))) == 3
    assert "contacts 0" in text_of(metric_figure(run))
    assert [word for word, _ in instants(run)] == ["start", "half of the run", "end"]
    assert len(panels(comparison_figure([run, run]))) == 1
    for figure in (controls_comparison_figure([run]), snapshots_figure([run]), joints_figure([run])):
        figure.draw_without_rendering()
    missed = dataclasses.replace(flying, windows=(Window("impact", 0, 1.0, 1.3, False),))
    assert "time since expected touch" in text_of(metric_figure(missed))


def test_comparison_puts_nominal_first_and_counts_from_each_ones_touch(flying: RunView) -> None:
    later = tuple(dataclasses.replace(w, begin=w.begin + 0.1, end=w.end + 0.1) for w in flying.windows)
    robust = dataclasses.replace(flying, controller="robust", objective=0.5 * flying.objective, windows=later)
    upper, lower = panels(comparison_figure([robust, flying]))
    assert list(curves(upper)) == ["nominal", "robust"]
    known = np.isfinite(flying.objective)
    np.testing.assert_allclose(curves(upper)["robust"][1], 0.5 * flying.objective[known])
    for line, view in zip(lower.lines, (flying, robust), strict=True):
        drawn = np.interp(100.0, line.get_xdata(), line.get_ydata())
        np.testing.assert_allclose(drawn, np.interp(view.impacts[0].begin + 0.1, view.t, view.speed))
    titles = [axes.get_title() for axes in panels(controls_comparison_figure([robust, flying]))]
    assert titles[:2] == ["nominal", "robust"]
    rows = panels(joints_figure([robust, flying]))[::2]
    assert [axes.get_title(loc="left") for axes in rows] == ["nominal", "robust"]
    np.testing.assert_allclose(shaded(rows[1], "impact"), [(1.1, 1.4), (2.6, 2.9)])
    assert len({axes.get_ylim() for axes in rows}) == 1


def test_pushes_share_the_push_as_zero(pushed: RunView) -> None:
    late = dataclasses.replace(pushed, controller="robust", windows=(Window("impact", 0, 2.0, 2.3, True),))
    upper, _ = panels(comparison_figure([pushed, late]))
    assert upper.get_xlabel() == "time since push  [s]"
    np.testing.assert_allclose(upper.get_xlim(), (-1.99, 3.0))
    np.testing.assert_allclose(shaded(upper, "impact"), [(0.0, 0.3)], atol=1e-12)


def test_more_than_three_controllers_go_on_below(flying: RunView) -> None:
    names = ("nominal", "robust", "posture", "stiff")
    views = [dataclasses.replace(flying, controller=name) for name in names]
    titles = [axes.get_title() for axes in panels(controls_comparison_figure(views)) if axes.get_title()]
    assert titles == list(names)


def test_snapshots_show_the_robot_where_it_was(flying: RunView, pushed: RunView) -> None:
    figure = snapshots_figure([flying])
    assert [time for _, time in instants(flying)] == pytest.approx([flying.t[0], 0.995, 1.3])
    for axes, (_, time) in zip(panels(figure), instants(flying), strict=True):
        state = build_skeleton(flying.robot, flying.q[flying.index(time)], [flying.contact])
        spots = [line.get_xydata()[0] for line in axes.lines if len(line.get_xdata()) == 1]  # type: ignore[index, arg-type]
        assert any(np.allclose(spot, state.contact[[0, 2]]) for spot in spots)
        # The surface x = −0.5 is a vertical line.
        assert any(np.allclose(line.get_xdata(), -0.5) for line in axes.lines)
        x, y = axes.get_xlim(), axes.get_ylim()
        assert (state.points[:, 0] > x[0]).all() and (state.points[:, 2] < y[1]).all() and x[0] < -0.5
    arrows = [[t for t in axes.texts if t.arrow_patch is not None] for axes in panels(snapshots_figure([pushed]))]  # type: ignore[attr-defined]
    assert [len(panel) for panel in arrows] == [0, 1, 1]
    tip, tail = np.array(arrows[2][0].xy), np.array(arrows[2][0].xyann)
    state = build_skeleton(pushed.robot, pushed.q[pushed.index(1.3)], [pushed.contact])
    np.testing.assert_allclose(tip, state.contact[[0, 2]])
    assert (tip - tail)[0] > 0 and (tip - tail)[1] == pytest.approx(0)


ROWS = (
    Bar("vertical", "nominal", 1.42, 0.05, 10.4),
    Bar("vertical", "robust", 0.4, 0.02, 5.1),
    Bar("humanoid", "nominal", 0.284, 0.01, 0.305),
    Bar("humanoid", "robust", 0.136, 0.0, 0.166),
    Bar("humanoid", "stiff", float("nan")),
)


def test_bars_carry_means_intervals_and_the_papers_numbers() -> None:
    vertical, humanoid = panels(bars_figure(ROWS))
    assert [bar.get_width() for bar in vertical.patches] == [1.42, 0.4]  # type: ignore[attr-defined]
    assert [bar.get_width() for bar in humanoid.patches] == [0.284, 0.136]  # type: ignore[attr-defined]
    (segment,) = (c.get_segments()[0] for c in humanoid.collections)  # type: ignore[attr-defined]
    np.testing.assert_allclose(segment[:, 0], [0.274, 0.294])
    places = {m: [float(line.get_xdata()[0]) for line in humanoid.lines if line.get_marker() == m] for m in "D>"}  # type: ignore[index]
    assert places == {"D": [0.305, 0.166], ">": []}
    # Values far beyond the axis appear as an arrow at the edge of the panel, with the number as text.
    beyond = [line for line in vertical.lines if line.get_marker() == ">"]
    assert len(beyond) == 2 and all(line.get_xdata()[0] < vertical.get_xlim()[1] for line in beyond)  # type: ignore[index]
    text = text_of(bars_figure(ROWS))
    for words in ("1.420 ± 0.050 paper 10.4", "0.284 ± 0.010 paper 0.305", "0.136 paper 0.166", "no run ended"):
        assert words in text
    assert {label.get_text() for label in humanoid.get_yticklabels()} == {"nominal", "robust", "stiff"}


@pytest.mark.long(but=("flying-metric_figure", "humanoid-<lambda>1", "pushed-<lambda>"))
@pytest.mark.parametrize(
    ("name", "figure"),
    [
        ("flying", metric_figure),
        ("flying", controls_figure),
        ("humanoid", lambda run: joints_figure([run, dataclasses.replace(run, controller="robust")])),
        ("humanoid", lambda run: controls_comparison_figure([run, dataclasses.replace(run, controller="robust")])),
        ("pushed", lambda run: snapshots_figure([run, dataclasses.replace(run, controller="robust-sticking")])),
        ("flying", lambda _: bars_figure(ROWS)),
    ],
)
def test_nothing_overlaps(name: str, figure: Any, request: pytest.FixtureRequest) -> None:
    page = figure(request.getfixturevalue(name))
    check_page(page)
    boxes = [axes.get_tightbbox().padded(-1) for axes in panels(page)]
    assert not any(box.overlaps(other) for k, box in enumerate(boxes) for other in boxes[:k])


def test_files_in_all_formats_and_the_same_each_time(flying: RunView, fixed: RunView, tmp_path: Path) -> None:
    short = dataclasses.replace(fixed, windows=())
    paths = save_all(figures_of_run(short), tmp_path, ("svg",))
    paths += save_all(figures_of_comparison([short, short]), tmp_path / "comparison", ("svg",))
    paths += save(bars_figure(ROWS), tmp_path, "bars", FORMATS)
    assert [path.name for path in paths] == [
        "metric.svg", "controls.svg", "joints.svg", "snapshots.svg",
        "comparison-metric.svg", "comparison-controls.svg", "comparison-joints.svg", "snapshots.svg",
        "bars.png", "bars.svg", "bars.pdf",
    ]  # fmt: skip
    assert all(path.stat().st_size > 8_000 for path in paths)
    again = save(bars_figure(ROWS), tmp_path / "again", "bars", ("pdf",))
    again += save(metric_figure(short), tmp_path / "again", "metric", ("svg",))
    for path in again:
        assert path.read_bytes() == (tmp_path / path.name).read_bytes()


def test_long_curves_are_simplified_and_keep_their_peaks(tmp_path: Path) -> None:
    """When a figure is drawn or saved, Matplotlib removes invisible points of a curve."""
    t = np.arange(30_000) * 1e-3
    values = np.sin(t)
    values[12_345], values[23_456] = 7.0, -9.0
    with framed("long", [], 2.0) as (figure, body):
        axes = body.subplots()
        (line,) = axes.plot(t, values)
    drawn = line.get_transform().transform_path(line.get_path()).cleaned(simplify=True).vertices
    x, y = line.get_transform().inverted().transform(drawn[:-1]).T
    assert len(x) < 3_000
    assert y.max() == pytest.approx(7.0) and y.min() == pytest.approx(-9.0)
    assert x[y.argmax()] == pytest.approx(t[12_345], abs=2e-3)
    (path,) = save(figure, tmp_path, "long", ("svg",))
    assert path.stat().st_size < 200_000


def test_bad_input(flying: RunView, pushed: RunView, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"torque has the shape \(400, 2\).*give \(400, 3\)"):
        dataclasses.replace(flying, torque=flying.torque[:, :2])
    with pytest.raises(InputError, match="fewer than two ticks"):
        dataclasses.replace(flying, t=flying.t[::-1])
    with pytest.raises(InputError, match="there is no run to draw"):
        figures_of_comparison([])
    with pytest.raises(
        InputError, match=r"robot of nominal is solo8, but for nominal it is tilthex_arm.*same scenario"
    ):
        snapshots_figure([flying, pushed])
    with pytest.raises(InputError, match="no format 'gif'"):
        save(metric_figure(flying), tmp_path, "metric", ("gif",))
    with pytest.raises(InputError, match="nothing to draw"):
        bars_figure([])
    assert not list(tmp_path.iterdir())
