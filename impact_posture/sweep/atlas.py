"""Folder of a sweep: a manifest, and one Parquet file per shard.  A worker solves a shard, a block of grid points."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from impact_posture.config.checked import checked
from impact_posture.errors import OutputError, SpecError, listed
from impact_posture.posture.formulation.problem_file import dump_settings
from impact_posture.sweep.case_solver import CaseSolver
from impact_posture.sweep.shard_table import origin_of, passes_of, read_postures, shard_name
from impact_posture.sweep.sweep_file import Sweep
from impact_posture.sweep.sweep_manifest import MANIFEST, check_key, manifest_text, read_manifest
from impact_posture.system.folder_record import is_own
from impact_posture.system.libraries import source_key
from impact_posture.system.optional_package import import_extra
from impact_posture.system.output_folder import used_alone, whole_folder, write_whole
from impact_posture.system.text_files import open_regular, read_bytes

if TYPE_CHECKING:
    from pyarrow.dataset import Dataset

_DATA = "data"
# Folder for results of the first pass.  Neighboring shards start from these results even after the second pass has
# replaced the file in ``_DATA``.
_FIRST_PASS = "first-pass"
# Number of shards whose postures stay in memory, because consecutive shards have common neighbors.
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
        # Shard files that cannot be used, as paths below the folder.
        self.damaged = set[str]()
        self._postures = lru_cache(_KEPT)(self._read_postures)

    @contextmanager
    def opened(self, force: bool = False) -> Iterator[None]:
        """Create the folder or continue in it, and lock it against other processes during the ``with`` block.

        A damaged manifest is written again.  A missing manifest is written again if the checksums of all files show
        that they are shards of this sweep.  With ``force``, shards of another sweep or version are removed.

        Raises:
            OutputError: The folder contains other files, or results of another sweep or version, or another process
                uses the folder.
            SpecError: The manifest is too damaged to belong to a known sweep.
        """
        manifest, text = self.folder / MANIFEST, manifest_text(self._sweep, self._key)
        other = False
        if not os.path.isfile(manifest):
            keys = self._keys()
            if keys and (force or keys == {self._key}):
                write_whole(manifest, text)
                other = keys != {self._key}
                self.damaged.add(MANIFEST)
            else:
                with whole_folder(self.folder, force=force, kind="sweep") as beside:
                    write_whole(beside / MANIFEST, text)
        try:
            check_key(self.folder, self._key)
        except OutputError:
            if not force:
                raise
            other = True
        with ExitStack() as locks:
            locks.enter_context(used_alone(self.folder, manifest))
            if read_bytes(manifest) != text.encode():
                self.damaged.update([] if other else [MANIFEST])
                write_whole(manifest, text)
                # Lock the new file too, because the lock above belongs to the replaced file.
                locks.enter_context(used_alone(self.folder, manifest))
            for place in (_DATA, _FIRST_PASS) if other else ():
                for shard in (self.folder / place).glob("case=*/shard-*.parquet"):
                    shard.unlink()
            for part in self.folder.glob("*/case=*/.shard-*.parquet.*.part"):
                with suppress(OSError):
                    part.unlink()
            yield

    def _keys(self) -> set[str]:
        """Return the keys of the sweeps of all shards in the folder; empty if the folder contains a foreign file."""
        keys = set[str]()
        try:
            for path in self.folder.rglob("*"):
                if path.is_dir() and not path.is_symlink():
                    continue
                name = path.relative_to(self.folder)
                sealed = name.parts[0] in (_DATA, _FIRST_PASS)
                key = origin_of(read_bytes(path), "/".join(name.parts[1:]))[0] if sealed else ""
                if key:
                    keys.add(key)
                elif not is_own(self.folder, name.as_posix()):
                    return set()
        except OSError:
            return set()
        return keys

    def waiting(self) -> tuple[list[int], list[int]]:
        """Return the shards that need the first pass, and the shards that need the second pass."""
        passes, shards = self._sweep.passes, range(self._sweep.shards)
        missing = [shard for shard in shards if self._read(shard)[0] != passes]
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
        before, known = self._read(shard)
        if before == 1 < passes:
            # Keep the file from the first pass, because neighboring shards still need it.
            self._write(self._path(shard, _FIRST_PASS), known)
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
        return self.folder / place / shard_name(self._sweep, shard)

    def _read(self, shard: int, place: str = _DATA) -> tuple[int, bytes]:
        """Return the number of passes after which a shard file was written (0: unusable), and the file content."""
        path, content, passes = self._path(shard, place), b"", 0
        with suppress(OSError):
            content = read_bytes(path)
            passes = passes_of(content, self._key, shard_name(self._sweep, shard))
        if not passes and os.path.lexists(path):
            self.damaged.add(path.relative_to(self.folder).as_posix())
        return passes, content

    def _first(self, shard: int) -> bytes | None:
        """Return the content of a shard file from the first pass; ``None`` without a usable file."""
        files = (self._read(shard, place) for place in (_DATA, _FIRST_PASS))
        return next((content for passes, content in files if passes == 1), None)

    def _content(self, shard: int) -> bytes:
        content = self._first(shard)
        if content is None:
            what, hint = "a file was deleted or damaged during the run", "run sweep again to continue"
            raise OutputError(what, where=str(self.folder), hint=hint)
        return content

    def _read_postures(self, shard: int) -> dict[int, list[float] | None]:
        return dict(zip(self._sweep.span(shard)[1], read_postures(self._content(shard)), strict=True))


@checked
def open_atlas(folder: str | Path) -> Dataset:
    """Open the table of a finished or unfinished sweep as a ``pyarrow.dataset.Dataset``.

    Raises:
        InputError: pyarrow is not installed.
        SpecError: The folder is not a sweep folder, has no finished shard, or is damaged.
    """
    import_extra("pyarrow", "sweep")
    from pyarrow import dataset, fs

    manifest, data = read_manifest(Path(folder)), Path(folder) / _DATA
    paths = sorted(data.glob("case=*/shard-*.parquet"))
    if not paths:
        raise SpecError("has no finished shard", where=str(folder), hint="run sweep again to continue")
    with reading(Path(folder)):
        for path in paths:
            open_regular(path).close()
        names = {path.relative_to(data).as_posix(): path for path in paths if manifest.has_checksums}
        damaged = [name for name, path in names.items() if not passes_of(read_bytes(path), manifest.key, name)]
        if damaged:
            hint = "run sweep again to solve these shards again, and move away files that sweep did not write"
            raise SpecError(f"has damaged shards ({listed(damaged)})", where=str(folder), hint=hint)
        pages = dataset.ParquetFragmentScanOptions(page_checksum_verification=True)
        form = dataset.ParquetFileFormat(default_fragment_scan_options=pages)
        by_case = dataset.HivePartitioning.discover()
        options = dataset.FileSystemFactoryOptions(str(data), partitioning=by_case)
        return dataset.FileSystemDatasetFactory(fs.LocalFileSystem(), list(map(str, paths)), form, options).finish()


@contextmanager
def reading(folder: Path) -> Iterator[None]:
    """Convert errors of Parquet files that are read within the block to a ``SpecError`` about their folder."""
    from pyarrow import ArrowException

    try:
        yield
    except (OSError, ArrowException) as error:
        raise SpecError(f"cannot be read ({error})", where=str(folder), hint="run sweep again") from None
