"""``result.json``: the answer as a document, and as arrays."""

from __future__ import annotations

import platform
from importlib import metadata

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture import __version__
from impact_posture.impact.evaluation import Evaluation, evaluate
from impact_posture.posture.path import NullSpacePath
from impact_posture.posture.settings import Prepared
from impact_posture.posture.solve import PostureSolution
from impact_posture.robot.actuation import hover

SCHEMA = "impact-posture/result/1"

# A joint further than this behind the contact's plane, meters, is worth a word.
_BEHIND = 0.01


def evaluations(prepared: Prepared, solution: PostureSolution) -> tuple[Evaluation, Evaluation]:
    """The impact at the initial (feasible) and at the optimal posture."""
    impact = prepared.impact
    initial = evaluate(impact.objective, solution.initial, impact.speed, impact.restitution)
    return initial, evaluate(impact.objective, solution.q, impact.speed, impact.restitution)


def result_document(prepared: Prepared, solution: PostureSolution) -> dict[str, object]:
    """The content of ``result.json``."""
    initial, optimal = evaluations(prepared, solution)
    impact = prepared.impact
    asked = impact.to_dict()
    contacts = [{**contact, "normal": [float(v) for v in initial.worst_normal]} for contact in asked["contacts"]]  # type: ignore[attr-defined]
    warnings = (*impact.warnings, *initial.warnings, *optimal.warnings, *_hover_warnings(prepared, solution))
    warnings += tuple(_surface_warnings(prepared, solution, initial, optimal))
    return {
        "schema": SCHEMA,
        **asked,
        "contacts": contacts,
        "constraints": prepared.problem.describe(),
        "initial": {
            "given_q": [float(v) for v in prepared.problem.given],
            "moved": solution.moved,
            **initial.to_dict(),
        },
        "optimal": optimal.to_dict(),
        "reduction": solution.reduction,
        "redundancy": solution.redundancy,
        "certificate": solution.certificate.to_dict(),
        "active": [
            {"constraint": a.constraint, "side": a.side, "multiplier": a.multiplier}
            for a in solution.certificate.active
        ],
        "solver": {
            "status": solution.status,
            "iterations": solution.iterations,
            "solve_time_s": solution.solve_time_s,
            "build_time_s": solution.build_time_s,
            "compiled": solution.compiled,
            "seed": prepared.settings.seed,
            "starts": solution.starts,
            "feasible_starts": solution.feasible_starts,
            "certified_starts": solution.certified_starts,
            "optima": [
                {"q": [float(v) for v in o.q], "objective": o.objective, "hits": o.hits} for o in solution.optima
            ],
        },
        "notes": list(solution.notes),
        "warnings": list(dict.fromkeys(warnings)),
        "versions": versions(),
    }


def _hover_warnings(prepared: Prepared, solution: PostureSolution) -> list[str]:
    """What keeps an aerial robot from hovering in the optimal posture."""
    robot = prepared.impact.robot
    if robot.spec.propulsion is None or not robot.floating:
        return []
    violations = hover(robot.model, robot.spec.propulsion, solution.q).violations
    return [f"the robot cannot hover in the optimal posture: {violation}" for violation in violations]


def _surface_warnings(
    prepared: Prepared, solution: PostureSolution, initial: Evaluation, optimal: Evaluation
) -> list[str]:
    """Links whose origin lies behind the contact's plane: nothing keeps the robot on its side of the surface.

    A push (a contact pose that is free) has no surface.
    """
    if prepared.problem.requirements.contact_pose == "free":
        return []
    behind = [
        _links_behind(prepared, q, evaluation)
        for q, evaluation in ((solution.initial, initial), (solution.q, optimal))
    ]
    lines = []
    if behind[0]:
        lines.append(
            f"the initial posture has {_named(behind[0])} behind the surface: the normal points out of it, "
            "towards the robot; check its sign"
        )
    new = [name for name in behind[1] if name not in behind[0]]
    if new:
        lines.append(
            f"the optimal posture brings {_named(new)} behind the plane of the surface: it is not kept out of it; "
            "bound the base or the joints if the surface reaches that far"
        )
    return lines


def _links_behind(prepared: Prepared, q: NDArray[np.float64], evaluation: Evaluation) -> list[str]:
    objective = prepared.impact.objective
    oracle = objective.oracle.at(q)
    contact = oracle.numeric.placement(oracle.point).translation
    model = prepared.impact.robot.model
    names = ["the base" if model.names[i] == "root_joint" else str(model.names[i]) for i in range(1, model.njoints)]
    origins = [oracle.numeric.data.oMi[i].translation for i in range(1, model.njoints)]
    # The link that touches reaches to the surface itself.
    return [
        name
        for i, (name, origin) in enumerate(zip(names, origins, strict=True), 1)
        if i != oracle.point.joint and evaluation.worst_normal @ (origin - contact) < -_BEHIND
    ]


def _named(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more joints" if len(names) > 3 else "")


def versions() -> dict[str, str]:
    """Versions of everything that a result depends on."""
    found = {"impact-posture": __version__, "python": platform.python_version()}
    found |= {"casadi": ca.CasadiMeta.version(), "pinocchio": pin.__version__, "numpy": np.__version__}
    try:
        found["example-robot-data"] = metadata.version("example-robot-data")
    except metadata.PackageNotFoundError:
        pass
    return found


def result_arrays(solution: PostureSolution, path: NullSpacePath) -> dict[str, NDArray[np.float64]]:
    """The content of ``result.npz``: postures, ellipsoids, jumps and the null-space path."""
    oracle = solution.problem.objective.oracle
    arrays: dict[str, NDArray[np.float64]] = {}
    for name, q in (("initial", solution.initial), ("optimal", solution.q)):
        found = oracle.quantities(q)
        arrays |= {
            f"{name}_q": q,
            f"{name}_jump": found.jump,
            f"{name}_ellipsoid": found.ellipsoid,
            f"{name}_mobility": found.mobility,
            f"{name}_gradient": oracle.gradient_H(q),
        }
    arrays |= {f"path_{key}": getattr(path, key) for key in ("q", "s", "H", "G", "V", "S", "objective")}
    return arrays
