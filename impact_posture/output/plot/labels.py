"""Place the letters that name points in a figure where they cover no lines."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Annotation
from mpl_toolkits.mplot3d import proj3d
from numpy.typing import NDArray

from impact_posture.output.plot.ellipsoid_shapes import Plane
from impact_posture.system.arrays import Array

# Distances of a letter from its position that are tried, points (1/72 inch).
_GAPS = (2.0, 5.0, 9.0, 14.0, 20.0, 27.0, 36.0)
# Directions from the position to the letter that are tried, rad.
_ANGLES = np.linspace(0.0, 2 * np.pi, 24, endpoint=False)
# Smallest distance of a letter from drawn lines, points (1/72 inch).
_CLEAR = 1.4
# Pixels darker than this, 0 (black) to 255, count as lines.  With this limit, thin gray lines count, and grids do
# not.
_INK = 205


class Label(Annotation):
    """Letter next to ``point``, shape (2,) or (3,) in data coordinates, preferably in the direction ``toward``.

    :func:`draw_with_labels` determines its position.
    """

    def __init__(
        self, text: str, point: Array, toward: tuple[float, float] = (0.0, 1.0), color: str = "black"
    ) -> None:
        super().__init__(
            text, (0.0, 0.0), (0.0, 0.0), textcoords="offset points", fontstyle="italic", ha="center", va="center",
            color=color, zorder=7, annotation_clip=False,
        )  # fmt: skip
        self.point = np.asarray(point, dtype=float)
        self.toward = toward
        # Letters get their positions after the layout of the figure, so the layout must ignore letters.
        self.set_in_layout(False)


def draw_arrow(axes: Any, tail: Array, tip: Array, zorder: float, **look: Any) -> None:
    """Draw an arrow between two points of a panel, each of shape (2,)."""
    look = {"arrowstyle": "-|>", "shrinkA": 0, "shrinkB": 0} | look
    axes.annotate("", tuple(tip), tuple(tail), arrowprops=look, zorder=zorder)


def draw_end_on(axes: Any, name: str, plane: Plane, n: Array, at: Array, color: str = "black") -> None:
    """Draw a normal that is perpendicular to the plane: a dot in a ring (towards the reader) or a cross (away)."""
    toward = float(np.cross(plane.axes[0], plane.axes[1]) @ n)
    look = {"linestyle": "", "markeredgecolor": color, "zorder": 6.5}
    axes.plot(*at[:, None], marker="o", markersize=8, markerfacecolor="white", markeredgewidth=1, **look)
    axes.plot(*at[:, None], marker="." if toward > 0 else "x", markersize=4, color=color, **look)
    axes.add_artist(Label(name, at, (1.0, 1.0), color))


def draw_with_labels(canvas: FigureCanvasAgg) -> None:
    """Draw the figure of a canvas after its layout, with each :class:`Label` where it covers no lines."""
    labels = [(axes, text) for axes in canvas.figure.axes for text in axes.texts if isinstance(text, Label)]
    for _, label in labels:
        label.set_visible(False)
    canvas.draw()
    # The first row of the image is the top, but coordinates count from the bottom.
    image = np.asarray(canvas.buffer_rgba())[::-1] if labels else np.zeros((0, 0, 4), np.uint8)
    # Two calls of np.minimum take a fifth of the time of ``min`` over the last axis.
    ink = np.minimum(np.minimum(image[..., 0], image[..., 1]), image[..., 2]) < _INK
    for axes, label in labels:
        label.set_visible(True)
        _place(axes, label, ink)
        label.draw(canvas.get_renderer())


def _place(axes: Any, label: Label, ink: NDArray[np.bool_]) -> None:
    """Move a letter to the best position, and mark its pixels in ``ink``, shape (height, width), lowest row first."""
    point = label.point
    if len(point) == 3:
        point = np.array(proj3d.proj_transform(*point, axes.get_proj())[:2])
    label.xy = tuple(point)
    anchor = np.asarray(axes.transData.transform(point))
    box, scale = label.get_window_extent(), axes.figure.dpi / 72
    half = np.array([box.width, box.height]) / 2 + _CLEAR * scale
    best, taken, place = np.inf, ink[:0], anchor
    for gap in _GAPS:
        if gap - 6.0 > best:
            break
        for angle in _ANGLES:
            direction = np.array([np.cos(angle), np.sin(angle)])
            center = anchor + direction * (gap * scale + float(np.abs(direction) @ half))
            low, high = center - half, center + half
            if (low < axes.bbox.min).any() or (high > axes.bbox.max).any():
                continue
            (left, bottom), (right, top) = np.rint(low).astype(int), np.rint(high).astype(int)
            covered = ink[bottom:top, left:right]
            cost = 25.0 * covered.sum() + gap - 6.0 * float(direction @ np.array(label.toward))
            if cost < best:
                best, taken, place = cost, covered, center
    label.xyann = tuple((place - anchor) / scale)
    taken[:] = True
