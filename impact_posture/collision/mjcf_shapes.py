"""Shapes of bodies from a compiled MJCF.

MuJoCo has read and scaled the meshes already.  In contacts, MuJoCo replaces a mesh by its convex hull, and so does
this module.  Geoms that collide with nothing are only visual, and only pictures use them.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from impact_posture.collision.shape_corners import Corrected, Triangles, hull_surface, triangle_mesh
from impact_posture.collision.urdf_shapes import UnusableShape, UrdfShape, UrdfShapes, left_out
from impact_posture.robot.mjcf_file import object_name
from impact_posture.robot.mjcf_geoms import MjcfGeom, geoms_of
from impact_posture.system.arrays import Array


@dataclass(frozen=True, eq=False)
class MjcfShape(UrdfShape):
    """A geom of an MJCF; ``surface`` has the corners, m, and the triangles of a mesh."""

    surface: tuple[Array, Triangles] = (np.zeros((0, 3)), np.zeros((0, 3), dtype=int))

    @property
    def content(self) -> str:
        """Hash of the mesh."""
        return hashlib.sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in self.surface)).hexdigest()

    @property
    def key(self) -> object:
        """Shapes with the same key have the same coal shape."""
        return self.kind, self.sizes, self.content

    def _load_mesh(self, largest: float) -> Corrected:
        return Corrected(triangle_mesh(*self.surface), True)


def mjcf_shapes(model: Any, first: str = "collision") -> UrdfShapes:
    """Return the solid geoms of an ``MjModel``; with ``first="visual"``, the visual geoms of bodies that have any."""
    read, bodies = UrdfShapes([], [], []), dict[str, list[MjcfGeom]]()
    for geom in geoms_of(model):
        bodies.setdefault(geom.body, []).append(geom)
    for body, geoms in bodies.items():
        chosen = [geom for geom in geoms if geom.solid]
        if first == "visual":
            chosen = [geom for geom in geoms if not geom.solid] or chosen
        if chosen:
            read.described.append(body)
        for k, geom in enumerate(chosen):
            name = body if len(chosen) == 1 else f"{body}[{k}]"
            if not geom.sizes:
                fault = UnusableShape(f"a {geom.kind} is not a shape of a link; give primitives or meshes")
                read.warnings.append(left_out(name, fault))
                continue
            surface = hull_surface(geom.mesh[0]) if geom.kind == "mesh" and first == "collision" else geom.mesh
            read.shapes.append(
                MjcfShape(name, body, geom.placement, geom.kind, geom.sizes, color=geom.color, surface=surface)
            )
    return read


def disabled_bodies(model: Any) -> set[frozenset[str]]:
    """Return the pairs of bodies that may touch: excluded pairs, and bodies whose joints follow each other.

    As in MuJoCo, bodies without joints count as one body with their parents.
    """
    names = [object_name(model, "body", b) for b in range(model.nbody)]
    pairs = {frozenset((names[s >> 16], names[s & 0xFFFF])) for s in map(int, model.exclude_signature)}
    weld = np.asarray(model.body_weldid)
    parent = weld[np.asarray(model.body_parentid)[weld]]
    for a, b in combinations(range(model.nbody), 2):
        if weld[a] == weld[b] or parent[a] == weld[b] or parent[b] == weld[a]:
            pairs.add(frozenset((names[a], names[b])))
    return pairs
