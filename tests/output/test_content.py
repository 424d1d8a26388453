"""Compare figures with the numbers that the figures show."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import matplotlib.colors
import numpy as np
import pinocchio as pin
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from mpl_toolkits.mplot3d import proj3d

from impact_posture.collision.robot_shapes import load_shapes
from impact_posture.errors import InputError
from impact_posture.impact.evaluation.impact_effect import tangent_units
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.output.plot import FIGURES, ResultView, postures_figure
from impact_posture.output.plot.classical_figure import classical_figure, kinds_of
from impact_posture.output.plot.ellipsoid_figure import ellipsoid_figure
from impact_posture.output.plot.ellipsoid_shapes import COORDINATE_PLANES, XY, XZ, YZ, Plane, half_width
from impact_posture.output.plot.jump_figure import groups_of, jump_figure
from impact_posture.output.plot.path_figures import normalized, path_figure, tradeoff_figure
from impact_posture.output.plot.postures_figure import DrawnSurface, side_plane, surfaces_of
from impact_posture.output.plot.result_view import SEPARATOR, contact_letters, header_lines, number
from impact_posture.output.plot.self_motion_figure import self_motion_figure
from impact_posture.output.plot.skeleton import Skeleton, build_skeleton
from impact_posture.output.plot.style import ORANGE, WIDTH, style, wrap
from impact_posture.posture.manifold.null_space_path import NullSpacePath
from impact_posture.robot.robot_loader import load_robot
from tests.output.views import PENDULUM, make_view, text_of
from tests.support.arms import TIP, X, Y, Z, arm


@pytest.mark.parametrize("figure", FIGURES.values(), ids=FIGURES)
def test_no_figure_shows_H_alone(figure: Callable[[ResultView], Figure], tilthex: ResultView) -> None:
    text = text_of(figure(tilthex))
    for name in ("H", "G", "V", "S", "E"):
        before, after = (number(getattr(f, name)) for f in (tilthex.before, tilthex.after))
        assert f"{name} {before} → {after}" in text
    for fact in ("tilthex_arm", "impact at ee", "objective impulse", "metric euclidean", "0.01 kg·m² (robot.toml)"):
        assert fact in text


def test_the_header_names_robot_and_feet_and_fits_the_page(solo8: ResultView) -> None:
    title, small = header_lines(solo8)
    assert title == "solo8, impact at base_link"
    assert "contact-consistent, on FL_FOOT, FR_FOOT, HL_FOOT, HR_FOOT" in small[0]
    line = SEPARATOR.join(small * 2)
    parts = wrap(line, SEPARATOR)
    assert len(parts) > 1 and SEPARATOR.join(parts) == line
    with style():
        figure = Figure(figsize=(WIDTH, 1))
        for part in parts:
            drawn = figure.text(0.012, 0, part, fontsize=7.0)
            assert drawn.get_window_extent().x1 < figure.bbox.x1


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "undefined"), (float("nan"), "undefined"), (-0.12345, "−0.123"), (2712.0, "2710"), (6.15e6, "6.15e6"),
     (7.4e-5, "7.4e−5"), (0.0, "0"), (float("inf"), "∞")],
)  # fmt: skip
def test_number(value: float | None, text: str) -> None:
    assert number(value) == text


def panels_of(figure: Figure) -> list[Axes]:
    return [a for a in figure.axes if a.get_title().startswith("shadow")]


def test_ellipsoid_panels_are_equal_and_tangents_touch(tilthex: ResultView) -> None:
    figure = ellipsoid_figure(tilthex)
    figure.draw_without_rendering()
    panels = panels_of(figure)
    assert [a.get_title() for a in panels] == ["shadow on xy", "shadow on xz", "shadow on yz"]
    for axes in panels:
        box = axes.get_window_extent()
        assert box.width == pytest.approx(box.height, rel=1e-6)
        assert axes.get_xlim() == axes.get_ylim() == panels[0].get_xlim()
        assert "(m/s, rad/s)/(N·s)" in axes.get_xlabel()
    # The normal is z, so in the xz panel the curves touch horizontal tangents at ±√H for both postures.
    curves = [line.get_ydata() for line in panels[1].lines if len(line.get_ydata()) > 100]
    tangents = [line.get_ydata() for line in panels[1].lines if line.get_linewidth() == 0.7]
    heights = sorted(float(y[0]) for y in tangents)
    roots = [np.sqrt(f.H) for f in (tilthex.before, tilthex.after)]
    np.testing.assert_allclose(heights, sorted([*roots, *(-r for r in roots)]), rtol=1e-9)
    np.testing.assert_allclose(sorted(c.max() for c in curves), sorted(roots), rtol=1e-3)


def test_oblique_normal_gets_its_own_plane() -> None:
    view = make_view("tilthex_arm", (-1, 0.6, 0.5), path=False)
    figure = ellipsoid_figure(view)
    (panel,) = (a for a in figure.axes if a.get_title() == "shadow on plane of n and z")
    widths = []
    for line in panel.lines:
        if line.get_linewidth() == 0.7:
            (x0, x1), (y0, y1) = line.get_xdata(), line.get_ydata()
            widths.append(abs(x0 * y1 - x1 * y0) / np.hypot(x1 - x0, y1 - y0))
    roots = [np.sqrt(f.H) for f in (view.before, view.after)]
    np.testing.assert_allclose(sorted(widths), np.repeat(sorted(roots), 2), rtol=1e-9)


def test_free_ellipsoid_stands_beside_the_consistent_one(solo8: ResultView, tilthex: ResultView) -> None:
    assert tilthex.free == () and "free" not in text_of(ellipsoid_figure(tilthex))
    assert len(solo8.free) == 2
    # The expected ellipsoid without feet follows from M and J alone.
    J, M = solo8.jacobian(solo8.q_optimal), solo8.objective.oracle.at(solo8.q_optimal).M
    expected = np.linalg.solve(M, J.T).T @ np.linalg.solve(M, J.T)
    np.testing.assert_allclose(solo8.free[1].ellipsoid, expected, rtol=1e-9, atol=1e-12 * expected.max())
    figure = ellipsoid_figure(solo8)
    text = text_of(figure)
    for word, free in (("before", solo8.free[0]), ("after", solo8.free[1])):
        assert f"{word}, free: √H = {number(np.sqrt(free.H))}" in text
    matrices = [f.ellipsoid for f in (solo8.before, solo8.after, solo8.free[0], solo8.free[1])]
    for axes, plane in zip(panels_of(figure), COORDINATE_PLANES, strict=True):
        reach = [line.get_xdata().max() for line in axes.lines if len(line.get_xdata()) == 181]
        widths = [half_width(matrix, plane.axes[0]) for matrix in matrices]
        np.testing.assert_allclose(sorted(reach), sorted(widths), rtol=1e-3)


def test_cone_and_all_tied_worst_normals_are_drawn(solo8_cone: ResultView, solo8: ResultView) -> None:
    worst = solo8_cone.worst[1]
    assert worst is not None and len(worst.normals) == 2
    figure = ellipsoid_figure(solo8_cone)
    assert "cone of 20° about n" in text_of(figure) and "20° off, 2 tied" in text_of(figure)
    assert "cone" not in text_of(ellipsoid_figure(solo8))
    for axes, plane in zip(panels_of(figure), COORDINATE_PLANES, strict=True):
        limit = axes.get_xlim()[1]
        tips = [np.array(text.xy) for text in axes.texts if text.arrow_patch is not None]
        # Each of the two equal postures has two arrows for worst normals.  If n is visible in the panel, the panel
        # has one more arrow.
        assert len(tips) == 4 + plane.contains(solo8_cone.after.normal)
        for normal in worst.normals:
            assert sum(np.allclose(tip, 0.92 * limit * plane.axes @ normal, atol=1e-9) for tip in tips) >= 2
        (patch,) = axes.patches
        # A worst normal on the edge of the cone ends on the edge of the cone's shadow.
        assert np.abs(patch.get_xy()).max() <= 0.92 * limit * (1 + 1e-12)
    value = number(solo8_cone.objective.value(solo8_cone.q_optimal))
    assert f"objective impulse {value} → {value}" in text_of(figure)


def test_cone_whose_worst_normal_does_not_exist_is_drawn_without() -> None:
    view = make_view(PENDULUM, (0, 1, 0), q0=np.array([0.4, 0.9]), path=False)
    objective = dataclasses.replace(view.objective, kind="sticking", normal_cone_deg=10.0)
    view = dataclasses.replace(view, objective=objective)
    assert view.worst[0] is None
    text = text_of(ellipsoid_figure(view))
    assert "cone of 10° about n" in text and "worst before" not in text
    assert "objective sticking undefined → undefined" in text


def test_three_ellipsoids_share_panels_and_state_their_units(tilthex: ResultView) -> None:
    figure = classical_figure(tilthex)
    J = [tilthex.jacobian(q) for q in (tilthex.q_initial, tilthex.q_optimal)]
    roots = {
        "velocity": [np.linalg.svd(j, compute_uv=False) for j in J],
        "force": [1 / np.linalg.svd(j, compute_uv=False) for j in J],
        "impact": [np.sqrt(np.linalg.eigvalsh(f.ellipsoid)) for f in (tilthex.before, tilthex.after)],
    }
    units = {"velocity": "m/s", "force": "N", "impact": "(m/s, rad/s)/(N·s)"}
    text = text_of(figure)
    for kind in kinds_of(tilthex):
        assert kind.scale == pytest.approx(roots[kind.name][0].max(), rel=1e-9)
        assert f": 1 = {number(kind.scale)} {units[kind.name]}" in text
        for matrix, expected in zip(kind.matrices, roots[kind.name], strict=True):
            sizes = np.sqrt(np.linalg.eigvalsh(matrix))
            np.testing.assert_allclose(sizes, np.sort(expected) / kind.scale, rtol=1e-9)
    panels = np.array(figure.axes).reshape(2, 3)
    limits = {axes.get_xlim() for axes in panels.flat} | {axes.get_ylim() for axes in panels.flat}
    assert len(limits) == 1
    assert all(len([c for c in axes.lines if len(c.get_xdata()) == 181]) == 3 for axes in panels.flat)


def test_self_motion_draws_every_component_and_its_marks(tilthex: ResultView, surface: ResultView) -> None:
    data = tilthex.self_motion
    assert data is not None
    (axes,) = self_motion_figure(tilthex).axes
    solid = [line for line in axes.lines if line.get_linestyle() == "-" and len(line.get_xdata()) > 2]
    curves = [np.array(line.get_xydata()) for line in solid]
    for k, curve in enumerate(curves):
        mine = data.component == k
        np.testing.assert_allclose(np.diff(curve[:, 0]), np.diff(data.s[mine]), atol=1e-12)
        np.testing.assert_allclose(curve[:, 1], np.where(data.feasible, data.objective, np.nan)[mine])
    assert len(curves) == 2 and curves[0][-1, 0] < curves[1][0, 0]
    marks = {line.get_label(): line for line in axes.lines}
    assert marks["optimum"].get_ydata() == data.objective[data.optimum]
    np.testing.assert_allclose(marks["optima of multi-start"].get_ydata(), data.objective[data.ends])
    panels = [axes for axes in self_motion_figure(surface).axes if axes.get_xlabel()]
    points = [panel.collections[0].get_offsets() for panel in panels]
    assert [len(p) for p in points] == [data.feasible[data.component == k].sum() for k in (0, 1)]


def test_tradeoff_marks_knee_and_what_did_not_certify(tilthex: ResultView) -> None:
    data = tilthex.tradeoff
    assert data is not None
    upper, lower = (a for a in tradeoff_figure(tilthex).axes if not a.get_ylabel().startswith("reduction"))
    labels = upper.get_legend_handles_labels()[1]
    assert labels == ["certified", "not certified"]
    hollow = next(line for line in upper.lines if line.get_label() == "not certified")
    np.testing.assert_array_equal(hollow.get_xdata(), data.within[~data.certified])
    assert hollow.get_markerfacecolor() == "white"
    np.testing.assert_allclose(upper.lines[0].get_ydata(), data.objective)
    H = next(line for line in lower.lines if str(line.get_label()).startswith("H"))
    np.testing.assert_allclose(H.get_ydata(), data.H / data.H[0])
    kneed = dataclasses.replace(tilthex, tradeoff=dataclasses.replace(data, knee=4))
    figure = tradeoff_figure(kneed)
    ring = next(line for line in figure.axes[0].lines if line.get_label() == "knee")
    assert ring.get_xdata() == data.within[4] and ring.get_ydata() == data.objective[4]
    assert "the excess is 1/3 or more" in text_of(figure)
    assert "1/3" not in text_of(tradeoff_figure(tilthex))


def test_tradeoff_axis_is_log_where_the_objective_spreads(tilthex: ResultView) -> None:
    data = dataclasses.replace(tilthex.tradeoff, objective=np.geomspace(9e3, 2.0, len(tilthex.tradeoff.within)))  # type: ignore[union-attr, type-var]
    figure = tradeoff_figure(dataclasses.replace(tilthex, tradeoff=data))
    figure.draw_without_rendering()
    assert figure.axes[0].get_yscale() == "log"


def skeleton(view: ResultView, q: np.ndarray) -> Skeleton:
    return build_skeleton(view.robot, q, view.objective.contacts, view.objective.supports)


def test_skeleton_meets_pinocchio(
    tilthex: ResultView, solo8: ResultView, pendulum: ResultView, turned: ResultView
) -> None:
    for view in (tilthex, solo8, pendulum, turned):
        model, data = view.robot.model, view.robot.model.createData()
        pin.framesForwardKinematics(model, data, view.q_optimal)
        seen = skeleton(view, view.q_optimal)
        frame = view.robot.frame_id(view.objective.contact.frame)
        np.testing.assert_allclose(seen.contact, data.oMf[frame].translation, atol=1e-12)
        np.testing.assert_allclose(seen.normal, view.after.normal, atol=1e-12)
        for support, foot in zip(view.objective.supports, seen.feet, strict=True):
            place = data.oMf[view.robot.frame_id(support.frame)]
            np.testing.assert_allclose(foot, place.act(np.array(support.offset)), atol=1e-12)
    assert len(skeleton(solo8, solo8.q_initial).feet) == 4
    rotors = skeleton(tilthex, tilthex.q_initial).rotors
    centers = rotors.mean(axis=2) - tilthex.q_initial[:3]
    expected = [r.position for r in tilthex.robot.spec.propulsion.rotors]  # type: ignore[union-attr]
    np.testing.assert_allclose(centers, expected, atol=1e-9)
    # Both links of the pendulum are drawn, and the last stick ends at the center of mass of the second link.
    assert len({tuple(p.round(9)) for bone in skeleton(pendulum, pendulum.q_optimal).bones for p in bone}) == 4


def test_postures_are_drawn_to_scale(talos: ResultView, tilthex: ResultView) -> None:
    for view in (talos, tilthex):
        figure = postures_figure(view)
        figure.draw_without_rendering()
        space, flat = figure.axes
        (x0, x1), (y0, y1) = flat.get_xlim(), flat.get_ylim()
        box = flat.get_window_extent()
        assert box.width / (x1 - x0) == pytest.approx(box.height / (y1 - y0), rel=1e-6)
        spans = np.ptp([space.get_xlim(), space.get_ylim(), space.get_zlim()], axis=1)
        np.testing.assert_allclose(space._box_aspect / space._box_aspect[0], spans / spans[0], rtol=1e-9)
        first, second = both(view)
        plane = side_plane(first, second)
        assert plane.contains(second.normal)
        inside = plane.axes @ np.vstack([first.points, second.points]).T
        assert (inside[0] > x0).all() and (inside[0] < x1).all() and (inside[1] > y0).all() and (inside[1] < y1).all()


def both(view: ResultView) -> tuple[Skeleton, Skeleton]:
    return skeleton(view, view.q_initial), skeleton(view, view.q_optimal)


def surfaces(view: ResultView, depths: Sequence[float] = ()) -> list[DrawnSurface]:
    return surfaces_of(*both(view), contact_letters(view), 0.1, depths)


def test_a_surface_is_drawn_at_its_depth(tilthex: ResultView, solo8: ResultView) -> None:
    for view in (tilthex, solo8):
        for there, moved in zip(surfaces(view), surfaces(view, [0.07]), strict=True):
            np.testing.assert_allclose(there.point - moved.point, 0.07 * there.normal, atol=1e-12)
            np.testing.assert_array_equal(there.contact, moved.contact)


def test_each_contact_has_its_planes(
    tilthex: ResultView, turned: ResultView, two_hands: ResultView, solo8: ResultView
) -> None:
    # If the contact point moves along n, or if n rotates, the figure shows two surfaces per contact.
    assert [s.name for s in surfaces(tilthex)] == ["n₀", "n₁"] == [s.name for s in surfaces(turned)]
    assert [s.name for s in surfaces(two_hands)] == ["n₀ A", "n₁ A", "n₀ B", "n₁ B"]
    for view in (tilthex, turned, two_hands):
        figure = postures_figure(view)
        text = text_of(figure)
        drawn = surfaces(view)
        assert "surface before" in text and "surface after" in text
        for name in {s.name for s in drawn}:
            assert text.split(" | ").count(name) == 2
        (space, flat) = figure.axes
        squares = [line for line in space.lines if line.get_linewidth() == 0.8 and len(line.get_data_3d()[0]) == 5]
        for surface, line in zip(drawn, squares, strict=True):
            offsets = np.array(line.get_data_3d()).T - surface.point
            np.testing.assert_allclose(offsets[:4].mean(axis=0), 0.0, atol=1e-9)
            np.testing.assert_allclose(offsets @ surface.normal, 0.0, atol=1e-9)
        hatched = [patch for patch in flat.patches if patch.get_hatch()]
        seen = [s for s in drawn if np.linalg.norm(side_plane(*both(view)).axes @ s.normal) > 0.05]
        assert len(hatched) == len(seen) > 0
    # If both postures touch the same plane, the figure shows one surface.
    still = dataclasses.replace(solo8, q_optimal=solo8.q_initial)
    (one,) = surfaces(still)
    assert one.name == "n" and "surface before" not in text_of(postures_figure(still))
    # A push has a direction, but no surface.
    text = text_of(postures_figure(dataclasses.replace(still, pushed=True)))
    assert "surface |" in text_of(postures_figure(still)) and "surface |" not in text and "| n |" in text
    assert "impact at gripper_right_base_link (A), gripper_left_base_link (B)" in text_of(jump_figure(two_hands))


@pytest.mark.parametrize("name", ["solo8", "anymal_c"])
def test_a_base_with_legs_is_a_body(name: str) -> None:
    view = make_view(name, (1, 0, 0), path=False)
    seen = skeleton(view, view.q_optimal)
    model, base = view.robot.model, seen.base
    hips = np.array([model.jointPlacements[k].translation for k in range(2, model.njoints) if model.parents[k] == 1])
    corners = np.array([base.actInv(corner) for corner in seen.body])
    assert len(hips) == 4 and corners.shape == (8, 3)
    # Seen from above, the hips are at the corners of the box.
    np.testing.assert_allclose(corners.min(axis=0)[:2], hips.min(axis=0)[:2], atol=1e-12)
    np.testing.assert_allclose(corners.max(axis=0)[:2], hips.max(axis=0)[:2], atol=1e-12)
    assert np.ptp(corners[:, 2]) > 0.3 * np.ptp(hips, axis=0)[:2].min()
    # The box of the body replaces the lines from the base to the hips.
    assert not any(np.allclose(end, base.translation) for bone in seen.bones for end in bone)
    # If a robot has collision shapes, the figure shows these instead of the box of the body.  For a robot without
    # shapes, the figure shows the box of the body.
    assert "body" not in text_of(postures_figure(view)).split(" | ")
    assert "body" in text_of(postures_figure(without_shapes(view))).split(" | ")


def without_shapes(view: ResultView) -> ResultView:
    robot = dataclasses.replace(view.robot, files=None)
    return dataclasses.replace(view, objective=dataclasses.replace(view.objective, robot=robot))


def silhouettes(axes: Axes) -> list[PathPatch]:
    return [
        patch for patch in axes.get_children() if isinstance(patch, PathPatch) and patch.get_path().codes is not None
    ]


def encloses(ring: Path, points: np.ndarray) -> bool:
    """Whether a ring of points encloses all points, for either direction of the ring."""
    return any(bool(ring.contains_points(points, radius=radius).all()) for radius in (1e-9, -1e-9))


def test_silhouettes_are_the_shadows_of_the_hulls(talos: ResultView, panda: ResultView, tilthex: ResultView) -> None:
    for view in (talos, panda, tilthex):
        figure = postures_figure(view)
        space, flat = figure.axes
        states = both(view)
        plane = side_plane(*states)
        bodies = load_shapes(view.robot).bodies
        for state, patch in zip(states, silhouettes(flat), strict=True):
            rings = [Path(ring) for ring in patch.get_path().to_polygons(closed_only=False)]
            assert len(rings) == len(state.hulls) == len(bodies)
            for ring, hull in zip(rings, state.hulls, strict=True):
                shadow = hull.vertices @ plane.axes.T
                assert encloses(ring, shadow)
                # The sweep moves the outline outward by the sweep radius in every direction.
                around = np.array([[np.cos(a), np.sin(a)] for a in np.linspace(0, 6, 20)])
                out = (ring.vertices @ around.T).max(axis=0) - (shadow @ around.T).max(axis=0)
                assert (out <= max(hull.radius, 1e-4) + 1e-12).all() and (out >= 0.86 * hull.radius).all()
        data = view.robot.model.createData()
        pin.forwardKinematics(view.robot.model, data, view.q_optimal)
        for body, hull in zip(bodies, states[1].hulls, strict=True):
            np.testing.assert_allclose(hull.vertices[0], data.oMi[body.joint].act(body.vertices[0]), atol=1e-12)
        # The corners of each three-dimensional hull project into its outline in the figure.
        for state, patch in zip(states, silhouettes(space), strict=True):
            rings = [Path(ring) for ring in patch.get_path().to_polygons(closed_only=False)]
            for ring, hull in zip(rings, state.hulls, strict=True):
                seen = np.array(proj3d.proj_transform(*hull.vertices.T, space.get_proj())[:2]).T
                assert encloses(ring, seen)


def test_shapes_in_collision_have_a_color_and_a_name(talos: ResultView) -> None:
    hit = (("gripper_right_base_link", "leg_right_3_link"), ("arm_right_7_link", "the wall"))
    figure = postures_figure(dataclasses.replace(talos, collisions=((), hit)))
    assert "in collision" in text_of(figure).split(" | ")
    for axes in figure.axes:
        *free, marked = silhouettes(axes)
        assert matplotlib.colors.to_hex(marked.get_facecolor()) == ORANGE.lower() and len(free) == 2
        assert len(marked.get_path().to_polygons()) == 3
    assert "in collision" not in text_of(postures_figure(talos)).split(" | ")


def test_a_robot_without_shapes_is_drawn_by_its_sticks(pendulum: ResultView) -> None:
    figure = postures_figure(without_shapes(pendulum))
    assert not any(silhouettes(axes) for axes in figure.axes)
    assert "Sticks do not show the shapes of the links." in text_of(figure)
    assert "shapes" not in text_of(figure).split(" | ")


def test_no_body_without_legs(tilthex: ResultView, talos: ResultView, panda: ResultView) -> None:
    for view in (tilthex, talos, panda):
        assert not len(skeleton(view, view.q_initial).body)


def test_jump_bars_carry_the_jump(tilthex: ResultView, panda: ResultView) -> None:
    figure = jump_figure(tilthex)
    panels = np.array(figure.axes).reshape(3, 2)
    for column, factor in ((0, [1.0, 1.0]), (1, [0.6 / tilthex.before.G, 0.6 / tilthex.after.G])):
        # In each panel, one patch has the bars of the initial posture, another patch the bars of the optimum.
        data = [[patch.get_data() for patch in axes.patches] for axes in panels[:, column]]
        for state, bars, gain in zip((tilthex.before, tilthex.after), zip(*data, strict=True), factor, strict=True):
            np.testing.assert_allclose(np.hstack([b.values[::2] for b in bars]), gain * state.jump, rtol=1e-12)
            assert all(np.isnan(b.values[1::2]).all() and (np.diff(b.edges)[::2] > 0).all() for b in bars)
    assert [axes.get_xlabel() for axes in panels[:, 1]] == ["Δν  [m/s]", "Δν  [rad/s]", "Δν  [rad/s]"]
    units = tangent_units(panda.robot)
    assert [n for n, u in zip(panda.robot.tangent_names, units, strict=True) if u == "m/s"] == [
        "panda_finger_joint1",
        "panda_finger_joint2",
    ]
    assert [k for _, indices, _ in groups_of(panda) for k in indices] == list(range(9))


def test_a_path_is_divided_by_its_value_at_the_start(tilthex: ResultView) -> None:
    path = tilthex.path
    assert path is not None
    share = normalized(path, "H")
    assert share is not None and share[1] == path.H[0]
    np.testing.assert_allclose(share[0], path.H / tilthex.before.H)


@pytest.mark.parametrize(("factor", "scale"), [(0.1, "linear"), (0.01, "log")])
def test_path_axis_is_log_where_values_spread(factor: float, scale: str, panda: ResultView) -> None:
    s = np.linspace(0, 1, 9)
    S = np.where(s < 0.3, np.nan, 2.0)
    path = NullSpacePath(s, s, H=np.geomspace(3, 3 * factor, 9), G=1 + s, V=2 - s, S=S, objective=s)
    view = ResultView(panda.objective, panda.q_initial, panda.q_optimal, path=path)
    (axes,) = path_figure(view).axes
    assert axes.get_yscale() == scale
    assert {"start", "optimum"} <= {t.get_text() for t in axes.texts}
    # S is undefined at the start, so the curve is normalized by the first defined value.
    (drawn,) = (line.get_ydata() for line in axes.lines if str(line.get_label()).startswith("S"))
    np.testing.assert_array_equal(np.isnan(drawn), np.isnan(S))
    assert np.nanmax(drawn) == 1.0


def test_path_of_wrong_shape(panda: ResultView) -> None:
    path = NullSpacePath(np.ones(3), np.arange(3.0), np.ones(3), np.ones(2), *np.ones((3, 3)))
    view = ResultView(panda.objective, panda.q_initial, panda.q_optimal, path=path)
    with pytest.raises(InputError, match="G \\(2,\\)"):
        path_figure(view)


@pytest.mark.parametrize(("axis", "plane"), [(Z, XY), (Y, XZ), (X, YZ)])
@pytest.mark.parametrize(("count", "height"), [(1, 0.0), (3, 0.5)])
def test_a_planar_robot_is_seen_across_its_plane(
    count: int, axis: tuple[int, int, int], plane: Plane, height: float
) -> None:
    along = Y if axis == X else X
    robot = arm([axis] * count, np.zeros(count), floating=False, rods=[along] * count)
    robot.model.jointPlacements[1] = pin.SE3(np.eye(3), np.array([0.0, 0.0, height]))
    for normal in (along, np.cross(axis, along)):
        contact = ImpactContact(TIP, tuple(float(n) for n in normal))
        postures = ((0.6, -0.9, 1.0), (0.8, 0.4, -0.9))
        states = [build_skeleton(robot, np.array(q[:count]), [contact]) for q in postures]
        assert side_plane(*states) is plane


@pytest.mark.parametrize("name", ["ur5", "panda", "solo8"])
def test_a_robot_with_other_axes_has_no_plane(name: str) -> None:
    robot = load_robot(name)
    assert build_skeleton(robot, robot.posture(), [ImpactContact(robot.frame_names[-1], (0, 0, 1))]).across is None
