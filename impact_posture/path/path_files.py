"""Write and read the files of a path: CSV, NumPy arrays and a ROS ``JointTrajectory``."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from impact_posture.dynamics.chart import Chart
from impact_posture.errors import printable
from impact_posture.path.path_timing import LimitUse
from impact_posture.path.posture_path import PosturePath
from impact_posture.path.row_interpolation import INTERPOLATION
from impact_posture.path.strike import Strike
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array
from impact_posture.system.npz_files import read_arrays

_SHARES = ("at", "velocity", "torque", "thrust")
# Fields of a path in result.json.
_BLOCK = ("found", "reason", "method", "timing", "objective", "length", "max_violation")
_BASE = ("x", "y", "z", "qx", "qy", "qz", "qw")
# Larger numbers cannot be part of a path.
_LARGEST = 1e9


def write_path(folder: Path, robot: Robot, path: PosturePath) -> None:
    """Write ``path.csv``, ``path.npz`` and ``path.yaml`` into a folder.

    The rows of the CSV have the time ``t`` (s), positions ``q:…``, velocities ``v:…`` and accelerations ``a:…`` by
    name.  The angle of a continuous joint has no jumps at full turns.  The YAML is a
    ``trajectory_msgs/JointTrajectory``.  Between two rows, a motion along the quintic polynomial through both rows
    respects the limits.

    The last row of a path with a strike is the contact.  The column ``contact`` of the CSV is 1 there.  The NPZ
    contains the time of the contact, ``contact``, and a comment in the YAML states it.
    """
    names, angles = positions(robot, path.q)
    columns = [printable(name) for name in robot.tangent_names]
    with (folder / "path.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        head = [f"{kind}:{name}" for kind, each in (("q", names), ("v", columns), ("a", columns)) for name in each]
        table = np.column_stack([path.t, angles, path.v, path.a]).tolist()
        if path.strike is not None:
            head, table = [*head, "contact"], [[*row, int(row is table[-1])] for row in table]
        writer.writerow(["t", *head])
        writer.writerows(table)
    use = {} if path.use is None else {name: getattr(path.use, name) for name in _SHARES}
    more: dict[str, Any] = {} if path.strike is None else {"contact": path.strike.contact_s}
    np.savez_compressed(
        folder / "path.npz", t=path.t, q=path.q, v=path.v, a=path.a, objective=path.objectives,
        **{f"share_{name}": values for name, values in use.items()}, **more,
    )  # fmt: skip
    (folder / "path.yaml").write_text(_trajectory(robot, path, angles), encoding="utf-8")


def read_path(folder: Path, block: Mapping[str, Any], robot: Robot) -> PosturePath:
    """Read a path of a robot from ``path.npz`` and the block ``path`` of ``result.json``.

    Raise ``ValueError`` if the arrays do not fit each other or the robot.
    """
    arrays = {key: np.asarray(array, dtype=float) for key, array in read_arrays(folder / "path.npz").items()}
    shares = {key.removeprefix("share_"): array for key, array in arrays.items() if key.startswith("share_")}
    count, samples = arrays["t"].size, arrays["objective"].size
    wanted = {"t": (count,), "q": (count, robot.nq), "v": (count, robot.nv), "a": (count, robot.nv)}
    wanted |= {"objective": (samples,), **{f"share_{name}": (samples,) for name in shares}}
    for key, shape in wanted.items():
        finite = key in ("share_torque", "share_thrust") or np.isfinite(arrays[key]).all()
        if arrays[key].shape != shape or not finite or (np.abs(arrays[key]) > _LARGEST).any():
            raise ValueError(f"'{key}' of path.npz does not fit the path of {robot.name}")
    if count == 0 or (np.diff(arrays["t"]) <= 0).any():
        raise ValueError("the times of path.npz do not increase")
    return PosturePath(
        **{key: block[key] for key in _BLOCK},
        t=arrays["t"], q=arrays["q"], v=arrays["v"], a=arrays["a"],
        use=LimitUse(**shares, largest=block["limits"]) if shares else None,
        objectives=arrays["objective"],
        strike=_strike(block["strike"], robot) if "strike" in block else None,
    )  # fmt: skip


def _strike(block: Mapping[str, Any], robot: Robot) -> Strike:
    velocity = np.array(block["velocity"], dtype=float)
    if velocity.shape != (robot.nv,) or not np.isfinite(velocity).all():
        raise ValueError(f"the velocity of the strike does not fit {robot.name}")
    return Strike(**{**block, "velocity": velocity})


def positions(robot: Robot, q: Array) -> tuple[list[str], Array]:
    """Return names and values of the position coordinates along a path, shape (n, nx).

    A continuous joint has one coordinate, its angle.  A floating base has its position (m) and its quaternion, scalar
    last.
    """
    chart, names = Chart(robot.model), []
    x = np.array([chart.to_x(posture) for posture in q])
    for slot in chart.slots:
        width = slot.x.stop - slot.x.start
        if slot.kind.family == "free-flyer":
            names += [f"base {letter}" for letter in _BASE]
        else:
            names += [slot.name] if width == 1 else [f"{slot.name}[{k}]" for k in range(width)]
        if slot.kind.family in ("continuous", "planar"):
            x[:, slot.x.stop - 1] = np.unwrap(x[:, slot.x.stop - 1])
    return [printable(name) for name in names], x


def _trajectory(robot: Robot, path: PosturePath, angles: Array) -> str:
    """Return the ``JointTrajectory`` of all joints with one degree of freedom as YAML."""
    slots = [s for s in Chart(robot.model).slots if s.x.stop - s.x.start == 1]
    x, v = [s.x.start for s in slots], [s.v.start for s in slots]
    points = []
    for k, t in enumerate(path.t):
        whole, part = divmod(round(float(t) * 1e9), 10**9)
        points.append({
            "positions": angles[k, x].tolist(),
            "velocities": path.v[k, v].tolist(),
            "accelerations": path.a[k, v].tolist(),
            "time_from_start": {"sec": whole, "nanosec": part},
        })  # fmt: skip
    message = {"header": {"frame_id": ""}, "joint_names": [s.name for s in slots], "points": points}
    lines = [
        "# trajectory_msgs/JointTrajectory",
        f"# Interpolation: {INTERPOLATION} between points, as in joint_trajectory_controller",
    ]
    if robot.floating:
        lines.append("# The base floats: its pose over time is in path.csv (q:base ...).")
    if path.strike is not None:
        lines.append(f"# The contact is at the last point, at {path.strike.contact_s:.9g} s.")
    lines.append(yaml.safe_dump(message, sort_keys=False, default_flow_style=None, width=10**6))
    return "\n".join(lines)
