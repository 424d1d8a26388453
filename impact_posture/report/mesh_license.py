"""Where the meshes of a known robot come from, and on what terms: a page that holds them passes them on."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from impact_posture.errors import PackageNotFound
from impact_posture.robot.urdf import example_robot_data


@dataclass(frozen=True)
class MeshLicense:
    """The terms of the meshes of a package.

    Attributes:
        package: Folder of the package in example-robot-data.
        license: Name of the license, as the package states it; empty if it states none.
        upstream: Address of the original.
        text: Text of the license, if the package holds it.
    """

    package: str
    license: str
    upstream: str
    text: str

    @property
    def allows(self) -> bool:
        """Whether simplified meshes may be passed on: a license is stated, and permits changed copies."""
        return bool(self.license) and "-ND" not in self.license.upper()


def license_of(mesh: Path) -> MeshLicense | None:
    """Return the terms of a mesh of example-robot-data; ``None`` for a mesh of another origin."""
    try:
        root = example_robot_data().resolve()
    except PackageNotFound:
        return None
    path = mesh.resolve()
    return _read(root / path.relative_to(root).parts[0]) if path.is_relative_to(root) else None


@cache
def _read(folder: Path) -> MeshLicense:
    """Read the README of a package, which states ``license:`` and ``upstream:``, and its LICENSE."""
    readme, text = (
        path.read_text(encoding="utf-8", errors="replace") if path.is_file() else ""
        for path in (folder / "README.md", folder / "LICENSE")
    )
    found = (re.search(rf"^{key}:\s*(\S.*)$", readme, re.I | re.M) for key in ("license", "upstream"))
    license, upstream = ("" if match is None else match[1].strip() for match in found)
    return MeshLicense(folder.name, license, upstream, text)
