"""Style of all figures: colors, sizes, header and legend.  Lay out figures and save them."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import text_to_path
from matplotlib.transforms import Bbox
from PIL import Image

from impact_posture.errors import OutputError, printable
from impact_posture.output.picture_formats import DEFAULT_FORMATS, check_formats
from impact_posture.output.plot.labels import draw_with_labels
from impact_posture.output.plot.result_view import SEPARATOR
from impact_posture.system.output_folder import check_name
from impact_posture.system.scratch_folder import scratch_folder

# Color-blind-safe palette of Okabe and Ito, "Color Universal Design", 2008.
VERMILLION, BLUE, GREEN, SKY, PURPLE, ORANGE = "#D55E00", "#0072B2", "#009E73", "#56B4E9", "#CC79A7", "#E69F00"
INK, GRAY, PALE = "#000000", "#6b6b6b", "#d9d9d9"

# Lines for "before" and "after" also differ in line style and hatch, so they are distinguishable in a gray print.
# The dashed line is on top, so a solid line at the same place is visible in the gaps.
BEFORE: dict[str, Any] = {"color": VERMILLION, "linestyle": (0, (4, 2)), "linewidth": 1.4, "zorder": 3.5}
AFTER: dict[str, Any] = {"color": BLUE, "linestyle": "-", "linewidth": 1.6, "zorder": 3.0}
# Lines for the robot without supports are thinner and have other dashes.
FREE_BEFORE: dict[str, Any] = {"color": VERMILLION, "linestyle": (0, (1, 1.6)), "linewidth": 1.0, "zorder": 2.8}
FREE_AFTER: dict[str, Any] = {"color": BLUE, "linestyle": (0, (6, 1.6, 1, 1.6)), "linewidth": 0.9, "zorder": 2.6}
# Styles of the arrows that show the worst normals of a cone.
WORST_BEFORE: dict[str, Any] = {"color": VERMILLION, "linestyle": (0, (3, 1.5)), "linewidth": 1.1}
WORST_AFTER: dict[str, Any] = {"color": BLUE, "linestyle": "-", "linewidth": 1.1}
BEFORE_BAR: dict[str, Any] = {"facecolor": "#fbe3d3", "edgecolor": VERMILLION, "hatch": "//////", "linewidth": 0.6}
AFTER_BAR: dict[str, Any] = {"facecolor": BLUE, "edgecolor": BLUE, "linewidth": 0.6}
# Colors of time windows in figures of runs; the two colors also differ in a gray print.
SHADES: dict[str, dict[str, Any]] = {
    "dwell": {"facecolor": "#f0f0f0", "edgecolor": "none", "zorder": 0.1},
    "impact": {"facecolor": "#edc3d6", "edgecolor": "none", "zorder": 0.2},
}
# Colors of the range of commands, and of the robot at the start of a run.
BAND: dict[str, Any] = {"facecolor": "#dcdcdc", "edgecolor": "none", "zorder": 1.2}
START: dict[str, Any] = {"color": "#a9a9a9", "linestyle": "-", "linewidth": 1.0, "zorder": 2.0}

# Width of a two-column page, inches.
WIDTH = 7.2
# Font sizes, points: text, legends, small print and tick numbers, and tick numbers in 3-D.
TEXT, LEGEND, SMALL, TINY = 8.0, 7.5, 7.0, 6.5
_LONGEST_TITLE = 85
_LINE = 0.15
_RC: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": TEXT,
    "axes.titlesize": 8.5,
    "xtick.labelsize": SMALL,
    "ytick.labelsize": SMALL,
    "legend.fontsize": LEGEND,
    "axes.linewidth": 0.7,
    "axes.axisbelow": True,
    # A fixed position of the title saves time: by default, matplotlib searches for ticks above every panel.
    "axes.titley": 1.0,
    "grid.color": PALE,
    "grid.linewidth": 0.5,
    "hatch.linewidth": 0.5,
    "legend.frameon": False,
    "figure.dpi": 200,
    # At this resolution, letters need no hinting.  Hinting takes a third of the time to draw letters.
    "text.hinting": "none",
    # PDF files use TrueType fonts, because publishers reject Type 3 fonts.
    "pdf.fonttype": 42,
    # With a fixed salt, equal figures have equal SVG files.
    "svg.hashsalt": "impact-posture",
}


@contextmanager
def style() -> Iterator[None]:
    """Use the matplotlib settings of this package within the block, and restore the previous settings afterwards."""
    with matplotlib.rc_context(), warnings.catch_warnings():
        # If a font lacks a letter, matplotlib draws a box and warns.  The box is enough, so the warning is ignored.
        warnings.filterwarnings("ignore", "Glyph .* missing from font")
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_RC)
        yield


@contextmanager
def framed(
    title: str, lines: Sequence[str], height: float, notes: Sequence[str] = ()
) -> Iterator[tuple[Figure, Any]]:
    """Yield a figure with a header and notes, and the subfigure for the panels, ``height`` inches high.

    ``lines`` are small print below the title.  ``notes`` are sentences below the panels.  Long lines are wrapped.
    Within the block, :func:`style` applies.
    """
    title = printable(title, longest=_LONGEST_TITLE)
    small = [part for line in lines for part in wrap(printable(line), SEPARATOR)]
    below = wrap(" ".join(notes), " ")
    head, foot = 0.26 + _LINE * len(small), 0.06 + _LINE * len(below)
    with style():
        figure = Figure(figsize=(WIDTH, head + height + foot), layout="constrained")
        parts: Any = figure.subfigures(3, 1, height_ratios=[head, height, foot])
        top, body, bottom = parts
        look = {"fontsize": SMALL, "va": "top", "linespacing": 1.4}
        top.text(0.012, 1 - 0.06 / head, title, fontsize=10, fontweight="bold", va="top", parse_math=False)
        top.text(0.012, 1 - 0.26 / head, "\n".join(small), parse_math=False, **look)
        bottom.text(0.012, 1, "\n".join(below), color="#333333", **look)
        yield figure, body


def wrap(line: str, separator: str) -> list[str]:
    """Split a line of small print at separators, so that every part fits the width of the page."""
    parts, room, used = [""], 72 * WIDTH * 0.975, 0.0
    for piece in line.split(separator):
        # Measure each piece with its separator, because the cache of ``text_width`` contains most of these texts.
        width = text_width(f"{separator}{piece}".replace("$", ""), SMALL)
        if parts[-1] and used + width > room:
            parts.append("")
            used = 0.0
        parts[-1] += f"{separator}{piece}" if parts[-1] else piece
        used += width
    return [part for part in parts if part]


@lru_cache(maxsize=4096)
def text_width(text: str, size: float) -> float:
    """Return the width of a text at a font size, points."""
    font = FontProperties(family="DejaVu Sans", size=size)
    return float(text_to_path.get_text_width_height_descent(text, font, ismath=False)[0])


def shared_legend(body: Any, handles: Sequence[Any], place: str) -> None:
    """Put the legend of a figure above (``upper``) or below (``lower``) its panels, across the page."""
    size, handle, gap, room = LEGEND, 2.2, 1.4, 72 * WIDTH * 0.96
    widths = [text_width(str(h.get_label()).replace("$", ""), size) + size * (handle + 0.8 + gap) for h in handles]

    def width(columns: int) -> float:
        # Matplotlib fills a legend column by column.
        rows = -(-len(widths) // columns)
        return sum(max(widths[k : k + rows]) for k in range(0, len(widths), rows))

    columns = next((n for n in range(len(handles), 1, -1) if width(n) <= room), 1)
    # Use as few columns as this number of rows permits.
    columns = -(-len(handles) // -(-len(handles) // columns))
    look = {"ncols": columns, "handlelength": handle, "columnspacing": gap}
    body.legend(handles=list(handles), loc=f"outside {place} center", **look)


def lay_out(figure: Figure) -> FigureCanvasAgg:
    """Lay out a figure once, so that it looks the same in every format; return its image."""
    # Without a canvas, each round of the layout would create another image.
    canvas, engine = FigureCanvasAgg(figure), cast(Any, figure.get_layout_engine())
    if engine is not None:
        # Panels with equal scales change their size in the first round of the layout.  Two more rounds adjust their
        # positions.
        equal = [axes for axes in figure.axes if axes.name == "3d" or axes.get_aspect() != "auto"]
        for axes in equal:
            _measure_once(axes)
        for _ in range(3 if equal else 1):
            engine.execute(figure)
        for axes in equal:
            del axes.get_tightbbox
        # With a layout engine, ``savefig`` would draw the figure twice.
        figure.set_layout_engine(None)
        # Round positions, because the last digits of the layout differ between runs.
        for part in figure.subfigs:
            box = part.bbox_relative
            box.p0, box.p1 = np.round(box.p0, 6), np.round(box.p1, 6)
        for axes in figure.axes:
            axes.set_position(np.round(axes.get_position(original=True).bounds, 6))
    draw_with_labels(canvas)
    return canvas


def _measure_once(axes: Any) -> None:
    """Measure the texts around a 2-D panel only twice, because measuring takes long.

    The space around a 2-D panel depends on its ticks, which do not change after the first round of the layout.
    """
    measure = axes.get_tightbbox
    around: list[Any] = []

    def get_tightbbox(renderer: Any = None, **more: Any) -> Any:
        if axes.name != "3d" and len(around) == 2:
            axes.apply_aspect()
            return Bbox.from_extents(*(axes.bbox.extents + around[-1]))
        box = measure(renderer, **more)
        around.append(box.extents - axes.bbox.extents)
        return box

    axes.get_tightbbox = get_tightbbox


def save_all(figures: Mapping[str, Figure], out_dir: Path, formats: Iterable[str] = DEFAULT_FORMATS) -> list[Path]:
    """Write ``figures``, name → figure, with :func:`save`; return the paths."""
    return [path for name, figure in figures.items() for path in save(figure, out_dir, name, formats)]


@contextmanager
def _undated() -> Iterator[None]:
    """Hide SOURCE_DATE_EPOCH, because Matplotlib fails if the value is not a number."""
    date = os.environ.pop("SOURCE_DATE_EPOCH", None)
    try:
        yield
    finally:
        if date is not None:
            os.environ["SOURCE_DATE_EPOCH"] = date


def save(figure: Figure, out_dir: Path, name: str, formats: Iterable[str] = DEFAULT_FORMATS) -> list[Path]:
    """Write ``out_dir/name.<format>`` for each format; return the paths.  An error leaves no incomplete file.

    Raises:
        InputError: A format is unknown.
        OutputError: The folder or a file cannot be written.
    """
    paths = [Path(out_dir) / f"{name}.{extension}" for extension in check_formats(formats)]
    check_name(Path(out_dir))
    with style():
        canvas = lay_out(figure)
    for path in paths:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with scratch_folder(path.parent) as beside, style():
                if path.suffix == ".png":
                    # Save the image directly, because ``savefig`` would draw the figure again.  Lines and letters
                    # need few colors, and 256 colors make the file less than half as large.
                    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
                    picture = picture.quantize(method=Image.Quantize.MAXCOVERAGE)
                    picture.save(beside / path.name, dpi=(figure.dpi, figure.dpi))
                else:
                    # Files contain no date, so equal figures have equal files.
                    metadata = {"Date" if path.suffix == ".svg" else "CreationDate": None}
                    with _undated():
                        figure.savefig(beside / path.name, metadata=metadata)
                os.replace(beside / path.name, path)
        except OSError as error:
            raise OutputError.unwritable(path, error, "choose another folder") from None
    return paths
