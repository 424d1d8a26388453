"""Reports of damaged or changed run folders: a one-line error, or a page without foreign content."""

from __future__ import annotations

import io
import json
import shutil
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from impact_posture.errors import ImpactPostureError, SpecError
from impact_posture.experiment import run_reports
from impact_posture.experiment.run_reports import write_run_report
from impact_posture.output.report.report_page import figures
from impact_posture.system.scratch_folder import RECORD
from tests.support.command import run as start

NOMINAL = "runs/nominal.json"
SCRIPT = "<script>alert(1)</script>"


@pytest.fixture(scope="module")
def comparison(push: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A comparison of two controllers, without figures and report."""
    folder = tmp_path_factory.mktemp("comparison")
    options = "--controllers nominal,stiff --seeds 1 --jobs 1 --out both --format png --quiet --no-report".split()
    done = start("compare", str(push), *options, cwd=folder)
    assert (done.returncode, done.stderr) == (0, "")
    for picture in (folder / "both").glob("*.png"):
        picture.unlink()
    return folder / "both"


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


@pytest.mark.parametrize("schema", ["impact-posture/comparison/99", "impact-posture/result/1", None])
@pytest.mark.parametrize("name", ["comparison.json", NOMINAL])
def test_another_schema_is_refused(name: str, schema: Any, both: Path) -> None:
    change(both / name, "schema", to=schema)
    with pytest.raises(SpecError, match="schema") as caught:
        write_run_report(both)
    assert caught.value.where == str(both / name) and str(schema) in caught.value.what
    assert "run simulate or compare again" in caught.value.hint and not (both / "report.html").exists()


def test_report_ends_with_one_line_about_another_schema(comparison: Path, tmp_path: Path) -> None:
    document = json.loads((comparison / NOMINAL).read_text())
    (tmp_path / "run.json").write_text(json.dumps(document | {"schema": "impact-posture/simulation/99"}))
    done = start("report", ".", cwd=tmp_path)
    assert done.returncode == 1 and len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith("error: run.json: schema 'impact-posture/simulation/99'; run simulate")


def archive(**entries: bytes) -> bytes:
    with io.BytesIO() as file:
        with zipfile.ZipFile(file, "w") as archive:
            for name, content in entries.items():
                archive.writestr(f"{name}.npy", content)
        return file.getvalue()


def array(shape: tuple[int, ...]) -> bytes:
    """Return an NPY file with 10 numbers whose header states another shape."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return header.getvalue() + bytes(80)


@pytest.mark.parametrize("damaged", ["huge", "negative", "text", "password", "compression", "content", "no name"])
def test_a_damaged_time_series_is_refused(damaged: str, both: Path) -> None:
    path = both / "runs" / "nominal.npz"
    content = bytearray(path.read_bytes())
    entry, data = content.index(b"PK\x01\x02"), 30 + sum(struct.unpack_from("<HH", content, 26))
    if damaged in ("huge", "negative"):
        content[:] = archive(t=array((10**15 if damaged == "huge" else -5,)))
    elif damaged == "text":
        content[:] = archive(t=b"ten years")
    elif damaged == "no name":
        content[:] = array((10,))
    else:
        place = {"password": entry + 8, "compression": entry + 10, "content": data}[damaged]
        content[place] = 1 if damaged == "password" else 0xFF
    path.write_bytes(content)
    with pytest.raises(SpecError, match="is not a time series") as caught:
        write_run_report(both)
    assert caught.value.where == str(path)


def test_arrays_larger_than_any_run_are_refused(both: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("impact_posture.system.npz_files.MOST_BYTES", 1000)
    with pytest.raises(SpecError, match="File too large"):
        write_run_report(both)


def test_a_page_does_not_follow_links(both: Path) -> None:
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


CHANGES: dict[str, tuple[Any, ...]] = {
    "another folder": ("comparison.json", "rows", 0, "controller", "../../elsewhere"),
    "HTML in a name": ("comparison.json", "rows", 0, "controller", SCRIPT),
    "HTML in a reason": ("comparison.json", "rows", 0, "failed", [SCRIPT]),
    "HTML in a mean": ("comparison.json", "rows", 0, "metrics", "peak_jump", "mean", SCRIPT),
    "HTML in a scenario": ("comparison.json", "scenario", SCRIPT),
    "HTML in a run": (NOMINAL, "runs", 0, "status", SCRIPT),
    "HTML in a seed": (NOMINAL, "seed", SCRIPT),
    "mean too large for a float": ("comparison.json", "rows", 0, "metrics", "peak_jump", "mean", 10**400),
    "text for seeds": ("comparison.json", "seeds", "abc"),
    "text for a reduction": ("comparison.json", "rows", 1, "reduction", {"mean": "much"}),
    "another file": (NOMINAL, "source", "/etc/passwd"),
    "endless file": (NOMINAL, "source", "/dev/zero"),
    "huge sign": (NOMINAL, "runs", 0, "sign", 10**30),
    "window without a begin": (NOMINAL, "runs", 0, "windows", 0, "begin", float("nan")),
    "null character": (NOMINAL, "source", "a\0b.toml"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_changed_values_are_refused_or_escaped(name: str, both: Path) -> None:
    file, *keys, value = CHANGES[name]
    change(both / file, *keys, to=value)
    written = ("report.html", RECORD)
    before = {path: path.read_bytes() for path in both.parent.rglob("*") if path.is_file()}
    try:
        write_run_report(both)
    except ImpactPostureError as error:
        assert "\n" not in error.line and len(error.line) < 2000
    else:
        page = (both / "report.html").read_text(encoding="utf-8")
        assert SCRIPT not in page and "Content-Security-Policy" in page
    after = {path: path.read_bytes() for path in both.parent.rglob("*") if path.is_file()}
    assert {path: text for path, text in after.items() if path.name not in written} == {
        path: text for path, text in before.items() if path.name not in written
    }
