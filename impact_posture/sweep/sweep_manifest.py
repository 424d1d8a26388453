"""Manifest of a sweep folder, ``manifest.json``: its content, and its checks when it is read."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from impact_posture.config.demand import Demand, Finite, OneOrMore
from impact_posture.config.table_validation import StrictTable, validate
from impact_posture.errors import OutputError, SpecError
from impact_posture.posture.formulation.problem_file import dump_settings
from impact_posture.sweep.sweep_file import Axis, Grid, InnerAxis, Sweep
from impact_posture.system.sealed_files import UNSEALED, is_intact, sealed
from impact_posture.system.text_files import read_text
from impact_posture.version import __version__

MANIFEST = "manifest.json"
# ``_UNSEALED`` is the schema of folders without checksums.  ``_SCHEMA`` is the schema of new folders.
_UNSEALED, _SCHEMA = "impact-posture/sweep-folder/1", "impact-posture/sweep-folder/2"

_Values = tuple[Finite, ...] | tuple[tuple[Finite, ...], ...]


def _alike(values: Any) -> bool:
    return len({len(value) if isinstance(value, tuple) else 0 for value in values}) == 1


@dataclass(frozen=True)
class ManifestAxis(StrictTable):
    """Axis of the grid: numbers, or vectors of equal length."""

    name: InnerAxis
    values: Annotated[_Values, Demand(_alike, "at least one value; all values with the same number of entries")]


@dataclass(frozen=True)
class ManifestCase(StrictTable):
    """Case of the sweep: its values along the outer axes, and its settings as the text of a ``problem.toml``."""

    values: dict[str, Any]
    problem: str


@dataclass(frozen=True)
class SweepManifest(StrictTable):
    """Content of ``manifest.json``.

    Attributes:
        schema: Name of this file format.
        version: Version of this package that wrote the folder.
        key: Hash of everything on which the results depend.
        points: Number of problems.
        shards: Number of shards.
        shard: Number of points of a shard.
        cases: The cases of the sweep, which are combinations of values of the outer axes.
        axes: Axes of the grid, the same for every case.
        checksum: SHA-256 of all other bytes of the file; empty in folders of schema 1.
    """

    schema: Literal["impact-posture/sweep-folder/1", "impact-posture/sweep-folder/2"]
    version: str
    key: str
    points: OneOrMore
    shards: OneOrMore
    shard: OneOrMore
    cases: tuple[ManifestCase, ...]
    axes: tuple[ManifestAxis, ...]
    checksum: str = ""

    @property
    def has_checksums(self) -> bool:
        """Whether the manifest and the shards of the folder contain checksums."""
        return self.schema != _UNSEALED

    @property
    def grid(self) -> Grid:
        """Grid of each case."""
        return Grid(tuple(Axis(axis.name, axis.values) for axis in self.axes))


def manifest_text(sweep: Sweep, key: str) -> str:
    """Return the text of the manifest of a sweep.  ``key`` is the hash that identifies the sweep."""
    content = {
        "schema": _SCHEMA,
        "version": __version__,
        "key": key,
        "points": sweep.points,
        "shards": sweep.shards,
        "shard": sweep.shard,
        "cases": [{"values": dict(case.values), "problem": dump_settings(case.settings)} for case in sweep.cases],
        "axes": [{"name": axis.name, "values": list(axis.values)} for axis in sweep.grid.axes],
        "checksum": UNSEALED,
    }
    return sealed(f"{json.dumps(content, indent=1)}\n".encode()).decode()


def read_manifest(folder: Path) -> SweepManifest:
    """Return the manifest of a sweep folder.

    Raises:
        SpecError: The manifest is missing, cannot be read, or is damaged.
    """
    path = folder / MANIFEST
    text, content = _read(folder)
    manifest = validate(SweepManifest, content, str(path))
    intact = not manifest.has_checksums or is_intact(text.encode())
    size = manifest.grid.size
    counts = len(manifest.cases) * size, len(manifest.cases) * -(-size // manifest.shard)
    if not intact or (manifest.points, manifest.shards) != counts:
        raise SpecError("is damaged", where=str(path), hint="run the same sweep again")
    return manifest


def check_key(folder: Path, key: str) -> None:
    """Check that a folder belongs to the sweep with this key.  The rest of the manifest may be damaged.

    Raises:
        OutputError: The folder has results of another sweep or version.
        SpecError: The manifest is missing, cannot be read, or is damaged.
    """
    _, content = _read(folder)
    if isinstance(content, dict) and content.get("key") == key:
        return
    other = (
        "another version"
        if read_manifest(folder).version != __version__
        else "another sweep, other code or other robots"
    )
    hint = "choose another `out`, or give `force` to replace them"
    raise OutputError(f"contains results of {other}", where=str(folder), hint=hint)


def _read(folder: Path) -> tuple[str, Any]:
    hint = "name a folder that sweep wrote"
    try:
        text = read_text(folder / MANIFEST)
        return text, json.loads(text)
    except FileNotFoundError:
        raise SpecError(f"contains no {MANIFEST}", where=str(folder), hint=hint) from None
    except (OSError, ValueError, RecursionError) as error:
        raise SpecError.unreadable(folder / MANIFEST, error, hint) from None
