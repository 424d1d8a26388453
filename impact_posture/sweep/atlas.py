"""Folder of a sweep: a manifest, and one Parquet file per shard (block of grid points that a worker solves)."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from impact_posture.config.checked import checked
from impact_posture.errors import InputError, OutputError, SpecError
from impact_posture.posture.formulation.problem_file import dump_settings
from impact_posture.sweep.case_solver import CaseSolver
from impact_posture.sweep.shard_table import passes_of, read_postures
from impact_posture.sweep.sweep_file import Sweep
from impact_posture.system.libraries import source_key
from impact_posture.system.output_folder import check_output, is_ours, used_alone, write_record, write_whole
from impact_posture.system.text_files import read_text
from impact_posture.version import __version__

if TYPE_CHECKING:
    from pyarrow.dataset import Dataset

SCHEMA = "impact-posture/sweep-folder/1"
MANIFEST, _DATA = "manifest.json", "data"
# Folder for results of the first pass.  Neighboring shards start from these results even after the second pass has
# replaced the file in _DATA.
_FIRST_PASS = "first-pass"
# Number of shards whose postures stay in memory, because successive shards have common neighbors.
_KEPT = 16
# Subpackages of impact_posture whose code affects the results.
_PACKAGES = ("robot", "dynamics", "collision", "impact", "posture", "sweep")


def sweep_key(sweep: Sweep) -> str:
    """Return a hash of the settings, robot files and code on which the results of a sweep depend.

    Raises:
        ImpactPostureError: A robot cannot be loaded, or a setting is invalid for the robot.
    """
    content = [repr((sweep.outer, sweep.grid, sweep.shard))]
    for case in sweep.cases:
        solver = CaseSolver(case)
        solver.check(sweep.grid)
        content += [dump_settings(case.settings), solver.content]
    return source_key(content, *_PACKAGES)


class Atlas:
    """Folder into which a sweep writes its results."""

    def __init__(self, folder: Path, sweep: Sweep, key: str) -> None:
        self.folder, self._sweep, self._key = folder, sweep, key
        self._postures = lru_cache(_KEPT)(self._read_postures)

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Create the folder or continue in it, and lock it against other processes during the ``with`` block.

        Raises:
            OutputError: The folder contains other files, or results of another sweep or version, or another process
                uses it.
        """
        manifest = self.folder / MANIFEST
        if not os.path.isfile(manifest):
            # A run that was killed before it wrote the manifest leaves a record file but no results.
            if not is_ours(self.folder, "sweep") or (self.folder / _DATA).exists():
                check_output(self.folder, force=False, kind="sweep")
            try:
                self.folder.mkdir(parents=True, exist_ok=True)
                write_record(self.folder, "sweep")
            except OSError as error:
                hint = "free disk space or choose another `out`"
                raise OutputError.unwritable(self.folder, error, hint) from None
            write_whole(manifest, json.dumps(self._manifest(), indent=1) + "\n")
        known = read_manifest(self.folder)
        if known["key"] != self._key:
            other = "another version" if known["version"] != __version__ else "another sweep, or other code or robots"
            raise OutputError(f"contains results of {other}", where=str(self.folder), hint="choose another `out`")
        with used_alone(self.folder, manifest):
            for part in self.folder.glob("*/case=*/.shard-*.parquet.*.part"):
                with suppress(OSError):
                    part.unlink()
            yield

    def waiting(self) -> tuple[list[int], list[int]]:
        """Return the shards that need the first pass, and the shards that need the second pass."""
        passes, shards = self._sweep.passes, range(self._sweep.shards)
        missing = [shard for shard in shards if self._passes(self._path(shard), shard) != passes]
        if passes == 1:
            return missing, []
        needed = {*missing, *(other for shard in missing for other in self._sweep.beside(shard))}
        return [shard for shard in sorted(needed) if self._first(shard) is None], missing

    def solved(self, shard: int) -> tuple[bytes, dict[int, list[float]]]:
        """Return the file content of a shard after the first pass, and the postures around the shard.

        The postures belong to grid points in other shards that are next to a point of this shard.
        """
        beside: dict[int, list[float]] = {}
        for other, points in self._sweep.beside(shard).items():
            known = self._postures(other)
            beside |= {point: posture for point in points if (posture := known[point]) is not None}
        return self._content(shard), beside

    def write(self, shard: int, content: bytes, passes: int) -> None:
        """Write the ``content`` of a shard file after the given number of ``passes``."""
        before = self._passes(self._path(shard), shard)
        if before == 1 < passes:
            # Keep the file from the first pass, because neighboring shards still need it.
            self._write(self._path(shard, _FIRST_PASS), self._content(shard))
        self._write(self._path(shard, _FIRST_PASS if before > passes else _DATA), content)

    def finish(self) -> None:
        """Delete the shard files from the first pass."""
        places = [self._path(shard, _FIRST_PASS) for shard in range(self._sweep.shards)]
        with suppress(OSError):
            for path in places:
                path.unlink(missing_ok=True)
            for folder in (*{path.parent for path in places}, self.folder / _FIRST_PASS):
                folder.rmdir()

    def _write(self, path: Path, content: bytes) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError.unwritable(path.parent, error, "check the disk and permissions") from None
        write_whole(path, content)

    def _path(self, shard: int, place: str = _DATA) -> Path:
        case, part = divmod(shard, self._sweep.shards_of_case)
        return self.folder / place / f"case={case}" / f"shard-{part:06d}.parquet"

    def _passes(self, path: Path, shard: int) -> int:
        return passes_of(path, self._key, len(self._sweep.span(shard)[1]))

    def _first(self, shard: int) -> Path | None:
        """Return the path of the shard file from the first pass; ``None`` if the file does not exist."""
        paths = self._path(shard), self._path(shard, _FIRST_PASS)
        return next((path for path in paths if self._passes(path, shard) == 1), None)

    def _content(self, shard: int) -> bytes:
        path = self._first(shard)
        if path is None:
            raise OutputError(
                "a file was deleted during the run", where=str(self.folder), hint="run sweep again to continue"
            )
        return path.read_bytes()

    def _read_postures(self, shard: int) -> dict[int, list[float] | None]:
        return dict(zip(self._sweep.span(shard)[1], read_postures(self._content(shard)), strict=True))

    def _manifest(self) -> dict[str, Any]:
        sweep = self._sweep
        return {
            "schema": SCHEMA,
            "version": __version__,
            "key": self._key,
            "points": sweep.points,
            "shards": sweep.shards,
            "shard": sweep.shard,
            "cases": [{"values": dict(case.values), "problem": dump_settings(case.settings)} for case in sweep.cases],
            "axes": [{"name": axis.name, "values": list(axis.values)} for axis in sweep.grid.axes],
        }


def read_manifest(folder: Path) -> dict[str, Any]:
    """Return the manifest of a sweep folder.

    Raises:
        SpecError: The manifest is missing or cannot be read.
    """
    path = folder / MANIFEST
    try:
        content = json.loads(read_text(path))
        if content["schema"] != SCHEMA:
            raise ValueError(f"schema {content['schema']}")
        return {**content, "key": str(content["key"]), "version": str(content["version"])}
    except FileNotFoundError:
        raise SpecError(
            "contains no manifest.json", where=str(folder), hint="name a folder that sweep wrote"
        ) from None
    except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
        what = f"is not a manifest of a sweep ({type(error).__name__}: {error})"
        raise SpecError(what, where=str(path), hint="name a folder that sweep wrote") from None


@checked
def open_atlas(folder: str | Path) -> Dataset:
    """Open the table of a finished or unfinished sweep as a ``pyarrow.dataset.Dataset``.

    Raises:
        InputError: pyarrow is not installed.
        SpecError: The folder is not a sweep folder, or has no finished shard.
    """
    check_package("pyarrow", "sweep")
    from pyarrow import ArrowException, dataset

    read_manifest(Path(folder))
    data = Path(folder) / _DATA
    if next(data.glob("case=*/*.parquet"), None) is None:
        raise SpecError("has no finished shard", where=str(folder), hint="run sweep again to continue")
    try:
        return dataset.dataset(data, format="parquet", partitioning="hive")
    except (OSError, ArrowException) as error:
        raise SpecError(f"cannot be read ({error})", where=str(folder), hint="run sweep again") from None


def check_package(name: str, extra: str) -> None:
    """Raise an InputError if a package is not installed.  The hint names the ``extra`` that installs the package."""
    if find_spec(name) is None:
        what = f"needs the package {name}"
        raise InputError(what, where="sweep", hint=f"pip install 'impact-posture[{extra}]'")
