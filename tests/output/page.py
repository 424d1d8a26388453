"""Check a page of figures for layout defects."""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from mpl_toolkits.mplot3d import Axes3D

from impact_posture.output.plot.style import lay_out

# Threshold for the darkest color channel: lines are darker; grids, walls and faint fills are lighter.
_INK = 0.6
_NUMBER = re.compile("[−0-9.e]+")


@dataclass(frozen=True)
class Words:
    """Placed text: center of its box, half side lengths, and rotation matrix, in pixels."""

    text: str
    center: np.ndarray
    half: np.ndarray
    turn: np.ndarray

    @classmethod
    def of(cls, text: Text) -> Words:
        box, angle = text.get_window_extent(), np.radians(text.get_rotation())
        c, s = abs(np.cos(angle)), abs(np.sin(angle))
        size = text.get_fontsize() * text.figure.get_dpi() / 72 * (1 + 1.3 * text.get_text().count("\n"))
        # The box of a rotated text is smaller than the upright box around it.
        width = (box.width - size * s) / c if c > s else (box.height - size * c) / s
        height = box.height if s < 0.01 else box.width if c < 0.01 else size
        center = np.array([box.x0 + box.width / 2, box.y0 + box.height / 2])
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        return cls(text.get_text(), center, np.array([width, height]) / 2, turn)

    def holds(self, points: np.ndarray, less: float = 1.0) -> np.ndarray:
        """Return which points, shape (n, 2), lie inside the box, at least ``less`` pixels from its edge."""
        return (np.abs((points - self.center) @ self.turn.T) < self.half - less).all(axis=1)

    @property
    def points(self) -> np.ndarray:
        """Return a grid of points inside the box, shape (n, 2)."""
        x, y = (np.linspace(-h + 1, h - 1, max(int(h), 3)) for h in self.half)
        return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2) @ self.turn + self.center


def defects(figure: Figure) -> list[str]:
    """List defects: texts that overlap texts or lines or leave the page, axes without units, several legends."""
    figure.set_dpi(100)
    canvas = FigureCanvasAgg(figure)
    # Computing the layout also draws the figure, which determines the positions of all texts.
    lay_out(figure)
    texts = [t for t in figure.findobj(Text) if t.get_visible() and t.get_text().strip() and _shown(t, figure)]
    words = [Words.of(text) for text in texts]
    problems = [
        f"'{one.text}' stands on '{other.text}'"
        for one, other in combinations(words, 2)
        if np.linalg.norm(one.center - other.center) < np.linalg.norm(one.half) + np.linalg.norm(other.half)
        and other.holds(one.points).any()
    ]
    for text in texts:
        # Hide the texts and their background boxes, because a background box would hide lines below a text.
        text.set_visible(False)
    canvas.draw()
    image = np.asarray(canvas.buffer_rgba())[::-1, :, :3].min(axis=2) / 255
    dark = np.argwhere(image < _INK)[:, ::-1] + 0.5
    for text in texts:
        text.set_visible(True)
    height, width = image.shape
    for one in words:
        if one.holds(dark).any():
            problems.append(f"'{one.text}' stands on a line")
        corners = one.center + (np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]]) * one.half) @ one.turn
        if (corners < -1).any() or (corners > np.array([width, height]) + 1).any():
            problems.append(f"'{one.text}' is off the page")
    legends = [legend for part in figure.subfigs for legend in part.legends]
    legends += [axes.get_legend() for axes in figure.axes if axes.get_legend() is not None]
    if len(legends) > 1:
        problems.append(f"{len(legends)} legends")
    return problems + [f"no unit on an axis '{label}'" for label in labels(figure) if "[" not in label]


def check_page(figure: Figure) -> None:
    """Check that a page has no defects, and that its parts neither leave their places nor overlap."""
    assert defects(figure) == []
    head, body, foot = figure.subfigs
    for part in (head, foot):
        for words in part.texts:
            box = words.get_window_extent()
            assert box.y0 >= part.bbox.y0 and box.y1 <= part.bbox.y1
    # Boxes that only touch do not overlap, so shrink each box by one pixel.
    boxes = [axes.get_tightbbox().padded(-1) for axes in body.axes if axes.get_visible()]
    for legend in body.legends:
        box = legend.get_window_extent()
        assert box.x0 >= 0 and box.x1 <= body.bbox.x1 and not any(box.overlaps(other) for other in boxes)
    for box in boxes:
        assert box.x0 >= 0 and box.x1 <= body.bbox.x1
        assert box.y0 >= body.bbox.y0 and box.y1 <= body.bbox.y1


def _shown(text: Text, figure: Figure) -> bool:
    """Whether a text is visible; labels of ticks beyond the end of an axis are invisible."""
    for axes in figure.axes:
        for axis in _axes(axes):
            every = [t.label1 for t in axis.majorTicks + axis.minorTicks] + [t.label2 for t in axis.majorTicks]
            if text in every:
                if not (axes.get_visible() and axes.axison):
                    return False
                low, high = sorted(axis.get_view_interval())
                slack = 1e-9 * (high - low)
                drawn = [t for t in axis.get_major_ticks() if low - slack <= t.get_loc() <= high + slack]
                return any(text in (t.label1, t.label2) for t in drawn)
            if text is axis.label:
                return bool(axes.get_visible() and axes.axison)
    return True


def _axes(axes: object) -> list[object]:
    return [getattr(axes, f"{name}axis") for name in ("xyz" if isinstance(axes, Axes3D) else "xy")]


def labels(figure: Figure) -> list[str]:
    """Return the labels of all axes that show numbers."""
    names = []
    for axes in figure.axes:
        for axis in _axes(axes) if axes.axison and axes.get_visible() else ():
            numbers = [t.label1 for t in axis.get_major_ticks()] + [t.label2 for t in axis.get_major_ticks()]
            if axis.get_visible() and any(t.get_visible() and _NUMBER.fullmatch(t.get_text()) for t in numbers):
                names.append(axis.label.get_text())
    return names
