"""Solid geoms of links as the MJCF of a robot defines them, in the world that MuJoCo simulates."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from impact_posture.collision.mjcf_shapes import excluded_pairs, mesh_surface, solid_geoms
from impact_posture.dynamics.mjcf import Mjcf, pose
from impact_posture.robot.mjcf_file import object_name
from impact_posture.robot.mjcf_model import placement
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array
from impact_posture.system.escape import xml_name
from impact_posture.system.optional_package import import_mujoco

# Properties of a geom and of a contact pair that determine their contacts.
_GEOM = ("contype", "conaffinity", "condim", "priority", "friction", "solmix", "solref", "solimp", "margin", "gap")
_PAIR = ("friction", "solref", "solreffriction", "solimp", "margin", "gap")
# Options of the MJCF that the scenario replaces.
_OPTIONS = ("timestep", "integrator", "cone", "impratio", "noslip_iterations", "disableflags", "enableflags")


class LinkGeom(NamedTuple):
    """Solid geom of a robot: its body in the MJCF, and the index of the joint that moves it."""

    body: str
    joint: int


def solid_links(robot: Robot) -> Iterator[tuple[int, str, pin.Frame, list[int]]]:
    """Yield the number, name, frame and solid geoms of each body with solid geoms in the MJCF of a robot.

    Signed distance fields are left out.  A robot without an MJCF yields nothing.
    """
    if robot.mjcf is None:
        return
    source = robot.mjcf.model
    for b, geoms in solid_geoms(source):
        link = object_name(source, "body", b)
        if usable := [g for g in geoms if not _is_distance_field(source, g)]:
            yield b, link, robot.model.frames[robot.frame_id(link) if b else 0], usable


def add_link_geoms(mjcf: Mjcf, robot: Robot) -> dict[str, LinkGeom]:
    """Add solid geoms, excluded pairs of bodies and contact pairs from the MJCF of a robot; return the geoms by name.

    Each body of the file becomes a body without mass, fixed to the joint that moves it.  Contacts of this new body
    are as soft as in the file.  If joints are locked, they are as soft as contacts of the link that the joint moves.
    """
    if robot.mjcf is None:
        return {}
    mujoco, source = import_mujoco(), robot.mjcf.model
    names, bodies, added = dict[int, str](), dict[int, str](), dict[str, LinkGeom]()
    for b, link, frame, geoms in solid_links(robot):
        bodies[b] = xml_name(f"geoms of {link} ({b})")
        body = mjcf.body(frame.parentJoint).add_body(name=bodies[b], **pose(frame.placement))
        mjcf.inverse_weights[bodies[b]] = None if robot.locked else np.array(source.body_invweight0[b])
        for g in geoms:
            names[g] = xml_name(f"geom {g} of {link}")
            added[names[g]] = LinkGeom(link, frame.parentJoint)
            law = {key: getattr(source, f"geom_{key}")[g] for key in _GEOM}
            at, k = pose(placement(source.geom_pos[g], source.geom_quat[g])), int(source.geom_dataid[g])
            if source.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH:
                convex = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
                mjcf.spec.add_mesh(name=names[g], uservert=_hull(source, k).ravel(), inertia=convex)
                law["meshname"] = names[g]
            elif source.geom_type[g] == mujoco.mjtGeom.mjGEOM_HFIELD:
                rows, columns = int(source.hfield_nrow[k]), int(source.hfield_ncol[k])
                heights = source.hfield_data[source.hfield_adr[k] :][: rows * columns]
                size = source.hfield_size[k]
                mjcf.spec.add_hfield(name=names[g], nrow=rows, ncol=columns, size=size, userdata=heights)
                law["hfieldname"] = names[g]
            body.add_geom(name=names[g], type=source.geom_type[g], size=source.geom_size[g], mass=0.0, **law, **at)
    # Locked joints merge bodies.  Therefore, replace MuJoCo's filter of parent and child by the pairs in the file.
    mjcf.spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    parents_touch = source.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    # Bodies that are fixed to the world collide with their children.
    moving = [] if parents_touch else np.flatnonzero(source.body_weldid).tolist()
    for first, second in excluded_pairs(source, moving):
        if first in bodies and second in bodies:
            mjcf.spec.add_exclude(bodyname1=bodies[first], bodyname2=bodies[second])
    for p in range(source.npair):
        one, other = int(source.pair_geom1[p]), int(source.pair_geom2[p])
        if one in names and other in names:
            law = {key: getattr(source, f"pair_{key}")[p] for key in _PAIR}
            mjcf.spec.add_pair(geomname1=names[one], geomname2=names[other], condim=source.pair_dim[p], **law)
    return added


def contact_warnings(mjcf: Mjcf, robot: Robot) -> Iterator[str]:
    """Yield a line about geoms of the MJCF that are not simulated, and about options that the scenario replaces."""
    if robot.mjcf is None:
        return
    source, usual = robot.mjcf.model, import_mujoco().MjSpec().option
    if absent := sum(_is_distance_field(source, g) for _, geoms in solid_geoms(source) for g in geoms):
        yield f"the simulation leaves out signed distance fields of the MJCF ({absent})"
    stated = [
        name
        for name in _OPTIONS
        if getattr(source.opt, name) not in (getattr(usual, name), getattr(mjcf.spec.option, name))
    ]
    if stated:
        yield f"the scenario replaces these options of the MJCF: {', '.join(stated)}"


def _is_distance_field(model: Any, g: int) -> bool:
    return bool(model.geom_type[g] == import_mujoco().mjtGeom.mjGEOM_SDF)


def _hull(model: Any, mesh: int) -> Array:
    corners, _ = mesh_surface(model, mesh)
    if model.mesh_graphadr[mesh] < 0:
        return corners
    graph = model.mesh_graph[model.mesh_graphadr[mesh] :]
    # The graph contains the numbers of corners and faces, one address for each corner, and the corners.
    count = int(graph[0])
    return np.asarray(corners[graph[2 + count : 2 + 2 * count]])
