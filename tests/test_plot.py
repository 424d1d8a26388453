"""The pictures: written in all formats without a warning, and true to the numbers."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import matplotlib
import matplotlib.image
import numpy as np
import pinocchio as pin
import pytest
from matplotlib.figure import Figure

from impact_posture.errors import InputError, OutputError
from impact_posture.impact.contact import Contact, Support
from impact_posture.impact.metric import Metric
from impact_posture.impact.objective import ImpactObjective
from impact_posture.plot import (
    FIGURES,
    FigureNotFound,
    PathData,
    ResultView,
    classical_figure,
    draw_all,
    ellipsoid_figure,
    jump_figure,
    path_figure,
    postures_figure,
    sample_path,
)
from impact_posture.plot.jump import groups_of
from impact_posture.plot.path import normalized
from impact_posture.plot.robot import side_plane
from impact_posture.plot.shapes import (
    COORDINATE_PLANES,
    Plane,
    half_width,
    polar,
    principal_sections,
    shadow,
    square,
    surface,
    upright_plane,
)
from impact_posture.plot.skeleton import build_skeleton
from impact_posture.plot.style import WIDTH, lay_out, style, wrap
from impact_posture.plot.view import SEPARATOR, header_lines, number, velocity_units
from impact_posture.robot.loader import load_robot

PENDULUM = "example-robot-data:double_pendulum_description/urdf/double_pendulum.urdf"
PLANES = [*COORDINATE_PLANES, upright_plane(np.array([0.6, -0.5, 0.3]))]
RANKS = {3: (2.0, 0.7, 0.1), 2: (2.0, 0.7, 0.0), 1: (2.0, 0.0, 0.0)}


@pytest.fixture(autouse=True)
def _no_warnings(caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    """Matplotlib warns by warnings and by its log; neither may speak."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield
    assert not [r.getMessage() for r in caplog.records if r.name.startswith("matplotlib")]


def make_view(
    name: str,
    normal: tuple[float, float, float],
    frame: str | None = None,
    *,
    q0: np.ndarray | None = None,
    scale: float = 0.2,
    path: bool = True,
    **keys: object,
) -> ResultView:
    robot = load_robot(name)
    supports = tuple(Support.from_spec(s) for s in robot.spec.supports)
    frame = frame or robot.spec.contact.frame or robot.frame_names[-1]
    normal_frame = keys.pop("normal_frame", "world")
    contact = Contact.create(frame, normal, normal_frame=normal_frame)  # type: ignore[arg-type]
    objective = ImpactObjective(robot, contact, keys.pop("metric", Metric()), supports=supports)  # type: ignore[arg-type]
    q0 = robot.posture() if q0 is None else q0
    v = scale * np.random.default_rng(3).normal(size=robot.nv)
    if robot.floating:
        v[:6] *= 0.2
    way = [pin.integrate(robot.model, q0, v * t) for t in np.linspace(0, 1, 12)]
    return ResultView(
        robot,
        objective,
        q0,
        way[-1],
        path=sample_path(objective, way) if path else None,
        **keys,  # type: ignore[arg-type]
    )


@pytest.fixture(scope="module")
def tilthex() -> ResultView:
    return make_view("tilthex_arm", (0, 0, 1), speed=0.5, restitution=0.2)


@pytest.fixture(scope="module")
def talos() -> ResultView:
    return make_view("talos", (-1, 0, 0), path=False)


@pytest.fixture(scope="module")
def solo8() -> ResultView:
    return make_view("solo8", (1, 0, 0), path=False)


@pytest.fixture(scope="module")
def panda() -> ResultView:
    return make_view("panda", (0, 0, 1), path=False)


@pytest.fixture(scope="module")
def pendulum() -> ResultView:
    return make_view(PENDULUM, (0, 1, 0), q0=np.array([0.4, 0.9]))


def spin(seed: int = 0) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q


def matrix_of_rank(rank: int, seed: int = 0) -> np.ndarray:
    R = spin(seed)
    return R @ np.diag(np.square(RANKS[rank])) @ R.T


@functools.cache
def sphere(count: int) -> np.ndarray:
    directions = np.random.default_rng(7).normal(size=(3, count))
    return directions / np.linalg.norm(directions, axis=0)


def sampled(matrix: np.ndarray, count: int = 200_000) -> np.ndarray:
    """Points of the ellipsoid's surface by a factor that is not the symmetric root, shape (3, count)."""
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.sqrt(np.maximum(values, 0))) @ sphere(count)


def text_of(figure: Figure) -> str:
    """All words of a figure; broken lines joined."""
    return " | ".join(" ".join(t.get_text().split()) for t in figure.findobj(matplotlib.text.Text))


# ---- geometry ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rank", RANKS)
@pytest.mark.parametrize("plane", PLANES, ids=lambda p: p.name)
def test_shadow_is_the_projection_of_sampled_points(rank: int, plane: Plane) -> None:
    matrix = matrix_of_rank(rank)
    edge = shadow(matrix, plane.axes, 2001)
    points = plane.axes @ sampled(matrix)
    angle = np.linspace(0, np.pi, 37)
    directions = np.array([np.cos(angle), np.sin(angle)]).T
    reach = (directions @ edge).max(axis=1)
    seen = (directions @ points).max(axis=1)
    # The shadow's support function bounds the samples' and is met by them, up to the sampling.
    assert (seen <= reach + 1e-5).all()
    np.testing.assert_allclose(seen, reach, atol=2e-3)


@pytest.mark.parametrize("rank", RANKS)
def test_half_width_is_the_support_function(rank: int) -> None:
    matrix = matrix_of_rank(rank, seed=1)
    points = sampled(matrix)
    for n in spin(5).T:
        assert half_width(matrix, n) == pytest.approx((n @ points).max(), abs=2e-4)


def test_half_width_is_the_root_of_H_and_not_the_radius(tilthex: ResultView) -> None:
    found = tilthex.after
    assert half_width(found.ellipsoid, found.normal) == pytest.approx(np.sqrt(found.H), rel=1e-12)
    radius = 1 / np.sqrt(found.normal @ np.linalg.solve(found.ellipsoid, found.normal))
    assert radius < 0.9 * np.sqrt(found.H)


@pytest.mark.parametrize("rank", RANKS)
def test_surface_and_sections_lie_on_the_ellipsoid(rank: int) -> None:
    matrix = matrix_of_rank(rank, seed=2)
    pseudo = np.linalg.pinv(matrix, rcond=1e-9, hermitian=True)
    cloud = surface(matrix).reshape(3, -1)
    size = np.einsum("ik,ij,jk->k", cloud, pseudo, cloud)
    assert size.max() == pytest.approx(1.0, abs=0.03)
    if rank == 3:
        np.testing.assert_allclose(size, 1.0, rtol=1e-9)
    sections = principal_sections(matrix)
    assert len(sections) == {3: 3, 2: 3, 1: 1}[rank]
    assert max(np.linalg.norm(s, axis=0).max() for s in sections) == pytest.approx(2.0)
    assert principal_sections(np.zeros((3, 3))) == []


def test_polar_dual() -> None:
    A = matrix_of_rank(3, seed=4)
    inverse, endless = polar(A, 1e3)
    np.testing.assert_allclose(inverse, np.linalg.inv(A), rtol=1e-9)
    assert endless.shape == (3, 0)
    A = matrix_of_rank(1, seed=4)
    inverse, endless = polar(A, 1e3)
    assert endless.shape == (3, 2)
    np.testing.assert_allclose(A @ endless, 0, atol=1e-12)
    assert half_width(inverse, endless[:, 0]) == pytest.approx(1e3)
    axis = np.linalg.eigh(A)[1][:, -1]
    assert half_width(inverse, axis) == pytest.approx(1 / 2.0)


@pytest.mark.parametrize("n", [(0, 0, 1), (1, 0, 0), (0.36, 0.48, 0.8)])
def test_square_is_perpendicular(n: tuple[float, float, float]) -> None:
    center = np.array([1.0, 2.0, 3.0])
    corners = square(center, np.array(n), 0.4)
    np.testing.assert_allclose((corners - center[:, None]).T @ n, 0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(np.diff(corners, axis=1), axis=0), 0.4, rtol=1e-12)
    np.testing.assert_allclose(corners[:, :4].mean(axis=1), center, atol=1e-12)


# ---- files ------------------------------------------------------------------------------------------------------


def test_figures_are_written_in_all_formats(tilthex: ResultView, tmp_path: Path) -> None:
    # Surfaces and hatches in every format, the rest in one each: the writers are matplotlib's.
    first = draw_all(tilthex, tmp_path / "figures", only=["ellipsoid", "jump"])
    assert [p.name for p in first] == [f"{n}.{f}" for n in ("ellipsoid", "jump") for f in ("png", "svg", "pdf")]
    paths = first + draw_all(tilthex, tmp_path / "figures", (".PNG",), only=["postures"])
    paths += draw_all(tilthex, tmp_path / "figures", ("svg", "svg"), only=["nullspace", "classical"])
    assert len(paths) == len(set(paths)) == 9
    assert {p.stem for p in paths} == set(FIGURES)
    for path in paths:
        assert path.stat().st_size > 8_000, path
        if path.suffix == ".png":
            image = matplotlib.image.imread(path)
            assert image.shape[1] == round(200 * WIDTH)
            # Something other than paper everywhere: left and right, top and bottom half.
            rows, columns = (image[..., :3].min(axis=2) < 0.9).nonzero()
            assert rows.min() < 0.1 * len(image) < 0.8 * len(image) < rows.max()
            assert columns.min() < 0.1 * image.shape[1] < 0.8 * image.shape[1] < columns.max()
        elif path.suffix == ".svg":
            assert ElementTree.parse(path).getroot().tag.endswith("svg")
        else:
            content = path.read_bytes()
            assert content.startswith(b"%PDF") and b"/Type3" not in content and b"/CreationDate" not in content


def test_the_same_view_gives_the_same_files(pendulum: ResultView, tmp_path: Path) -> None:
    (first,) = draw_all(pendulum, tmp_path / "a", ("svg",), only=["ellipsoid"])
    (second,) = draw_all(pendulum, tmp_path / "b", ("svg",), only=["ellipsoid"])
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize(
    ("name", "figure"),
    [("talos", postures_figure), ("talos", jump_figure), ("solo8", ellipsoid_figure), ("panda", postures_figure)],
)
def test_nothing_hangs_over_its_part_of_the_page(name: str, figure: object, request: pytest.FixtureRequest) -> None:
    page = figure(request.getfixturevalue(name))  # type: ignore[operator]
    lay_out(page)
    head, body, foot = page.subfigs
    for part in (head, foot):
        for words in part.texts:
            box = words.get_window_extent()
            assert box.x0 >= 0 and box.x1 <= part.bbox.x1
            assert box.y0 >= part.bbox.y0 and box.y1 <= part.bbox.y1
    # A pixel less all round: what they touch is blank.
    boxes = [axes.get_tightbbox().padded(-1) for axes in body.axes]
    for box in boxes:
        assert box.x0 >= 0 and box.x1 <= body.bbox.x1
        assert box.y0 >= body.bbox.y0 and box.y1 <= body.bbox.y1
    for legend in body.legends:
        assert not any(legend.get_window_extent().overlaps(box) for box in boxes)


def test_degenerate_robot_draws(pendulum: ResultView) -> None:
    assert np.linalg.matrix_rank(pendulum.after.ellipsoid, tol=1e-9) < 3
    words = {
        "classical": "after: unbounded, a strip",
        "ellipsoid": "S undefined",
        "jump": "no sticking jump",
        "nullspace": "S is undefined along the path",
        "postures": "seen along −x",
    }
    for name, build in FIGURES.items():
        figure = build(pendulum)
        figure.draw_without_rendering()
        assert words[name] in text_of(figure)


def test_a_contact_that_cannot_move_draws() -> None:
    # Across the pendulum's plane nothing gives: H = G = 0, V is infinite.
    view = make_view(PENDULUM, (1, 0, 0), q0=np.array([0.4, 0.9]))
    assert view.before.G == view.after.G == 0
    assert "G = 0" in text_of(jump_figure(view))
    for figure in (ellipsoid_figure(view), jump_figure(view), path_figure(view)):
        figure.draw_without_rendering()


def test_a_turning_normal_is_drawn_twice() -> None:
    view = make_view("ur5", (0.3, 0.4, 1), normal_frame="contact", path=False)
    for figure in (ellipsoid_figure(view), classical_figure(view)):
        assert {"n before", "n after"} <= set(text_of(figure).split(" | "))
    figure.draw_without_rendering()


def test_user_settings_are_put_back_and_ignored(pendulum: ResultView, tmp_path: Path) -> None:
    (clean,) = draw_all(pendulum, tmp_path / "clean", ("svg",), only=["jump"])
    with matplotlib.rc_context({"font.size": 21.0, "axes.facecolor": "red", "savefig.dpi": 37}):
        (own,) = draw_all(pendulum, tmp_path / "own", ("svg",), only=["jump"])
        assert matplotlib.rcParams["font.size"] == 21.0
    assert clean.read_bytes() == own.read_bytes()


def test_bad_input(pendulum: ResultView, panda: ResultView, tmp_path: Path) -> None:
    with pytest.raises(FigureNotFound, match="did you mean ellipsoid"):
        draw_all(pendulum, tmp_path, only=["elipsoid"])
    with pytest.raises(InputError, match="no format 'gif'"):
        draw_all(pendulum, tmp_path, ("gif",))
    with pytest.raises(InputError, match="no path to draw"):
        draw_all(panda, tmp_path, only=["nullspace"])
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="cannot be written"):
        draw_all(pendulum, tmp_path / "file", ("png",), only=["jump"])
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


# ---- what the figures say ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("figure", FIGURES.values(), ids=FIGURES)
def test_no_figure_shows_H_alone(figure: object, tilthex: ResultView) -> None:
    text = text_of(figure(tilthex))  # type: ignore[operator]
    for name in ("H", "G", "V", "S", "E"):
        before, after = (number(getattr(f, name)) for f in (tilthex.before, tilthex.after))
        assert f"{name} {before} → {after}" in text
    for fact in ("tilthex_arm", "impact at ee", "objective impulse", "metric euclidean", "0.01 kg·m² (robot.toml)"):
        assert fact in text


def test_header_states_feet_and_title(solo8: ResultView) -> None:
    title, (facts, _) = header_lines(solo8)
    assert title == "solo8, impact at base_link"
    assert "contact-consistent, on FL_FOOT, FR_FOOT, HL_FOOT, HR_FOOT" in facts
    named = ResultView(solo8.robot, solo8.objective, solo8.q_initial, solo8.q_optimal, title="A push of $5")
    assert "robot solo8" in header_lines(named)[1][0]
    assert "A push of $5" in text_of(jump_figure(named))


def test_small_print_fits_the_page(solo8: ResultView) -> None:
    line = SEPARATOR.join(header_lines(solo8)[1] * 2)
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


def test_ellipsoid_panels_are_equal_and_tangents_touch(tilthex: ResultView) -> None:
    figure = ellipsoid_figure(tilthex)
    figure.draw_without_rendering()
    panels = [a for a in figure.axes if a.get_title().startswith("shadow")]
    assert [a.get_title() for a in panels] == ["shadow on xy", "shadow on xz", "shadow on yz"]
    for axes in panels:
        box = axes.get_window_extent()
        assert box.width == pytest.approx(box.height, rel=1e-6)
        assert axes.get_xlim() == axes.get_ylim() == panels[0].get_xlim()
        assert "(m/s, rad/s)/(N·s)" in axes.get_xlabel()
    # n is z: the xz panel has horizontal tangents at ±√H of both postures, and the curves end there.
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


def test_skeleton_meets_pinocchio(tilthex: ResultView, solo8: ResultView, pendulum: ResultView) -> None:
    for view in (tilthex, solo8, pendulum):
        model, data = view.robot.model, view.robot.model.createData()
        pin.framesForwardKinematics(model, data, view.q_optimal)
        seen = build_skeleton(view, view.q_optimal)
        frame = view.robot.frame_id(view.objective.contact.frame)
        np.testing.assert_allclose(seen.contact, data.oMf[frame].translation, atol=1e-12)
        for support, foot in zip(view.objective.supports, seen.feet, strict=True):
            place = data.oMf[view.robot.frame_id(support.frame)]
            np.testing.assert_allclose(foot, place.act(np.array(support.offset)), atol=1e-12)
    assert len(build_skeleton(solo8, solo8.q_initial).feet) == 4
    rotors = build_skeleton(tilthex, tilthex.q_initial).rotors
    centers = rotors.mean(axis=2) - tilthex.q_initial[:3]
    expected = [r.position for r in tilthex.robot.spec.propulsion.rotors]  # type: ignore[union-attr]
    np.testing.assert_allclose(centers, expected, atol=1e-9)
    # Both links of the pendulum are there, the second one down to its center of mass.
    assert len({tuple(p.round(9)) for bone in build_skeleton(pendulum, pendulum.q_optimal).bones for p in bone}) == 4


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
        first, second = (build_skeleton(view, q) for q in (view.q_initial, view.q_optimal))
        plane = side_plane(first, second)
        assert plane.contains(second.normal)
        inside = plane.axes @ np.vstack([first.points, second.points]).T
        assert (inside[0] > x0).all() and (inside[0] < x1).all() and (inside[1] > y0).all() and (inside[1] < y1).all()


def test_jump_bars_carry_the_jump(tilthex: ResultView, panda: ResultView) -> None:
    figure = jump_figure(tilthex)
    panels = np.array(figure.axes).reshape(3, 2)
    for column, factor in ((0, [1.0, 1.0]), (1, [0.6 / tilthex.before.G, 0.6 / tilthex.after.G])):
        widths = [[bar.get_width() for bar in axes.patches] for axes in panels[:, column]]
        # Each panel holds the bars before, then those after.
        drawn = [[w for panel in widths for w in np.split(np.array(panel), 2)[k]] for k in (0, 1)]
        for state, values, gain in zip((tilthex.before, tilthex.after), drawn, factor, strict=True):
            np.testing.assert_allclose(values, gain * state.jump, rtol=1e-12)
    assert [axes.get_xlabel() for axes in panels[:, 1]] == ["m/s", "rad/s", "rad/s"]
    units = velocity_units(panda.robot)
    assert [n for n, u in zip(panda.robot.tangent_names, units, strict=True) if u == "m/s"] == [
        "panda_finger_joint1",
        "panda_finger_joint2",
    ]
    assert [k for _, indices, _ in groups_of(panda) for k in indices] == list(range(9))


def test_path_curves(tilthex: ResultView) -> None:
    path = tilthex.path
    assert path is not None
    assert path.s[0] == 0 and (np.diff(path.s) > 0).all()
    curve = normalized(path, "H")
    assert curve is not None
    np.testing.assert_allclose(curve, path.H / tilthex.before.H)
    assert path.H[path.optimum] == pytest.approx(tilthex.after.H)


def wide_path(factor: float) -> PathData:
    s = np.linspace(0, 1, 9)
    S = np.where(s < 0.3, np.nan, 2.0)
    return PathData(s, H=np.geomspace(3, 3 * factor, 9), G=1 + s, V=2 - s, S=S, optimum=6)


@pytest.mark.parametrize(("factor", "scale"), [(0.1, "linear"), (0.01, "log")])
def test_path_axis_is_log_where_values_spread(factor: float, scale: str, panda: ResultView) -> None:
    path = wide_path(factor)
    view = ResultView(panda.robot, panda.objective, panda.q_initial, panda.q_optimal, path=path)
    (axes,) = path_figure(view).axes
    assert axes.get_yscale() == scale
    assert {"start", "optimum"} <= {t.get_text() for t in axes.texts}
    # S has no value at the start: it is divided by its first one, and starts where it exists.
    (S,) = (line for line in axes.lines if str(line.get_label()).startswith("S"))
    np.testing.assert_array_equal(np.isnan(S.get_ydata()), np.isnan(path.S))
    assert np.nanmax(S.get_ydata()) == 1.0


def test_path_of_wrong_shape(panda: ResultView) -> None:
    path = PathData(np.arange(3.0), np.ones(3), np.ones(2), np.ones(3), np.ones(3))
    view = ResultView(panda.robot, panda.objective, panda.q_initial, panda.q_optimal, path=path)
    with pytest.raises(InputError, match="G \\(2,\\)"):
        path_figure(view)
