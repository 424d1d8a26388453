"""The 3-D scene of a report: the robot, what stands around it, and what moves, packed for the viewer."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.impact.impact_contact import point_on
from impact_posture.impact.metric import Metric
from impact_posture.impact.quantities.impact_quantities import ImpactQuantities
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.output.plot.ellipsoid_shapes import root
from impact_posture.output.quantity_table import quantities
from impact_posture.output.report.drawn_robot import DrawnRobot, Solid, hull_of
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array

_TYPES = {"uint16": "u2", "uint32": "u4", "float32": "f4"}
# Directions from which the camera may look first.
_EYES = np.array([[x, y, 0.55] for x in (1.1, -1.1) for y in (-1.25, 1.25)])
# Best cosine between the viewing direction and the normal of the surface: neither edge-on nor from behind.
_SLANT = 0.35
# A curve: name, unit, and values at the frames.
Curve = tuple[str, str, Array]


@dataclass(frozen=True, eq=False)
class Track:
    """A motion of the robot, frame by frame.

    Attributes:
        name: Name of the track beside others.
        times: Times, s, or path lengths, rad mixed with m, increasing, shape (frames,).
        unit: ``s`` for times; empty for path lengths.
        q: Configurations, shape (frames, nq).
        impacts: Quantities of the impact of each contact, frame by frame.
        jumps: Velocity jump ``Δν``, shape (frames, nv).
        curves: Curves, NaN where undefined.
        forces: Contact force on the robot, world, N, shape (frames, 3); ``None`` to show none.
    """

    name: str
    times: Array
    unit: str
    q: Array
    impacts: Sequence[Sequence[ImpactQuantities]]
    jumps: Array
    curves: tuple[Curve, ...]
    forces: Array | None = None


@dataclass(frozen=True, eq=False)
class ReportScene:
    """Everything that the viewer draws.

    Attributes:
        planes: Name (``surface`` or ``ground``), point (m) and unit normal of each plane, world.
        bodies: Points of each convex body in the world, shape (k, 3), m.
        ghost: Whether the first frame stays visible while the robot moves on.
    """

    drawn: DrawnRobot
    objective: WorstCaseObjective
    tracks: tuple[Track, ...]
    planes: tuple[tuple[str, Array, Array], ...]
    bodies: tuple[Array, ...]
    ghost: bool

    @cached_property
    def packed(self) -> tuple[str, str]:
        """The scene as JSON, and its arrays as base64 of a gzipped buffer into which the JSON points."""
        model = self.objective.robot.model
        tracks, arrows_of = zip(*map(self._track, self.tracks), strict=True)
        low, high = self._box()
        size, center = float(np.linalg.norm(high - low)), (low + high) / 2
        walls: list[dict[str, Any]] = [{"shape": len(self.drawn.solids) + k} for k in range(len(self.bodies))]
        for kind, point, n in self.planes:
            at = center + n * ((point - center) @ n) if kind == "ground" else point
            walls.append({"kind": kind, "point": at, "normal": n, "size": 0.75 * size})
        slants = np.abs(_EYES @ self.tracks[0].impacts[0][0].normal / np.linalg.norm(_EYES[0]) - _SLANT)
        impacts = (impact for track in self.tracks for frames in track.impacts for impact in frames)
        axes = (float(np.linalg.norm(impact.ellipsoid, 2)) ** 0.5 for impact in impacts)
        feet = [point_on(self.objective.robot, foot.frame, foot.offset) for foot in self.objective.supports]
        joints = zip(model.parents, model.inertias, strict=True)
        jump = 0.3 * size / _largest(track["largest_jump"] for track in tracks)
        # The camera sees the tips of the arrows as well.
        radius = max(size / 2, *(_norm(centers + jump * arrows - center) for centers, arrows in arrows_of))
        content = {
            "joints": [{"parent": int(parent), "center": inertia.lever} for parent, inertia in joints],
            "parts": [
                {"joint": joint, "shape": solid, "pose": pin.SE3ToXYZQUAT(at), "color": color}
                for joint, solid, at, color in self.drawn.parts
            ],
            "shapes": [_solid(solid) for solid in (*self.drawn.solids, *map(hull_of, self.bodies))],
            "contacts": len(self.objective.contacts),
            "feet": [{"joint": foot.joint, "point": foot.position} for foot in feet],
            "walls": walls,
            "tracks": tracks,
            "ghost": self.ghost,
            "size": size,
            "radius": radius,
            "center": center,
            "eye": _EYES[np.argmin(slants)],
            "scale": {
                "ellipsoid": 0.16 * size / _largest(axes),
                "jump": jump,
                "force": 0.35 * size / _largest(_norm(t.forces) ** 0.5 for t in self.tracks if t.forces is not None),
            },
        }
        return _packed(content)

    def _track(self, track: Track) -> tuple[dict[str, Any], tuple[Array, Array]]:
        """Return the content of a track, and where its arrows begin and where to, shape (frames, links, 3) each."""
        robot, frames, data = self.objective.robot, len(track.q), self.objective.robot.model.createData()
        points = [point_on(robot, contact.frame, contact.offset) for contact in self.objective.contacts]
        poses, at = np.empty((frames, robot.model.njoints - 1, 7)), np.empty((frames, len(points), 3))
        arrows, centers = np.zeros((2, frames, robot.model.njoints, 3))
        for k, (q, jump) in enumerate(zip(track.q, track.jumps, strict=True)):
            pin.forwardKinematics(robot.model, data, q, jump)
            poses[k] = [pin.SE3ToXYZQUAT(placement) for placement in list(data.liMi)[1:]]
            at[k] = [data.oMi[point.joint].act(point.position) for point in points]
            for j in range(1, robot.model.njoints):
                twist, lever = data.v[j], robot.model.inertias[j].lever
                arrows[k, j] = data.oMi[j].rotation @ (twist.linear + np.cross(twist.angular, lever))
                centers[k, j] = data.oMi[j].act(lever)
        # The viewer interpolates linearly, so each quaternion takes the sign nearer to the quaternion before.
        for before, now in pairwise(poses[:, :, 3:]):
            now[(before * now).sum(axis=-1) < 0] *= -1
        frame_impacts, upper = list(zip(*track.impacts, strict=True)), np.triu_indices(3)
        content = {
            "unit": track.unit,
            "times": track.times.astype(np.float32),
            "poses": _levels(poses.reshape(frames, -1)),
            "points": _levels(at.reshape(frames, -1)),
            "normals": _rows([impact.normal for impact in frame] for frame in frame_impacts),
            "ellipsoids": _rows([root(impact.ellipsoid)[upper] for impact in frame] for frame in frame_impacts),
            "jumps": _levels(arrows.reshape(frames, -1)),
            "largest_jump": _norm(arrows),
            "forces": None if track.forces is None else _levels(track.forces),
            "curves": [values.astype(np.float32) for _, _, values in track.curves],
        }
        return content, (centers[:, 1:], arrows[:, 1:])

    def _box(self) -> tuple[Array, Array]:
        """Return the corners of the box around the robot at the first and last frame of each track."""
        robot: Robot = self.objective.robot
        data, corners = robot.model.createData(), []
        for q in (q for track in self.tracks for q in track.q[[0, -1]]):
            pin.forwardKinematics(robot.model, data, q)
            for joint, solid, placement, _ in self.drawn.parts:
                at = data.oMi[joint] * placement
                points = self.drawn.solids[solid].points @ at.rotation.T + at.translation
                corners += [points.min(axis=0), points.max(axis=0)]
        return np.min(corners, axis=0), np.max(corners, axis=0)


def impact_curves(impacts: Sequence[ImpactQuantities], metric: Metric, where: str = "") -> list[Curve]:
    """Return the curves of H, V and S of a contact; ``where`` follows their names."""
    units = {key: unit for key, unit, _ in quantities(metric)}
    return [
        (name + where, units[name], np.array([getattr(impact, name) for impact in impacts], dtype=float))
        for name in "HVS"
    ]


def _norm(vectors: Array) -> float:
    """Return the largest norm of vectors along the last axis."""
    return float(np.linalg.norm(vectors, axis=-1).max())


def _largest(values: Iterable[float]) -> float:
    """Return the largest value, or 1 if it is zero, so that a scale stays finite."""
    return max(values, default=0.0) or 1.0


def _solid(solid: Solid) -> dict[str, Any]:
    kind = np.uint16 if len(solid.corners) <= 65536 else np.uint32
    corners = {"values": _differences(solid.corners), "low": solid.low, "step": [solid.step] * 3}
    return {"corners": corners, "faces": _differences(solid.faces.astype(kind).reshape(-1, 1))}


def _rows(frames: Iterable[list[Array]]) -> dict[str, Any]:
    """Return the arrays of all contacts, a row for each frame, as :func:`_levels` does."""
    return _levels(np.array([np.concatenate(each) for each in frames]))


def _levels(columns: Array) -> dict[str, Any]:
    """Return columns as integer levels between the least and the largest value of each column."""
    low, step = columns.min(axis=0), np.maximum(np.ptp(columns, axis=0), 1e-12) / 65535
    values = np.round((columns - low) / step).astype(np.uint16)
    return {"values": _differences(values), "low": low, "step": step}


def _differences(rows: NDArray[Any]) -> NDArray[Any]:
    """Return the differences between rows of integers, the first from zero, because they compress better.

    They wrap around, and the sums in the viewer wrap back.
    """
    return np.diff(rows, axis=0, prepend=np.zeros_like(rows[:1]))


def _packed(content: dict[str, Any]) -> tuple[str, str]:
    buffer = bytearray()

    def place(array: Any) -> Any:
        if array.dtype.name not in _TYPES:
            return array.tolist()
        buffer.extend(bytes(-len(buffer) % 4))
        at = len(buffer)
        buffer.extend(array.tobytes())
        return [_TYPES[array.dtype.name], at, array.size]

    # JSON has no NaN.
    return json.dumps(content, default=place, allow_nan=False), zipped(bytes(buffer))


def zipped(content: bytes) -> str:
    """Return base64 of gzip without a time stamp, so that equal results have equal pages."""
    # The highest level takes three times as long and saves half a percent.
    return base64.b64encode(gzip.compress(content, 6, mtime=0)).decode("ascii")
