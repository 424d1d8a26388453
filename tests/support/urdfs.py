"""Small URDFs for tests, written from short descriptions of links and joints, and their meshes."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import load_robot
from impact_posture.system.arrays import Array

MOVED = '<limit lower="-2.5" upper="2.5" effort="100" velocity="5"/>'


def link(name: str, mass: float = 0.0, at: str = "0 0 0", box: str = "", more: str = "") -> str:
    """Return a link with a center of mass at ``at``, a box of this size around it, and more elements."""
    moment = 0.01 * mass
    inertia = f'<inertia ixx="{moment}" iyy="{1.5 * moment}" izz="{2 * moment}" ixy="0" ixz="0" iyz="0"/>'
    inertial = f'<inertial><origin xyz="{at}"/><mass value="{mass}"/>{inertia}</inertial>' if mass else ""
    solid = f'<collision><origin xyz="{at}"/><geometry><box size="{box}"/></geometry></collision>' if box else ""
    return f'<link name="{name}">{inertial}{solid}{more}</link>'


def joint(
    name: str, ends: str, axis: str | None = "0 1 0", at: str = "0 0 0", kind: str = "revolute", more: str = MOVED
) -> str:
    """Return a joint; ``ends`` are the names of the parent link and the child link."""
    parent, child = ends.split()
    tag = "" if axis is None else f'<axis xyz="{axis}"/>'
    body = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{at}"/>{tag}{more}'
    return f'<joint name="{name}" type="{kind}">{body}</joint>'


def write(folder: Path, *elements: str, toml: str = "") -> Path:
    """Write a URDF and a robot.toml into ``folder``; return the path of the URDF."""
    (folder / "robot.toml").write_text(toml, encoding="utf-8")
    path = folder / "written.urdf"
    path.write_text(f'<robot name="written">{"".join(elements)}</robot>', encoding="utf-8")
    return path


def load(folder: Path, *elements: str, toml: str = "", **options: Any) -> Robot:
    """Load the robot that :func:`write` writes."""
    return load_robot(str(write(folder, *elements, toml=toml)), **options)


def stl(path: Path, triangles: Array) -> Path:
    """Write triangles, shape (k, 3, 3), as a binary STL file."""
    records = np.zeros(len(triangles), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("unused", "<u2")])
    records["corners"] = triangles
    path.write_bytes(b"\0" * 80 + struct.pack("<I", len(triangles)) + records.tobytes())
    return path
