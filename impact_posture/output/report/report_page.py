"""Write the HTML page of a report.  Only the 3-D viewer of the page needs a script."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from impact_posture.errors import printable
from impact_posture.output.plot.result_view import number
from impact_posture.output.report import REPORT
from impact_posture.output.report.report_scene import ReportScene, Track, zipped
from impact_posture.system.output_folder import added_files, write_whole
from impact_posture.system.text_files import read_bytes
from impact_posture.version import __version__

_VIEWER = Path(__file__).parent / "viewer"
_TYPES = {".png": "image/png", ".svg": "image/svg+xml"}
# Area of the curve in a chart, in units of the SVG view box.
_LEFT, _RIGHT, _TOP, _BOTTOM = 60.0, 390.0, 8.0, 92.0


@dataclass(frozen=True)
class Table:
    """Table of a report.  The first cell of a row is a name; other cells are numbers or short texts."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Content:
    """Texts and tables of a report.

    Attributes:
        title: Title of the page.
        command: Command that reproduces the result.
        facts: Notes on robot, contact and settings.
        verdict: Lines at the top, the most important line first.
        tables: Tables of numbers.
        moves: Sentences that explain what the slider moves.
        notes: Further notes, such as warnings.
        sources: Name and content of the files that the command reads.
    """

    title: str
    command: str
    facts: tuple[str, ...]
    verdict: tuple[str, ...]
    tables: tuple[Table, ...]
    moves: str
    notes: tuple[str, ...]
    sources: tuple[tuple[str, str], ...] = ()


def write_page(folder: Path, content: Content, scene: ReportScene, force: bool | None = None) -> Path:
    """Write ``report.html`` into a folder; return its path.  The page contains the figures in the folder.

    ``force`` is ``None`` for a new folder.  In another folder, ``force`` says whether the page may replace a file of
    the user.

    Raises:
        OutputError: The page would replace a file of the user, or cannot be written.
    """
    page = render(content, scene, figures(folder))
    with nullcontext(folder) if force is None else added_files(folder, force=force) as into:
        write_whole(into / REPORT, page)
    return folder / REPORT


def render(content: Content, scene: ReportScene, pictures: Sequence[tuple[str, str]]) -> str:
    """Return the page.  All texts are escaped.  The page loads no other files and runs only its own viewer."""
    packed, arrays = scene.packed
    files = ("viewer.min.js", "loader.js", "page.css")
    viewer, loader, style = ((_VIEWER / name).read_text(encoding="utf-8") for name in files)
    # In HTML, a script element ends at the first "</script", even within JSON text.
    data = packed.replace("<", "\\u003c")
    text: str = _template("page").render(
        content=content, scene=scene, pictures=pictures, data=data, arrays=arrays, style=style, loader=loader,
        viewer=zipped(viewer.encode()), license=viewer.partition("*/")[0].partition("/*!")[2].strip(),
        version=__version__, charts=[_charts(track) for track in scene.tracks],
        hashes={"viewer": _hash(viewer), "loader": _hash(loader), "style": _hash(style)},
    )  # fmt: skip
    return text


def render_summary(verdict: Sequence[str], tables: Sequence[Table], pictures: Sequence[tuple[str, str]]) -> str:
    """Return pictures, verdict and tables as HTML without a script.  All texts are escaped."""
    text: str = _template("summary").render(content={"verdict": verdict, "tables": tables}, pictures=pictures)
    return text


def figures(folder: Path) -> list[tuple[str, str]]:
    """Return name and data URL of each figure in a folder and its subfolders.  SVG files are preferred to PNG."""
    # Skip symbolic links, because the page would contain their targets, which may not belong to the result.
    paths = (p for p in sorted(folder.rglob("*")) if p.suffix in _TYPES and p.is_file() and not p.is_symlink())
    # In the sorted list, an SVG file follows the PNG file with the same name and replaces it.
    by_name = {str(path.relative_to(folder).with_suffix("")): path for path in paths}
    return [
        (name, f"data:{_TYPES[path.suffix]};base64,{base64.b64encode(read_bytes(path)).decode('ascii')}")
        for name, path in by_name.items()
    ]


def _hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")


@cache
def _template(name: str) -> Any:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    def shown(value: object) -> object:
        return printable(value, keep="\n\t") if isinstance(value, str) and not isinstance(value, Markup) else value

    # Jinja escapes every text, and ``shown`` replaces control characters.
    environment = Environment(
        loader=FileSystemLoader(_VIEWER), autoescape=True, undefined=StrictUndefined, finalize=shown,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    return environment.get_template(f"{name}.html.jinja")


def _charts(track: Track) -> list[dict[str, Any]]:
    charts = []
    x = _LEFT + (_RIGHT - _LEFT) * (track.times - track.times[0]) / ((track.times[-1] - track.times[0]) or 1.0)
    for name, unit, values in track.curves:
        known = np.isfinite(values)
        low, high = (float(values[known].min()), float(values[known].max())) if known.any() else (0.0, 0.0)
        low = min(low, 0.0) if low < 0.4 * high else low
        y = _BOTTOM - (_BOTTOM - _TOP) * (values - low) / ((high - low) or 1.0)
        # A dictionary removes repeated points, because frames 1 ms apart often have the same rounded position.
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
