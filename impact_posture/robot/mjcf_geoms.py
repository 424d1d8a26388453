"""Geoms of a compiled MJCF, in the sizes and axes of URDF shapes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.robot.mjcf_file import is_floating, object_name
from impact_posture.robot.mjcf_model import placement
from impact_posture.system.arrays import Array
from impact_posture.system.optional_package import import_mujoco

_NO_MESH = np.zeros((0, 3)), np.zeros((0, 3), dtype=int)


@dataclass(frozen=True, eq=False)
class MjcfGeom:
    """A geom of an ``MjModel``.

    Attributes:
        body: Name of its body.
        placement: Placement in the axes of the body.
        kind: ``sphere``, ``capsule``, ``cylinder``, ``ellipsoid``, ``box`` or ``mesh``; other types have no sizes.
        sizes: Radius, radius and length, semi-axes, or edge lengths, m; for a mesh, its scale.
        solid: Whether the geom collides with anything; other geoms are only visual.
        color: Red, green, blue and opacity, 0 to 1.
        mesh: Corners of a mesh, m, shape (k, 3), and its triangles, shape (n, 3).
    """

    body: str
    placement: pin.SE3
    kind: str
    sizes: tuple[float, ...]
    solid: bool
    color: tuple[float, ...]
    mesh: tuple[Array, NDArray[np.int_]] = _NO_MESH


def geoms_of(model: Any) -> Iterator[MjcfGeom]:
    """Yield the geoms of an ``MjModel``, body by body; the geoms of the world only if the robot does not float.

    The world of a fixed robot has the shapes of its base.  The surroundings of a floating robot are not its shapes.
    """
    explicit = {int(g) for pair in (model.pair_geom1, model.pair_geom2) for g in pair}
    for g in range(model.ngeom):
        body = int(model.geom_bodyid[g])
        if body == 0 and is_floating(model):
            continue
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
        yield MjcfGeom(
            body=object_name(model, "body", body),
            placement=placement(model.geom_pos[g], model.geom_quat[g]),
            kind=kind,
            sizes=known.get(kind, ()),
            solid=bool(model.geom_contype[g] or model.geom_conaffinity[g] or g in explicit),
            color=_color(model, g),
            mesh=_mesh(model, int(model.geom_dataid[g])) if kind == "mesh" else _NO_MESH,
        )


def _color(model: Any, g: int) -> tuple[float, ...]:
    """Return the color of a geom; a geom with MuJoCo's default color has the color of its material."""
    color, material = model.geom_rgba[g], int(model.geom_matid[g])
    if material >= 0 and np.allclose(color, (0.5, 0.5, 0.5, 1.0)):
        color = model.mat_rgba[material]
    return tuple(float(v) for v in color)


def _mesh(model: Any, k: int) -> tuple[Array, NDArray[np.int_]]:
    corners = model.mesh_vert[model.mesh_vertadr[k] :][: model.mesh_vertnum[k]]
    return corners.astype(float), model.mesh_face[model.mesh_faceadr[k] :][: model.mesh_facenum[k]].astype(int)
