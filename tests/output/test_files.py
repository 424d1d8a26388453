"""Figures in all formats, pages without overlap, degenerate robots, and invalid input."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import matplotlib
import matplotlib.image
import numpy as np
import pytest
from matplotlib.figure import Figure

from impact_posture.errors import InputError, OutputError
from impact_posture.output.plot import FIGURES, FORMATS, FigureNotFound, ResultView, draw_all, postures_figure
from impact_posture.output.plot.classical_figure import classical_figure
from impact_posture.output.plot.ellipsoid_figure import ellipsoid_figure
from impact_posture.output.plot.jump_figure import jump_figure
from impact_posture.output.plot.path_figures import path_figure, tradeoff_figure
from impact_posture.output.plot.self_motion_figure import self_motion_figure
from impact_posture.output.plot.style import WIDTH
from tests.output.page import check_page, defects
from tests.output.views import PENDULUM, make_view, text_of


def test_figures_are_written_in_all_formats(tilthex: ResultView, tmp_path: Path) -> None:
    # Surfaces and hatched areas are written in every format, the other figures in one format each.
    first = draw_all(tilthex, tmp_path / "figures", FORMATS, only=["ellipsoid", "jump"])
    assert [p.name for p in first] == [f"{n}.{f}" for n in ("ellipsoid", "jump") for f in ("png", "svg", "pdf")]
    paths = first + draw_all(tilthex, tmp_path / "figures", (".PNG",), only=["postures"])
    others = ["nullspace", "classical", "tradeoff", "path"]
    paths += draw_all(tilthex, tmp_path / "figures", ("svg", "svg"), only=others)
    paths += draw_all(tilthex, tmp_path / "figures", only=["self_motion"])
    assert len(paths) == len(set(paths)) == 12
    assert {p.stem for p in paths} == set(FIGURES)
    for path in paths:
        assert path.stat().st_size > 8_000, path
        if path.suffix == ".png":
            image = matplotlib.image.imread(path)
            assert image.shape[1] == round(200 * WIDTH)
            # The drawing reaches the left, right, top and bottom part of the page.
            rows, columns = (image[..., :3].min(axis=2) < 0.9).nonzero()
            assert rows.min() < 0.1 * len(image) < 0.8 * len(image) < rows.max()
            assert columns.min() < 0.1 * image.shape[1] < 0.8 * image.shape[1] < columns.max()
        elif path.suffix == ".svg":
            assert ElementTree.parse(path).getroot().tag.endswith("svg")
        else:
            content = path.read_bytes()
            assert content.startswith(b"%PDF") and b"/Type3" not in content and b"/CreationDate" not in content


@pytest.mark.long
def test_the_same_view_gives_the_same_files(pendulum: ResultView, tmp_path: Path) -> None:
    (first,) = draw_all(pendulum, tmp_path / "a", ("svg",), only=["ellipsoid"])
    (second,) = draw_all(pendulum, tmp_path / "b", ("svg",), only=["ellipsoid"])
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.long(
    but=(
        "postures_figure-two_hands",
        "postures_figure-turned",
        "jump_figure-talos",
        "ellipsoid_figure-solo8_cone",
        "ellipsoid_figure-turned",
        "classical_figure-pendulum",
        "self_motion_figure-tilthex",
        "tradeoff_figure-tilthex",
        "path_figure-pendulum",
    )
)
@pytest.mark.skipif(
    matplotlib.__version_info__ < (3, 11), reason="before 3.11 matplotlib puts a label here and there on a line"
)
@pytest.mark.parametrize(
    ("figure", "name"),
    [
        *(
            (postures_figure, name)
            for name in ("talos", "tilthex", "solo8", "pendulum", "turned", "two_hands", "panda")
        ),
        *((jump_figure, name) for name in ("talos", "panda")),
        *((ellipsoid_figure, name) for name in ("solo8", "solo8_cone", "torso", "turned", "pendulum")),
        *((classical_figure, name) for name in ("talos", "turned", "pendulum")),
        *((self_motion_figure, name) for name in ("tilthex", "surface")),
        (tradeoff_figure, "tilthex"),
        (path_figure, "pendulum"),
    ],
)
def test_pages_have_no_defects(
    figure: Callable[[ResultView], Figure], name: str, request: pytest.FixtureRequest
) -> None:
    check_page(figure(request.getfixturevalue(name)))


def test_defects_are_found(monkeypatch: pytest.MonkeyPatch, turned: ResultView) -> None:
    monkeypatch.setattr("impact_posture.output.plot.style.draw_with_labels", lambda figure: None)
    page = postures_figure(turned)
    _, flat = page.axes
    flat.set_xlabel("x")
    flat.text(0.5, 0.5, "one", transform=flat.transAxes)
    flat.text(0.5, 0.51, "other", transform=flat.transAxes)
    flat.plot([], [], label="line")
    flat.legend()
    problems = defects(page)
    assert "'one' stands on 'other'" in problems and "2 legends" in problems and "no unit on an axis 'x'" in problems
    flat.plot(np.mean(flat.get_xlim()), np.mean(flat.get_ylim()), "ks", markersize=30)
    assert "'one' stands on a line" in defects(page)


def test_degenerate_robot_draws(pendulum: ResultView) -> None:
    assert np.linalg.matrix_rank(pendulum.after.ellipsoid, tol=1e-9) < 3
    words = {
        "classical": "force unbounded: a strip",
        "ellipsoid": "S undefined",
        "jump": "Diamonds: with friction 0.7 the contact point",
        "nullspace": "S is undefined along the path",
        "path": "Note: a reason.",
        "postures": "seen along −x",
        "self_motion": "runs from one limit to another",
        "tradeoff": "S is undefined at these postures",
    }
    for name, build in FIGURES.items():
        figure = build(pendulum)
        figure.draw_without_rendering()
        assert words[name] in text_of(figure)


def test_a_contact_that_cannot_move_draws() -> None:
    # Perpendicular to its plane, the pendulum cannot move: H = G = 0, and V is infinite.
    view = make_view(PENDULUM, (1, 0, 0), q0=np.array([0.4, 0.9]))
    assert view.before.G == view.after.G == 0
    assert "G = 0" in text_of(jump_figure(view))
    for figure in (ellipsoid_figure(view), jump_figure(view), path_figure(view)):
        figure.draw_without_rendering()


def test_a_turning_normal_is_drawn_twice() -> None:
    view = make_view("ur5", (0.3, 0.4, 1), normal_frame="contact", path=False)
    for figure in (ellipsoid_figure(view), classical_figure(view)):
        assert {"n₀", "n₁", "n₀ before, n₁ after"} <= set(text_of(figure).split(" | "))
    figure.draw_without_rendering()


def test_user_settings_are_put_back_and_ignored(pendulum: ResultView, tmp_path: Path) -> None:
    (clean,) = draw_all(pendulum, tmp_path / "clean", ("svg",), only=["jump"])
    with matplotlib.rc_context({"font.size": 21.0, "axes.facecolor": "red", "savefig.dpi": 37}):
        (changed,) = draw_all(pendulum, tmp_path / "changed", ("svg",), only=["jump"])
        assert matplotlib.rcParams["font.size"] == 21.0
    assert clean.read_bytes() == changed.read_bytes()


def test_bad_input(pendulum: ResultView, panda: ResultView, tmp_path: Path) -> None:
    with pytest.raises(FigureNotFound, match="did you mean ellipsoid"):
        draw_all(pendulum, tmp_path, only=["elipsoid"])
    with pytest.raises(InputError, match="no format 'gif'"):
        draw_all(pendulum, tmp_path, ("gif",))
    for name, words in {"nullspace": "no path to draw", "tradeoff": "no trade-off to draw.*`tradeoff`"}.items():
        with pytest.raises(InputError, match=words):
            draw_all(panda, tmp_path, only=[name])
    with pytest.raises(InputError, match=r"no map to draw.*`search` global"):
        draw_all(panda, tmp_path, only=["self_motion"])
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="cannot be written"):
        draw_all(pendulum, tmp_path / "file", ("png",), only=["jump"])
    assert [p.name for p in tmp_path.iterdir()] == ["file"]
