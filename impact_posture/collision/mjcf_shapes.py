"""Shapes of bodies from a compiled MJCF.

MuJoCo has already read and scaled the meshes.  In contacts, MuJoCo and this module replace a mesh by its convex hull.
Geoms that never collide are visual geoms, which only pictures use.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import combinations
from typing import Any

import numpy as np

from impact_posture.collision.mesh_file import UnusableShape
from impact_posture.collision.shape_corners import Corrected, Triangles, hull_surface, triangle_mesh
from impact_posture.collision.urdf_shapes import LinkShape, LinkShapes
from impact_posture.robot.mjcf_file import is_floating, object_name
from impact_posture.robot.mjcf_model import placement
from impact_posture.system.arrays import Array
from impact_posture.system.optional_package import import_mujoco

_NO_MESH = np.zeros((0, 3)), np.zeros((0, 3), dtype=int)


@dataclass(frozen=True, eq=False)
class MjcfShape(LinkShape):
    """A geom of an MJCF.

    Attributes:
        surface: Corners, m, shape (k, 3), and triangles, shape (n, 3), of a mesh.
        hull: Whether the convex hull replaces the mesh.
    """

    surface: tuple[Array, Triangles] = _NO_MESH
    hull: bool = True

    @cached_property
    def content(self) -> str:
        """Hash of the mesh, and whether its convex hull replaces it."""
        parts = *(np.ascontiguousarray(part).tobytes() for part in self.surface), bytes([self.hull])
        return hashlib.sha256(b"".join(parts)).hexdigest()

    @property
    def key(self) -> object:
        """Shapes with the same key have the same coal shape."""
        return self.kind, self.sizes, self.content

    def _load_mesh(self, largest: float) -> Corrected:
        return Corrected(triangle_mesh(*(hull_surface(self.surface[0]) if self.hull else self.surface)), True)


def mjcf_shapes(model: Any, first: str) -> LinkShapes:
    """Return the solid geoms of an ``MjModel``; with ``first="visual"``, the visual geoms of bodies that have any.

    For a fixed robot, geoms of the MuJoCo world belong to the base.  For a floating robot, they belong to the
    surroundings and are left out.
    """
    read = LinkShapes([], [], [])
    for b, solid in solid_geoms(model):
        geoms = range(model.body_geomadr[b], model.body_geomadr[b] + model.body_geomnum[b])
        visual = [g for g in geoms if g not in solid] if first == "visual" else []
        body = object_name(model, "body", b)
        read.add(body, visual or solid, partial(_shape, model, body=body, hull=first == "collision"))
    return read


def solid_geoms(model: Any) -> Iterator[tuple[int, list[int]]]:
    """Yield each body of the robot with its solid geoms.  Without a free joint, the world is a body of the robot."""
    pairs = {*map(int, model.pair_geom1), *map(int, model.pair_geom2)}
    for b in range(int(is_floating(model)), model.nbody):
        geoms = range(model.body_geomadr[b], model.body_geomadr[b] + model.body_geomnum[b])
        yield b, [g for g in geoms if model.geom_contype[g] or model.geom_conaffinity[g] or g in pairs]


def disabled_bodies(model: Any) -> set[frozenset[str]]:
    """Return the pairs of bodies that may touch: excluded pairs, and bodies in the same or consecutive rigid groups.

    As in MuJoCo, bodies without joints and their parents form one body.
    """
    names = [object_name(model, "body", b) for b in range(model.nbody)]
    return {frozenset((names[a], names[b])) for a, b in excluded_pairs(model, range(model.nbody))}


def excluded_pairs(model: Any, bodies: Iterable[int]) -> set[tuple[int, int]]:
    """Return the pairs of bodies that the MJCF excludes, or that are in the same or in consecutive rigid groups.

    A rigid group is a body with joints and the bodies without joints that it carries.
    """
    weld = np.asarray(model.body_weldid)
    parent = weld[np.asarray(model.body_parentid)[weld]]
    return {(s >> 16, s & 0xFFFF) for s in map(int, model.exclude_signature)} | {
        (a, b)
        for a, b in combinations(bodies, 2)
        if weld[a] == weld[b] or parent[a] == weld[b] or parent[b] == weld[a]
    }


def _shape(model: Any, g: int, name: str, *, body: str, hull: bool) -> MjcfShape:
    """Return a geom as the shape ``name``; raise ``UnusableShape`` for planes, height fields and other surfaces."""
    kind = import_mujoco().mjtGeom(int(model.geom_type[g])).name.removeprefix("mjGEOM_").lower()
    x, y, z = (float(v) for v in model.geom_size[g])
    known = {
        "sphere": (x,),
        "capsule": (x, 2 * y),
        "cylinder": (x, 2 * y),
        "ellipsoid": (x, y, z),
        "box": (2 * x, 2 * y, 2 * z),
        "mesh": (1.0, 1.0, 1.0),
    }
    if kind not in known:
        raise UnusableShape(f"a {kind} is not a shape of a link; give {', '.join(known)}")
    surface = mesh_surface(model, int(model.geom_dataid[g])) if kind == "mesh" else _NO_MESH
    at, color = placement(model.geom_pos[g], model.geom_quat[g]), _color(model, g)
    return MjcfShape(name, body, at, kind, known[kind], color=color, surface=surface, hull=hull)


def _color(model: Any, g: int) -> tuple[float, ...]:
    """Return the color of a geom; a geom with MuJoCo's default color has the color of its material."""
    color, material = model.geom_rgba[g], int(model.geom_matid[g])
    if material >= 0 and np.allclose(color, (0.5, 0.5, 0.5, 1.0)):
        color = model.mat_rgba[material]
    return tuple(float(v) for v in color)


def mesh_surface(model: Any, k: int) -> tuple[Array, Triangles]:
    """Return the corners, m, shape (n, 3), and the triangles, shape (m, 3), of a mesh."""
    corners = model.mesh_vert[model.mesh_vertadr[k] :][: model.mesh_vertnum[k]]
    return corners.astype(float), model.mesh_face[model.mesh_faceadr[k] :][: model.mesh_facenum[k]].astype(int)
