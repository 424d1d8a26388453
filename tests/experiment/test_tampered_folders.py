"""Folders of runs that somebody changed: one line that says so, or a page that passes on nothing but the runs."""

from __future__ import annotations

import io
import json
import shutil
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from impact_posture.errors import ImpactPostureError, SpecError
from impact_posture.experiment import run_reports
from impact_posture.experiment.run_reports import write_run_report
from impact_posture.output.report.report_page import figures
from impact_posture.system.npz_files import read_arrays
from tests.support.command import run as start

NOMINAL = "runs/nominal.json"
SCRIPT = "<script>alert(1)</script>"


@pytest.fixture(scope="module")
def comparison(push: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A comparison of two controllers, without pictures and page."""
    place = tmp_path_factory.mktemp("comparison")
    asked = "--controllers nominal,stiff --seeds 1 --jobs 1 --out both --format png --quiet --no-report".split()
    done = start("compare", str(push), *asked, cwd=place)
    assert (done.returncode, done.stderr) == (0, "")
    for picture in (place / "both").glob("*.png"):
        picture.unlink()
    return place / "both"


@pytest.fixture
def both(comparison: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(comparison, tmp_path / "both"))


def change(path: Path, *keys: Any, to: Any) -> None:
    document = json.loads(path.read_text())
    block = document
    for key in keys[:-1]:
        block = block[key]
    block[keys[-1]] = to
    path.write_text(json.dumps(document))


@pytest.mark.parametrize("schema", ["impact-posture/comparison/99", "impact-posture/result/1", SCRIPT, 3, None])
@pytest.mark.parametrize("name", ["comparison.json", NOMINAL])
def test_files_of_another_schema_are_refused(name: str, schema: Any, both: Path) -> None:
    change(both / name, "schema", to=schema)
    with pytest.raises(SpecError, match="schema") as caught:
        write_run_report(both)
    assert caught.value.where == str(both / name) and str(schema) in caught.value.what
    assert "run simulate or compare again" in caught.value.hint and not (both / "report.html").exists()


def test_a_run_of_another_schema_ends_the_command(comparison: Path, tmp_path: Path) -> None:
    document = json.loads((comparison / NOMINAL).read_text())
    (tmp_path / "run.json").write_text(json.dumps(document | {"schema": "impact-posture/simulation/99"}))
    done = start("report", ".", cwd=tmp_path)
    assert done.returncode == 1 and len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith("error: run.json: schema 'impact-posture/simulation/99'; run simulate")


def states(path: Path, shape: tuple[int, ...]) -> None:
    """Write a time series whose headers state more than it has."""
    with np.load(path) as arrays:
        names = list(arrays.files)
    with zipfile.ZipFile(path, "w") as file:
        for name in names:
            header = io.BytesIO()
            layout = {"descr": "<f8", "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(header, layout)
            file.writestr(f"{name}.npy", header.getvalue() + bytes(80))


@pytest.mark.parametrize("shape", [(10**15,), (10**12, 9), (2**63,), (-5,)])
def test_sizes_that_a_header_states_are_not_believed(shape: tuple[int, ...], both: Path) -> None:
    states(both / "runs" / "nominal.npz", shape)
    with pytest.raises(SpecError, match="is no time series"):
        write_run_report(both)


def test_arrays_that_unpack_to_more_than_any_run_has(both: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("impact_posture.system.npz_files.MOST_BYTES", 1000)
    with pytest.raises(SpecError, match="File too large"):
        write_run_report(both)


def spoil(path: Path, way: str) -> None:
    """Change a few bytes of the first entry of an NPZ file, or what the file is."""
    data = bytearray(path.read_bytes())
    entry, content = data.index(b"PK\x01\x02"), 30 + sum(struct.unpack_from("<HH", data, 26))
    if way == "array without a name":
        file = io.BytesIO()
        np.save(file, np.zeros(3))
        data[:] = file.getvalue()
    elif way == "text for an array":
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w") as entries:
            entries.writestr("t.npy", "ten years")
        data[:] = file.getvalue()
    else:
        at = {"password": entry + 8, "compression": entry + 10, "content": content}[way]
        data[at] = 1 if way == "password" else 0xFF
    path.write_bytes(data)


@pytest.mark.parametrize("way", ["password", "compression", "content", "array without a name", "text for an array"])
def test_arrays_that_are_damaged_are_named(way: str, both: Path) -> None:
    spoil(both / "runs" / "nominal.npz", way)
    with pytest.raises(ValueError, match=r"nominal\.npz"):
        read_arrays(both / "runs" / "nominal.npz")
    with pytest.raises(SpecError, match="is no time series"):
        write_run_report(both)


def picture(width: int, height: int) -> bytes:
    """A PNG that states a size and has no content."""

    def part(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + part(b"IHDR", head) + part(b"IDAT", zlib.compress(bytes(99))) + part(b"IEND", b"")


# A picture of another format.  Some formats have Pillow start other programs.
BITMAP = b"BM" + struct.pack("<IIIIiiHHIIIIII", 58, 0, 54, 40, 1, 1, 1, 24, 0, 4, 0, 0, 0, 0) + bytes(4)


@pytest.mark.parametrize(
    "content", [picture(60_000, 60_000), picture(2**31 - 1, 2**31 - 1), picture(9, 9), b"none", BITMAP]
)
def test_a_picture_that_is_none_is_named(content: bytes, both: Path) -> None:
    (both / "x.png").write_bytes(content)
    with pytest.raises(SpecError, match="is no picture") as caught:
        write_run_report(both)
    assert caught.value.where == str(both / "x.png")


def test_a_page_passes_on_no_file_that_a_link_leads_to(both: Path) -> None:
    (both.parent / "secret").write_text("of mine")
    (both / "x.svg").symlink_to(both.parent / "secret")
    (both / "y.svg").write_text("<svg/>")
    assert [name for name, _ in figures(both)] == ["y"]


def test_each_run_is_read_once(both: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = json.loads((both / "comparison.json").read_text())["rows"]
    change(both / "comparison.json", "rows", to=rows * 50)
    shown: list[int] = []
    monkeypatch.setattr(run_reports, "run_scene", lambda runs, **more: shown.append(len(runs)))
    monkeypatch.setattr(run_reports, "write_page", lambda folder, *more: folder)
    write_run_report(both)
    assert shown == [2]
    runs = json.loads((both / NOMINAL).read_text())["runs"]
    (both / "comparison.json").unlink()
    (both / NOMINAL).rename(both / "run.json")
    (both / "runs" / "nominal.npz").rename(both / "series.npz")
    change(both / "run.json", "runs", to=runs[:1] * 50)
    with pytest.raises(SpecError, match="one time series several times"):
        write_run_report(both)


CHANGES: dict[str, tuple[Any, ...]] = {
    "another folder": ("comparison.json", "rows", 0, "controller", "../../elsewhere"),
    "HTML in a name": ("comparison.json", "rows", 0, "controller", SCRIPT),
    "HTML in a reason": ("comparison.json", "rows", 0, "failed", [SCRIPT]),
    "HTML in a status": ("comparison.json", "rows", 0, "status", SCRIPT),
    "HTML in a mean": ("comparison.json", "rows", 0, "metrics", "peak_jump", "mean", SCRIPT),
    "HTML in a scenario": ("comparison.json", "scenario", SCRIPT),
    "HTML in a run": (NOMINAL, "runs", 0, "status", SCRIPT),
    "HTML in a controller": (NOMINAL, "controller", SCRIPT),
    "HTML in a seed": (NOMINAL, "seed", SCRIPT),
    "no mean": ("comparison.json", "rows", 0, "metrics", "peak_jump", "mean", float("nan")),
    "endless mean": ("comparison.json", "rows", 0, "metrics", "peak_jump", "mean", 10**400),
    "endless samples": ("comparison.json", "rows", 0, "metrics", "peak_jump", "samples", 10**400),
    "text for seeds": ("comparison.json", "seeds", "abc"),
    "no reduction": ("comparison.json", "rows", 1, "reduction", {"mean": "much"}),
    "another file": (NOMINAL, "source", "/etc/passwd"),
    "file without end": (NOMINAL, "source", "/dev/zero"),
    "endless sign": (NOMINAL, "runs", 0, "sign", 10**30),
    "list for a sign": (NOMINAL, "runs", 0, "sign", [1]),
    "window without begin": (NOMINAL, "runs", 0, "windows", 0, "begin", float("nan")),
    "endless window": (NOMINAL, "runs", 0, "windows", 0, "end", 1e308),
    "contact of a window": (NOMINAL, "runs", 0, "windows", 0, "contact", 10**12),
    "list for free": (NOMINAL, "free", [1]),
    "path beyond the system": (NOMINAL, "source", "x" * 300 + "/y.toml"),
    "null character": (NOMINAL, "source", "a\0b.toml"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_changed_values_are_refused_or_escaped(name: str, both: Path) -> None:
    file, *keys, value = CHANGES[name]
    change(both / file, *keys, to=value)
    before = {path: path.read_bytes() for path in both.parent.rglob("*") if path.is_file()}
    try:
        write_run_report(both)
    except ImpactPostureError as error:
        assert "\n" not in error.line and len(error.line) < 2000
    else:
        page = (both / "report.html").read_text(encoding="utf-8")
        assert SCRIPT not in page and "Content-Security-Policy" in page
    after = {path: path.read_bytes() for path in both.parent.rglob("*") if path.is_file()}
    assert {path: text for path, text in after.items() if path.name != "report.html"} == before
