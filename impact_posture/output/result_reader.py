"""Read a result folder, and collect the data for the figures and the report of the result."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from impact_posture.config.problem_settings import Against
from impact_posture.errors import SpecError, shown
from impact_posture.output.quantity_table import answer_key
from impact_posture.posture.analysis.result_document import SCHEMA
from impact_posture.posture.formulation.problem_file import Prepared, prepare, read_settings
from impact_posture.posture.manifold.null_space_path import NullSpacePath
from impact_posture.posture.search.global_search import SelfMotionMap
from impact_posture.robot.model_joints import rigid_groups
from impact_posture.system.arrays import Array
from impact_posture.system.npz_files import fitting_arrays, read_arrays
from impact_posture.system.text_files import read_text

# Import matplotlib only where it is used, because the import takes longer than solving a small problem.
if TYPE_CHECKING:
    from impact_posture.output.plot import ResultView, TradeOffData
    from impact_posture.path.posture_path import PosturePath
    from impact_posture.robot.robot import Robot

# Arrays of a null-space path and of a self-motion map.  Undefined quantities are NaN.
_PATH = {"q": "real n nq", "s": "real n", **dict.fromkeys(("H", "G", "V", "S", "objective"), "float n")}
_MAP = {
    "q": "real n nq", "component": "index n", "s": "real n", "objective": "float n", "feasible": "bool n",
    "start": "index one", "optimum": "index one", "ends": "index optima",
}  # fmt: skip
# Whole numbers with fewer digits can be converted to a float.
_DIGITS = 300
# Exceptions that a changed or incomplete result can cause.
_BROKEN = (LookupError, ValueError, TypeError, AttributeError, OSError, RecursionError)


@dataclass(frozen=True, eq=False)
class SolvedPostures:
    """Postures and numbers from a result folder.

    Attributes:
        initial: Initial posture, shape (nq,).
        answer: Posture of ``posture.json``, shape (nq,): the optimum, or the posture where the path towards it ends.
        path: Null-space path between both postures.
        document: Content of ``result.json``.
        mapped: Map of the self-motion manifold; ``None`` if it was not computed.
    """

    initial: Array
    answer: Array
    path: NullSpacePath
    document: dict[str, Any]
    mapped: SelfMotionMap | None


def load_view(folder: Path) -> ResultView:
    """Read the data for the figures of a result folder; errors are as in :func:`load_result`."""
    return load_result(folder)[1]


def rewrite_report(folder: Path, *, meshes: bool = False, force: bool = False) -> Path:
    """Write ``report.html`` of a result folder again; return its path.

    Raises:
        SpecError: As in :func:`load_result`.
        OutputError: A ``report.html`` of the user would be replaced and ``force`` is false, or the report cannot be
            written.
    """
    from impact_posture.output.report.result_report import write_result_report

    loaded = load_result(folder)
    try:
        return write_result_report(folder, *loaded, meshes=meshes, force=force)
    except _BROKEN as error:
        raise _broken(folder, error) from None


def load_result(folder: Path) -> tuple[Prepared, ResultView, dict[str, Any]]:
    """Read the problem, the data for figures, and ``result.json`` from a result folder.

    Raises:
        SpecError: The folder is not a complete result, or was written for another robot model.
    """
    if not os.path.isfile(folder / "result.json"):
        raise SpecError("holds no result.json", where=str(folder), hint="name a folder that optimize wrote")
    try:
        document = json.loads(read_text(folder / "result.json"), parse_constant=_refuse, parse_int=_whole)
        if document["schema"] != SCHEMA:
            fault = f"schema '{shown(document['schema'])}'"
            raise SpecError(fault, where=str(folder / "result.json"), hint="run optimize again")
        prepared = prepare(read_settings(folder / "problem.toml"))
        robot, recorded = prepared.impact.robot, str(document["robot"]["model_sha256"])
        arrays, sizes = read_arrays(folder / "result.npz"), {"nq": prepared.impact.robot.nq, "one": 1}
        path = NullSpacePath(**fitting_arrays(arrays, "path_", _PATH, **sizes))
        has_map = "self_motion_q" in arrays
        mapped = SelfMotionMap(**fitting_arrays(arrays, "self_motion_", _MAP, **sizes)) if has_map else None
        if recorded != robot.model_sha256:
            fault = f"was made with another model of {robot.name} (sha256 {recorded[:12]}…)"
            hint = "run optimize again, or use the URDF and armature of that result"
            raise SpecError(fault, where=str(folder), hint=hint)
        initial, answer = (
            robot.check_posture(document[key]["q"], limits=False, where=f"{folder / 'result.json'}: {key}.q")
            for key in ("initial", answer_key(document))
        )
        postures = SolvedPostures(initial, answer, path, document, mapped)
        return prepared, result_view(prepared, postures, motion_of(folder, document, robot)), document
    except _BROKEN as error:
        raise _broken(folder, error) from None


def _refuse(text: str) -> int:
    raise ValueError(f"{shown(text)} is too large for a number in a result")


def _whole(text: str) -> int:
    """Return a whole number that a float can hold."""
    return int(text) if len(text) < _DIGITS else _refuse(text)


def _broken(folder: Path, error: Exception) -> SpecError:
    reason = f"{type(error).__name__}: {error}"
    if isinstance(error, OSError) and error.filename:
        reason = f"{Path(error.filename).name}: {error.strerror}"
    what = f"is not a whole result ({reason})"
    return SpecError(what, where=str(folder), hint="run optimize again")


def motion_of(folder: Path, document: dict[str, Any], robot: Robot) -> PosturePath | None:
    """Read the path to the optimum from a result folder; ``None`` if the result has no path."""
    if "path" not in document:
        return None
    from impact_posture.path.path_files import read_path

    return read_path(folder, document["path"], robot)


def result_view(prepared: Prepared, postures: SolvedPostures, motion: PosturePath | None) -> ResultView:
    """Return the data for the figures and the report of a result.  ``motion`` is the path to the optimum."""
    from impact_posture.output.plot import ResultView

    impact, around, document = prepared.impact, prepared.problem.surroundings, postures.document
    return ResultView(
        objective=impact.objective,
        q_initial=postures.initial,
        q_optimal=postures.answer,
        speed=impact.speed,
        restitution=impact.restitution,
        path=postures.path,
        tradeoff=_tradeoff_data(document.get("tradeoff", []), document.get("tradeoff_against", "distance")),
        collisions=_collisions(prepared, postures.initial, postures.answer),
        depths=() if around is None else tuple(around.depth(c) for c in impact.objective.contacts),
        pushed=prepared.problem.requirements.contact_pose == "free",
        motion=motion,
        self_motion=postures.mapped,
    )


def _collisions(prepared: Prepared, *postures: Array) -> Any:
    """Return the colliding shapes at each posture, without shapes that held joints fix to each other.

    The result is empty if the problem has collision constraints, because they prevent all collisions.
    """
    problem = prepared.problem
    if problem.surroundings is not None:
        return (), ()
    from impact_posture.collision.mesh_check import MeshCheck
    from impact_posture.collision.robot_shapes import load_shapes

    robot = prepared.impact.robot
    check = MeshCheck(robot, load_shapes(robot), rigid_groups(robot.model, problem.requirements.hold))
    return tuple(check.collisions(q) for q in postures)


def _tradeoff_data(points: Sequence[dict[str, Any]], against: Against) -> TradeOffData | None:
    """Return the ``tradeoff`` of a ``result.json`` as arrays; ``None`` for fewer than two points."""
    from impact_posture.output.plot import TradeOffData

    if len(points) < 2:
        return None
    keys = ("within", "objective", "H", "G", "V", "S")
    # An undefined S is ``None`` in the JSON file and becomes NaN here.
    columns = {key: np.array([p[key] for p in points], dtype=float) for key in keys}
    knee = next((k for k, p in enumerate(points) if p["knee"]), None)
    certified = np.array([bool(p["certified"]) for p in points])
    return TradeOffData(**columns, certified=certified, knee=knee, against=against)
