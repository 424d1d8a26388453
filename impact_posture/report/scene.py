"""The 3-D scene of a report: the robot, what stands around it, and what moves, packed for the viewer."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.arrays import Array
from impact_posture.impact.contact import ImpactContact, point_on
from impact_posture.plot.shapes import root
from impact_posture.report.shapes import DrawnRobot, Solid, quantized_hull
from impact_posture.robot.robot import Robot

_TYPES = {"uint16": "u2", "uint32": "u4", "float32": "f4"}
# Directions from which the camera may look first.
_EYES = np.array([[x, y, 0.55] for x in (1.1, -1.1) for y in (-1.25, 1.25)])
# The camera sees the surface under this cosine with its normal best: neither edge-on nor from behind.
_SLANT = 0.35


@dataclass(frozen=True, eq=False)
class Series:
    """A quantity at the frames of a track.

    Attributes:
        name: Name in the chart.
        unit: Unit; empty for none.
        values: Values, shape (frames,); NaN where undefined.
    """

    name: str
    unit: str
    values: Array


@dataclass(frozen=True, eq=False)
class Track:
    """A motion of the robot, frame by frame.

    Attributes:
        name: Name where there are several.
        times: Times, s, or the way along a path, rad mixed with m, increasing, shape (frames,).
        unit: ``s`` for times; empty for a way.
        q: Configurations, shape (frames, nq).
        ellipsoids: ``Λ_c`` of the impact, shape (frames, 3, 3).
        normals: World normals, shape (frames, 3).
        jumps: Velocity jump ``Δν``, shape (frames, nv).
        series: Curves.
        forces: Contact force on the robot, world, N, shape (frames, 3); ``None`` to show none.
    """

    name: str
    times: Array
    unit: str
    q: Array
    ellipsoids: Array
    normals: Array
    jumps: Array
    series: tuple[Series, ...]
    forces: Array | None = None


@dataclass(frozen=True, eq=False)
class Wall:
    """A plane or a convex body that stands in the world.

    Attributes:
        kind: ``surface``, ``ground`` or ``body``.
        points: A point of the plane, shape (1, 3), or points whose hull is the body, shape (k, 3), world, m.
        normal: World unit normal of the plane, shape (3,).
    """

    kind: str
    points: Array
    normal: Array | None = None


@dataclass(frozen=True, eq=False)
class Scene:
    """All that the viewer draws.

    Attributes:
        robot: The robot.
        drawn: Its shapes.
        contact: The contact of the impact.
        tracks: Motions to choose from.
        walls: What stands around the robot.
        ghost: Whether the first frame stays visible while the robot moves on.
    """

    robot: Robot
    drawn: DrawnRobot
    contact: ImpactContact
    tracks: tuple[Track, ...]
    walls: tuple[Wall, ...]
    ghost: bool

    def pack(self) -> tuple[str, str]:
        """Return the scene as JSON, and its arrays as base64 of a gzipped buffer into which the JSON points."""
        model, solids = self.robot.model, list(self.drawn.solids)
        tracks = [self._track(track) for track in self.tracks]
        low, high = self._box()
        size, center = float(np.linalg.norm(high - low)), (low + high) / 2
        walls: list[dict[str, Any]] = []
        for wall in self.walls:
            if wall.normal is None:
                walls.append({"kind": wall.kind, "shape": len(solids)})
                solids.append(quantized_hull(wall.points))
            else:
                at = (
                    center + wall.normal * ((wall.points[0] - center) @ wall.normal)
                    if wall.kind == "ground"
                    else wall.points[0]
                )
                walls.append({"kind": wall.kind, "point": at, "normal": wall.normal, "size": 0.75 * size})
        normal = self.tracks[0].normals[0]
        pairs = zip(model.parents, model.inertias, strict=True)
        parts = [(p.joint, p.solid, pin.SE3ToXYZQUAT(p.placement), p.color) for p in self.drawn.parts]
        content = {
            "joints": [{"parent": int(parent), "center": inertia.lever.tolist()} for parent, inertia in pairs],
            "parts": [dict(zip(("joint", "shape", "pose", "color"), part, strict=True)) for part in parts],
            "shapes": [_solid(solid) for solid in solids],
            "walls": walls,
            "tracks": tracks,
            "ghost": self.ghost,
            "size": size,
            "center": center.tolist(),
            "eye": _EYES[np.argmin(np.abs(_EYES @ normal / np.linalg.norm(_EYES[0]) - _SLANT))].tolist(),
            "scale": {
                "ellipsoid": 0.16 * size / _largest(map(_longest_axis, self.tracks)),
                "jump": 0.3 * size / _largest(track["largest_jump"] for track in tracks),
                "force": 0.35 * size / _largest(_norms(t.forces) ** 0.5 for t in self.tracks if t.forces is not None),
            },
        }  # fmt: skip
        return _packed(content)

    def _track(self, track: Track) -> dict[str, Any]:
        robot, point = self.robot, point_on(self.robot, self.contact.frame, self.contact.offset)
        data, frames = robot.model.createData(), len(track.q)
        poses, at = np.empty((frames, robot.model.njoints - 1, 7)), np.empty((frames, 3))
        arrows = np.zeros((frames, robot.model.njoints, 3))
        for k, (q, jump) in enumerate(zip(track.q, track.jumps, strict=True)):
            pin.forwardKinematics(robot.model, data, q, jump)
            poses[k] = [pin.SE3ToXYZQUAT(placement) for placement in list(data.liMi)[1:]]
            at[k] = data.oMi[point.joint].act(point.position)
            for j in range(1, robot.model.njoints):
                twist, lever = data.v[j], robot.model.inertias[j].lever
                arrows[k, j] = data.oMi[j].rotation @ (twist.linear + np.cross(twist.angular, lever))
        _straighten(poses[:, :, 3:])
        return {
            "unit": track.unit,
            "times": track.times.astype(np.float32),
            "poses": _levels(poses.reshape(frames, -1)),
            "points": _levels(at),
            "normals": _levels(track.normals),
            "ellipsoids": _levels(np.array([root(e)[np.triu_indices(3)] for e in track.ellipsoids])),
            "jumps": _levels(arrows.reshape(frames, -1)),
            "largest_jump": _norms(arrows),
            "forces": None if track.forces is None else _levels(track.forces),
            "series": [{"values": s.values.astype(np.float32)} for s in track.series],
        }

    def _box(self) -> tuple[Array, Array]:
        """Return the corners of the box around the robot at the first and last frame of each track."""
        data, found = self.robot.model.createData(), []
        for track in self.tracks:
            for q in track.q[[0, -1]]:
                pin.forwardKinematics(self.robot.model, data, q)
                for part in self.drawn.parts:
                    points, at = self.drawn.solids[part.solid].points, data.oMi[part.joint] * part.placement
                    found += [f(points @ at.rotation.T + at.translation, axis=0) for f in (np.min, np.max)]
        return np.min(found, axis=0), np.max(found, axis=0)


def _norms(vectors: Array) -> float:
    """Return the largest norm of vectors along the last axis."""
    return float(np.linalg.norm(vectors, axis=-1).max())


def _longest_axis(track: Track) -> float:
    return float(np.sqrt(np.linalg.eigvalsh(track.ellipsoids).max()))


def _largest(values: Iterable[float]) -> float:
    """Return the largest value, or one where all are zero, so that a scale stays finite."""
    return float(max(values, default=0.0)) or 1.0


def _straighten(quaternions: Array) -> None:
    """Choose the sign of each quaternion that is nearer to the last frame's, so that the viewer can go between."""
    for before, now in pairwise(quaternions):
        now[(before * now).sum(axis=-1) < 0] *= -1


def _solid(solid: Solid) -> dict[str, Any]:
    kind = np.uint16 if len(solid.corners) <= 65536 else np.uint32
    corners = {"values": _differences(solid.corners), "low": solid.low.tolist(), "step": [solid.step] * 3}
    return {"corners": corners, "faces": _differences(solid.faces.astype(kind).reshape(-1, 1))}


def _differences(rows: NDArray[Any]) -> NDArray[Any]:
    """Return the differences between rows of whole numbers, the first from zero, which compress better.

    They wrap around, and the sums of the viewer wrap back.
    """
    return np.diff(rows, axis=0, prepend=np.zeros_like(rows[:1]))


def _levels(columns: Array) -> dict[str, Any]:
    """Return columns as whole levels between the least and the largest value of each."""
    low, step = columns.min(axis=0), np.maximum(np.ptp(columns, axis=0), 1e-12) / 65535
    values = np.round((columns - low) / step).astype(np.uint16)
    return {"values": _differences(values), "low": low.tolist(), "step": step.tolist()}


def _packed(content: dict[str, Any]) -> tuple[str, str]:
    buffer = bytearray()

    def place(array: Any) -> Any:
        if array.dtype.name not in _TYPES:
            return array.tolist()
        buffer.extend(bytes(-len(buffer) % 4))
        at = len(buffer)
        buffer.extend(array.tobytes())
        return [_TYPES[array.dtype.name], at, array.size]

    text = json.dumps(content, default=place)
    # A packed page of the same result is the same, so no time of day is in it.
    return text, base64.b64encode(gzip.compress(bytes(buffer), 6, mtime=0)).decode("ascii")
