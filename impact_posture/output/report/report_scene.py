"""The 3-D scene of a report: robot, surfaces, obstacles and motions, encoded for the viewer."""

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
# Candidates for the initial direction from the center to the camera.
_EYES = np.array([[x, y, 0.55] for x in (1.1, -1.1) for y in (-1.25, 1.25)])
# Preferred cosine of the angle between the direction to the camera and the surface normal, for an oblique view.
_SLANT = 0.35
# Name, unit, and value of a curve at each frame.
Curve = tuple[str, str, Array]


@dataclass(frozen=True, eq=False)
class Track:
    """Motion of the robot as a sequence of animation frames.

    Attributes:
        name: Name of the motion in a report with several motions.
        times: Time (s) or path length (rad mixed with m) of each frame, increasing, shape (frames,).
        unit: ``s`` for times; empty for path lengths.
        q: Configurations, shape (frames, nq).
        impacts: For each contact, the impact quantities at each frame.
        jumps: Velocity jumps ``Δν``, shape (frames, nv).
        curves: Curves to draw.  Undefined values are NaN.
        forces: Contact force on the robot, world, N, shape (frames, 3); ``None`` to draw no force.
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
        drawn: Shapes of the robot.
        objective: Objective with robot, contacts and supports.
        tracks: Motions of the robot that the viewer can show.
        planes: Name (``surface`` or ``ground``), point (m) and unit normal of each plane, world.
        bodies: Vertices of convex obstacles, world, m, shape (k, 3) each.
        ghost: Whether the robot at the first frame stays visible while the robot moves.
    """

    drawn: DrawnRobot
    objective: WorstCaseObjective
    tracks: tuple[Track, ...]
    planes: tuple[tuple[str, Array, Array], ...]
    bodies: tuple[Array, ...]
    ghost: bool

    @cached_property
    def packed(self) -> tuple[str, str]:
        """The scene as JSON, and a gzipped buffer as base64.  The JSON refers to arrays in the buffer."""
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
        # The initial view includes the tips of the arrows.
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
        """Return the JSON content of a motion, and tails and vectors of its arrows, shape (frames, links, 3) each."""
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
        # The viewer interpolates linearly.  For each quaternion, choose the sign that is closer to the previous
        # quaternion.
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
    """Return the curves of H, V and S at one contact; ``where`` is appended to the names of the curves."""
    units = {key: unit for key, unit, _ in quantities(metric)}
    return [
        (name + where, units[name], np.array([getattr(impact, name) for impact in impacts], dtype=float))
        for name in "HVS"
    ]


def _norm(vectors: Array) -> float:
    return float(np.linalg.norm(vectors, axis=-1).max())


def _largest(values: Iterable[float]) -> float:
    """Return the largest value, or 1 if it is zero, because the caller divides by it."""
    return max(values, default=0.0) or 1.0


def _solid(solid: Solid) -> dict[str, Any]:
    kind = np.uint16 if len(solid.corners) <= 65536 else np.uint32
    corners = {"values": _differences(solid.corners), "low": solid.low, "step": [solid.step] * 3}
    return {"corners": corners, "faces": _differences(solid.faces.astype(kind).reshape(-1, 1))}


def _rows(frames: Iterable[list[Array]]) -> dict[str, Any]:
    return _levels(np.array([np.concatenate(each) for each in frames]))


def _levels(columns: Array) -> dict[str, Any]:
    """Encode each column as integers from 0 (smallest value) to 65535 (largest value)."""
    low, step = columns.min(axis=0), np.maximum(np.ptp(columns, axis=0), 1e-12) / 65535
    values = np.round((columns - low) / step).astype(np.uint16)
    return {"values": _differences(values), "low": low, "step": step}


def _differences(rows: NDArray[Any]) -> NDArray[Any]:
    """Return the differences of successive rows, because differences compress better than values.

    Differences of unsigned integers overflow.  The viewer adds them with the same overflow, so it restores the exact
    values.
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

    # ``allow_nan=False`` raises an error for NaN, which JSON does not support.
    return json.dumps(content, default=place, allow_nan=False), zipped(bytes(buffer))


def zipped(content: bytes) -> str:
    """Compress with gzip and encode as base64, without a time stamp, so that equal results have equal pages."""
    # The highest compression level takes three times as long and saves half a percent.
    return base64.b64encode(gzip.compress(content, 6, mtime=0)).decode("ascii")
