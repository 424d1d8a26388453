"""The page of a report: words, tables, curves and figures that need no script, and a viewer that does."""

from __future__ import annotations

import base64
import hashlib
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from impact_posture.errors import SpecError, printable
from impact_posture.output.plot.result_view import number
from impact_posture.output.report import REPORT
from impact_posture.output.report.report_scene import ReportScene, Track, zipped
from impact_posture.system.output_folder import write_whole
from impact_posture.version import __version__

_VIEWER = Path(__file__).parent / "viewer"
# Colors of a figure: its lines and letters have few, and 64 keep it a quarter of the size.
_COLORS = 64
_TYPES = {".png": "image/png", ".svg": "image/svg+xml"}
# Place of a curve in its chart, in the units of its view box.
_LEFT, _RIGHT, _TOP, _BOTTOM = 60.0, 390.0, 8.0, 92.0


@dataclass(frozen=True)
class Table:
    """A table of text.

    Attributes:
        title: Title.
        head: Titles of the columns.
        rows: Cells; those after the first are numbers or short words.
    """

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Content:
    """What a page says beside its scene and figures.

    Attributes:
        title: Title.
        command: Command that makes the same result again.
        facts: Small print below the title.
        verdict: Lines, the most important first.
        tables: Tables.
        moves: What the slider goes through, in a sentence.
        notes: What to know, one line each.
        sources: Files that the command reads, by name, with their content.
    """

    title: str
    command: str
    facts: tuple[str, ...]
    verdict: tuple[str, ...]
    tables: tuple[Table, ...]
    moves: str
    notes: tuple[str, ...]
    sources: tuple[tuple[str, str], ...] = ()


def write_page(
    folder: Path, content: Content, scene: ReportScene, pictures: Sequence[tuple[str, str]] | None = None
) -> Path:
    """Write ``report.html`` into a folder; return its path.

    Args:
        folder: The folder.
        content: What the page says.
        scene: What its viewer shows.
        pictures: What :func:`figures` returns, if it is known.

    Raises:
        OutputError: It cannot be written.
    """
    write_whole(folder / REPORT, render(content, scene, figures(folder) if pictures is None else pictures))
    return folder / REPORT


def render(content: Content, scene: ReportScene, pictures: Sequence[tuple[str, str]]) -> str:
    """Return the page.  Each text of it is escaped, and it may load nothing and run nothing but its own viewer."""
    packed, arrays = scene.packed
    viewer, compressed = read_viewer()
    loader, style = ((_VIEWER / name).read_text(encoding="utf-8") for name in ("loader.js", "page.css"))
    # Scripts end at "</", wherever it stands.
    data = packed.replace("<", "\\u003c")
    text: str = load_template().render(
        content=content, scene=scene, pictures=pictures, data=data, arrays=arrays, style=style, loader=loader,
        viewer=compressed, license=viewer.partition("*/")[0].partition("/*!")[2].strip(),
        version=__version__, charts=[_charts(track) for track in scene.tracks],
        hashes={"viewer": _hash(viewer), "loader": _hash(loader), "style": _hash(style)},
    )  # fmt: skip
    return text


def figures(folder: Path, paths: Iterable[Path] | None = None) -> list[tuple[str, str]]:
    """Return name and address of figures in a folder: SVG if there is one, else PNG in fewer colors.  Links are none.

    Args:
        folder: The folder.
        paths: Files in it; all that it holds and that are below it by default.  While others write there, it cannot
            be searched, because their temporary folders vanish.
    """
    every = (path for path in (folder.rglob("*") if paths is None else paths) if path.suffix in _TYPES)
    # The file that a link leads to is not of the result, and the page would pass it on.
    found = sorted(path for path in every if path.is_file() and not path.is_symlink())
    # An SVG comes behind the PNG of the same name and takes its place.
    each = {str(path.relative_to(folder).with_suffix("")): path for path in found}
    return [(name, _address(path)) for name, path in each.items()]


def _address(path: Path) -> str:
    content = path.read_bytes()
    if path.suffix == ".png":
        from PIL import Image

        try:
            # Of another format, Pillow may start a program, such as Ghostscript.
            with Image.open(path, formats=("PNG",)) as picture, io.BytesIO() as file:
                picture.convert("RGB").quantize(_COLORS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(
                    file, "PNG", compress_level=6
                )
                content = file.getvalue()
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
            what = f"is no picture ({error})"
            raise SpecError(what, where=str(path), hint="remove it from the folder") from None
    return f"data:{_TYPES[path.suffix]};base64,{base64.b64encode(content).decode('ascii')}"


def _hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")


@cache
def read_viewer() -> tuple[str, str]:
    """Return the script of the viewer, and what :func:`zipped` makes of it, which takes long for the first time."""
    viewer = (_VIEWER / "viewer.min.js").read_text(encoding="utf-8")
    return viewer, zipped(viewer.encode())


@cache
def load_template() -> Any:
    """Return the template of a page, which takes long for the first time."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    def shown(value: object) -> object:
        return printable(value, keep="\n\t") if isinstance(value, str) and not isinstance(value, Markup) else value

    # Every text is escaped, and stripped of what turns the direction of writing.
    environment = Environment(
        loader=FileSystemLoader(_VIEWER), autoescape=True, undefined=StrictUndefined, finalize=shown,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    # The page names the command that makes it, so messages name its options.
    return environment.get_template("page.html.jinja")


def _charts(track: Track) -> list[dict[str, Any]]:
    """Return each curve of a track as lines in its chart, with the marks of its axes."""
    charts = []
    x = _LEFT + (_RIGHT - _LEFT) * (track.times - track.times[0]) / ((track.times[-1] - track.times[0]) or 1.0)
    for name, unit, values in track.curves:
        known = np.isfinite(values)
        low, high = (float(values[known].min()), float(values[known].max())) if known.any() else (0.0, 0.0)
        low = min(low, 0.0) if low < 0.4 * high else low
        y = _BOTTOM - (_BOTTOM - _TOP) * (values - low) / ((high - low) or 1.0)
        # Frames a millisecond apart mostly fall on the same place.
        points = [(f"{a:.1f},{b:.1f}", bool(good)) for a, b, good in zip(x, y, known, strict=True)]
        runs = [(good, dict(each)) for good, each in groupby(points, key=lambda point: point[1])]
        ends = [number(float(values[k])) for k in (0, -1)]
        charts.append({
            "name": name, "unit": unit, "lines": [" ".join(each) for good, each in runs if good],
            "low": number(low), "high": number(high),
            "first": number(float(track.times[0])), "last": number(float(track.times[-1])),
            "words": f"{name} from {ends[0]} to {ends[1]} {unit}".rstrip(),
        })  # fmt: skip
    return charts
