"""Write the C text of references along a path: polynomials between its rows, and the phases of a strike."""

from __future__ import annotations

import numpy as np

from impact_posture.codegen.c_literals import c_double
from impact_posture.codegen.export_files import environment
from impact_posture.controller_export.controller_source import core_text, named, table
from impact_posture.controller_export.controller_structure import Structure
from impact_posture.errors import InputError
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.path.path_reference import PathReference
from impact_posture.path.posture_path import PosturePath
from impact_posture.path.row_interpolation import RowInterpolation
from impact_posture.path.strike import FREE_FALL
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array
from impact_posture.system.escape import c_comment
from impact_posture.version import __version__

# Files of the folder c/, in the order in which they are joined.
_CORE = ("vector.c", "manifold.c", "path_reference.c")
_TABLES = ("joint_family", "joint_q", "joint_v")


def path_reference(robot: Robot, path: PosturePath, objective: WorstCaseObjective | None) -> PathReference:
    """Return the references along a path in Python; the path strikes with the contact of the objective.

    With an objective, a contact is also detected when the contact point stops.
    """
    oracle = None if objective is None else objective.oracle.at(path.q[-1])
    rotors = robot.spec.propulsion
    return PathReference(path, None if oracle is None else -oracle.n @ oracle.J, rotors.lag if rotors else 0.0)


def render_path(s: Structure, reference: PathReference, prefix: str) -> dict[str, str]:
    """Return file name → text of ``<prefix>_path.h``, ``<prefix>_path.c`` and ``example.c``.

    Raises:
        InputError: The path is for another robot, the path contains no motion or a free fall, or the references of
            the controller come from a reference flow.
    """
    path, strike = reference.path, reference.path.strike
    fault = ""
    if (path.model.nq, path.model.nv) != (s.robot.nq, s.robot.nv):
        fault, hint = f"does not have the joints of {s.robot.name}", "give a path of the same robot"
    elif len(path.t) < 2:
        fault, hint = f"has no motion ({path.reason or 'the start is the optimum'})", "leave the path out"
    elif s.flow is not None:
        fault, hint = "contradicts the reference flow, which moves the same references", "leave out one of them"
    elif path.timing == FREE_FALL:
        fault, hint = "is a free fall, but the feet of the controller stay on the ground", "leave the path out"
    if fault:
        raise InputError(fault, where="path", hint=hint)
    stop = strike and strike.follow_through and strike.follow_through.rows
    numbers = {
        "rest": path.duration if strike is None else strike.rest_s,
        "run_up": path.duration if strike is None else strike.run_up_s,
        "again": reference.again,
        "duration": path.duration,
        "stop": float(stop.t[-1]) if stop else 0.0,
        "speed": 0.0 if strike is None else strike.speed,
    }
    tables = {name: s.tables[name] for name in _TABLES} | {
        "path_rows": _segments(path),
        "path_stop_rows": _segments(stop) if stop else np.zeros(1),
        "path_end": path.q[-1],
        "path_velocity": path.v[-1],
        "path_approach": reference.approach[0],
        "path_defaults": np.array([reference.late, reference.felt, reference.stopped, reference.lag]),
    }
    context = {
        "robot": s.robot.name, "version": __version__, "prefix": prefix, "nq": s.robot.nq, "nv": s.robot.nv,
        "strikes": strike is not None, "numbers": {name: c_double(value) for name, value in numbers.items()},
        "segments": len(path.t) - 1, "stop_segments": len(stop.t) - 1 if stop else 0,
        "tables": [(name, *table(values)) for name, values in tables.items()],
        "core": "\n".join(map(core_text, _CORE)),
    }  # fmt: skip
    templates = environment("impact_posture.controller_export", c_comment)
    files = {f"{prefix}_path.h": "path.h", f"{prefix}_path.c": "path.c", "example.c": "example_path.c"}
    return {
        name: named(templates.get_template(f"{template}.jinja").render(context), prefix)
        for name, template in files.items()
    }


def _segments(rows: RowInterpolation) -> Array:
    """Return the numbers of all segments: begin (s), posture, and coefficients, shape (n − 1, 1 + nq + 5 nv)."""
    coefficients = [rows.coefficients(k).ravel() for k in range(len(rows.t) - 1)]
    return np.column_stack([rows.t[:-1], rows.q[:-1], coefficients])
