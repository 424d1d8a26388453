"""Paths with a strike for tests of their references: arbitrary rows that no robot can follow."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pinocchio as pin

from impact_posture.controller_export.controller_parameters import parameters
from impact_posture.controller_export.controller_source import render
from impact_posture.controller_export.controller_structure import structure_of
from impact_posture.controller_export.path_source import render_path
from impact_posture.path.follow_through import FollowThrough
from impact_posture.path.path_reference import PathReference
from impact_posture.path.posture_path import PosturePath
from impact_posture.path.row_interpolation import RowInterpolation
from impact_posture.path.strike import Strike
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array
from tests.support.exported_controller import formulation_of


@cache
def reference_of(name: str, strikes: bool = True, size: float = 1.0, rest: float = 0.25) -> PathReference:
    """Return the references of a robot along :func:`struck_path`."""
    robot, _ = formulation_of(name)
    approach = np.random.default_rng(5).normal(size=robot.nv)
    rotors = 0.012 if robot.floating else 0.0
    return PathReference(
        struck_path(robot, approach, strikes=strikes, size=size, rest=rest), approach if strikes else None, rotors
    )


def write_references(folder: Path, name: str, strikes: bool = True, size: float = 1.0, rest: float = 0.25) -> Path:
    """Write the references of a robot and the headers of its controller into a new folder, and return the folder."""
    structure = structure_of(*formulation_of(name))
    files = render(structure, tuple(parameters(structure, 1e-3)), "ctl", "", None)
    files |= render_path(structure, reference_of(name, strikes, size, rest), "ctl")
    folder.mkdir()
    for file in ("ctl.h", "ctl_dynamics.h", "ctl_path.h", "ctl_path.c", "example.c"):
        (folder / file).write_text(files[file], encoding="utf-8")
    return folder


def struck_path(
    robot: Robot, approach: Array, *, strikes: bool = True, size: float = 1.0, rest: float = 0.25
) -> PosturePath:
    """Return a path of 0.4 s, and a stop of 0.2 s.

    The run-up begins at 0.25 s and ends with ``approach · ν = 1``.  The motions are proportional to ``size``.  The
    robot is last at rest at the time ``rest``, 0.25 s or 0 s.
    """
    rng = np.random.default_rng(2)
    first = _rows(robot, rng, np.linspace(0.0, 0.4, 9), robot.posture(), size)
    still = [0, 5, -1] if rest else [0, -1]
    first.v[still] = 0.0
    first.a[still] = 0.0
    strike = None
    if strikes:
        first.v[-1] = approach / (approach @ approach)
        after = FollowThrough(first.v[-1], None, 1, 1, 0.2, None, None)
        after = FollowThrough(
            **vars(after) | {"rows": _rows(robot, rng, np.linspace(0.0, 0.2, 5), first.q[-1], size)}
        )
        strike = Strike(1.0, 1.0, rest, 0.25, 0.05, 0.4, first.v[-1], 0.1, follow_through=after)
    return PosturePath(
        **vars(first), found=True, reason="", method="", timing="", objective=0.0, length=0.0, max_violation=0.0,
        strike=strike,
    )  # fmt: skip


def _rows(robot: Robot, rng: np.random.Generator, t: Array, q: Array, size: float) -> RowInterpolation:
    postures = [q]
    for _ in t[1:]:
        step = 0.4 * size * rng.normal(size=robot.nv)
        postures.append(np.array(pin.integrate(robot.model, postures[-1], step)))
    v, a = (k * size * rng.normal(size=(len(t), robot.nv)) for k in (5.0, 50.0))
    return RowInterpolation(robot.model, t, np.array(postures), v, a)
