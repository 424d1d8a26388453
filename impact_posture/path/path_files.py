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
from impact_posture.path.follow_through import FollowThrough, Room
from impact_posture.path.path_timing import LimitUse
from impact_posture.path.posture_path import PosturePath
from impact_posture.path.row_interpolation import INTERPOLATION, RowInterpolation
from impact_posture.path.strike import Strike
from impact_posture.path.time_law import DIGITS
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array
from impact_posture.system.npz_files import read_arrays

_SHARES = ("at", "velocity", "torque", "thrust")
# Fields of a path in result.json.
_BLOCK = ("found", "reason", "method", "timing", "objective", "length", "max_violation")
_BASE = ("x", "y", "z", "qx", "qy", "qz", "qw")
# Largest number that a path may contain.
_LARGEST = 1e9
# Least time between two rows, s, because the times of rows have 9 decimals.
_SHORTEST = 0.5 * 10.0**-DIGITS
# Numbers of a strike in result.json.
_STRIKE = ("speed", "stated_speed", "rest_s", "run_up_s", "run_up_m", "contact_s", "share")


def write_path(folder: Path, robot: Robot, path: PosturePath) -> None:
    """Write ``path.csv``, ``path.npz`` and ``path.yaml`` into a folder.

    The rows of the CSV have the time ``t`` (s), positions ``q:…``, velocities ``v:…`` and accelerations ``a:…`` by
    name.  The angle of a continuous joint has no jumps at full turns.  The YAML is a
    ``trajectory_msgs/JointTrajectory``.  Between two rows, a motion along the quintic polynomial through both rows
    respects the limits.

    The last row of a path with a strike is the contact.  In this row, the column ``contact`` of the CSV is 1.  The
    NPZ contains the time of the contact as ``contact``, and the YAML in a comment.  The files ``follow_through.*``
    contain the stop after the impact, whose first row is the contact.
    """
    use = {} if path.use is None else {name: getattr(path.use, name) for name in _SHARES}
    arrays = {"objective": path.objectives, **{f"share_{name}": values for name, values in use.items()}}
    if (strike := path.strike) is None:
        _write_rows(folder / "path", robot, path, arrays)
        return
    note = f"# The contact is at the last point, at {strike.contact_s:.9g} s."
    _write_rows(folder / "path", robot, path, arrays | {"contact": np.array(strike.contact_s)}, note, len(path.t) - 1)
    if (after := strike.follow_through) is not None and after.rows is not None:
        note = "# The contact is at the first point, with the velocities after the predicted impact."
        _write_rows(folder / "follow_through", robot, after.rows, {"contact": np.array(0.0)}, note, 0)


def _write_rows(
    stem: Path,
    robot: Robot,
    rows: RowInterpolation,
    arrays: dict[str, Array],
    note: str = "",
    contact: int | None = None,
) -> None:
    """Write the rows of a motion as CSV, NPZ and YAML; ``contact`` is the row of the contact."""
    names, angles = positions(robot, rows.q)
    columns = [printable(name) for name in robot.tangent_names]
    table = [rows.t, angles, rows.v, rows.a]
    with stem.with_suffix(".csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        head = [f"{kind}:{name}" for kind, each in (("q", names), ("v", columns), ("a", columns)) for name in each]
        writer.writerow(["t", *head, *([] if contact is None else ["contact"])])
        for k, row in enumerate(np.column_stack(table).tolist()):
            writer.writerow([*row, *([] if contact is None else [int(k == contact)])])
    every: dict[str, Any] = {**{key: getattr(rows, key) for key in "tqva"}, **arrays}
    np.savez_compressed(stem.with_suffix(".npz"), **every)
    stem.with_suffix(".yaml").write_text(_trajectory(robot, rows, angles, note), encoding="utf-8")


def read_path(folder: Path, block: Mapping[str, Any], robot: Robot) -> PosturePath:
    """Read a path of a robot from ``path.npz`` and the block ``path`` of ``result.json``.

    Raise ``ValueError`` if the arrays do not fit each other or the robot.
    """
    rows, arrays = _read_rows(folder / "path.npz", robot)
    shares = {key.removeprefix("share_"): array for key, array in arrays.items() if key.startswith("share_")}
    return PosturePath(
        **vars(rows),
        **{key: block[key] for key in _BLOCK},
        use=LimitUse(**shares, largest=block["limits"]) if shares else None,
        objectives=arrays["objective"],
        strike=_read_strike(folder, block["strike"], rows, robot) if "strike" in block else None,
    )  # fmt: skip


def _read_rows(file: Path, robot: Robot) -> tuple[RowInterpolation, dict[str, Array]]:
    """Return a motion and all arrays of its file, which are checked."""
    arrays = {key: np.asarray(array, dtype=float) for key, array in read_arrays(file).items()}
    count, samples = arrays["t"].size, arrays["objective"].size if "objective" in arrays else 0
    wanted = {"t": (count,), "q": (count, robot.nq), "v": (count, robot.nv), "a": (count, robot.nv), "contact": ()}
    for key in arrays:
        shape = wanted.get(key, (samples,))
        finite = key in ("share_torque", "share_thrust") or np.isfinite(arrays[key]).all()
        if arrays[key].shape != shape or not finite or (np.abs(arrays[key]) > _LARGEST).any():
            raise ValueError(f"'{key}' of {file.name} does not fit the path of {robot.name}")
    if count == 0 or arrays["t"][0] != 0 or (np.diff(arrays["t"]) < _SHORTEST).any():
        raise ValueError(f"the times of {file.name} do not increase from 0")
    return RowInterpolation(robot.model, *(arrays[key] for key in "tqva")), arrays


def _read_strike(folder: Path, block: Mapping[str, Any], path: RowInterpolation, robot: Robot) -> Strike:
    """Return the strike of a path from its block in ``result.json`` and ``follow_through.npz``."""
    # Files of earlier versions have no ``rest_s``, because every run-up began at rest.
    block = {"rest_s": block["run_up_s"], **block}
    numbers = np.array([block[key] for key in _STRIKE])
    known = numbers.dtype == float and np.isfinite(numbers).all() and (numbers >= 0).all() and block["speed"] > 0
    if not known or not block["rest_s"] <= block["run_up_s"] < block["contact_s"] == path.t[-1]:
        raise ValueError(f"speed and times of the strike do not fit the path of {robot.name}")
    after = {key: value for key, value in block["follow_through"].items() if key != "duration_s"}
    velocities = [np.array(part["velocity"], dtype=float) for part in (block, after)]
    same = np.array_equal(velocities[0], path.v[-1])
    if not same or velocities[1].shape != (robot.nv,) or not np.isfinite(velocities[1]).all():
        raise ValueError(f"the velocity of the strike does not fit {robot.name}")
    rows = None
    if block["follow_through"]["duration_s"] is not None:
        rows, _ = _read_rows(folder / "follow_through.npz", robot)
        if len(rows.t) == 1 or not np.array_equal(rows.q[0], path.q[-1]):
            raise ValueError("follow_through.npz does not begin at the end of path.npz")
    rooms = ("joints", "clearance", "center_of_pressure")
    after |= {key: Room(**after[key]) for key in rooms if after.get(key) is not None}
    ends = FollowThrough(**after | {"velocity": velocities[1], "rows": rows})
    return Strike(**{**block, "velocity": velocities[0], "follow_through": ends})


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


def _trajectory(robot: Robot, path: RowInterpolation, angles: Array, note: str) -> str:
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
        lines.append("# The base floats: its pose over time is in the CSV (q:base ...).")
    lines += [note] if note else []
    # The emitter of libyaml writes the same text four times as fast, but not every installation has it.
    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
    lines.append(yaml.dump(message, Dumper=dumper, sort_keys=False, default_flow_style=None, width=10**6))
    return "\n".join(lines)
