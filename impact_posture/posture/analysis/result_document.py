"""Convert the result of an optimization to the content of ``result.json`` and ``result.npz``."""

from __future__ import annotations

import platform
from dataclasses import replace
from functools import cache
from importlib import metadata
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.posture.analysis.posture_warnings import posture_warnings
from impact_posture.posture.analysis.robustness import Robustness
from impact_posture.posture.analysis.trade_off import TradeOff
from impact_posture.posture.analysis.verdict import verdict
from impact_posture.posture.analysis.verdict_conditions import Circumstances
from impact_posture.posture.approach.attainable_speed import AttainableSpeed
from impact_posture.posture.formulation.problem_file import Prepared
from impact_posture.posture.loads.load_cases import load_cases
from impact_posture.posture.manifold.null_space_path import NullSpacePath
from impact_posture.posture.search.global_search import GlobalSearch, SelfMotionMap
from impact_posture.posture.search.multistart import PostureSolution
from impact_posture.version import __version__

SCHEMA = "impact-posture/result/1"

# Attributes of a solution in the block ``solver``.
_SOLVER = (
    "status", "iterations", "solve_time_s", "build_time_s", "compiled",
    "starts", "feasible_starts", "certified_starts", "colliding_starts", "dominated_starts",
)  # fmt: skip


def result_document(
    prepared: Prepared,
    solution: PostureSolution,
    robustness: Robustness | None = None,
    tradeoff: TradeOff | None = None,
    path: dict[str, object] | None = None,
    global_search: GlobalSearch | None = None,
) -> dict[str, object]:
    """Return the content of ``result.json``; each of the last four arguments adds a block if it is not ``None``."""
    impact, around = prepared.impact, prepared.problem.surroundings
    postures = {"initial": solution.initial, "optimal": solution.q}
    no_path = ""
    if path is not None and not path["found"]:
        postures["reachable"], no_path = np.array(path["q"]), str(path["reason"])
    evaluations = {name: impact.evaluate(q) for name, q in postures.items()}
    loads = load_cases(impact.objective, solution.initial, prepared.problem.requirements)
    holding = {name: loads.holding(q) for name, q in postures.items()}
    without_run_up = replace(prepared.problem.requirements, strike=False)
    approach = AttainableSpeed(impact.robot, impact.objective, without_run_up)
    attainable = {name: approach.reached(q) for name, q in postures.items()}
    blocks = {
        name: {
            **evaluation.to_dict(),
            "holding": None if (held := holding[name]) is None else held.to_dict(),
            "attainable_speed": attainable[name],
        }
        for name, evaluation in evaluations.items()
    }
    # The posture in posture.json, for which the verdict is computed.
    answer = list(postures)[-1]
    struck = path is not None and "strike" in path
    fastest = path["strike"]["speed"] if struck else attainable[answer]  # type: ignore[index]
    kept = solution.problem.requirements.surface_spread
    spread = None if kept == prepared.problem.requirements.surface_spread else kept
    known = Circumstances(fastest, solution.moved, no_path, struck, spread)
    fault = [solution.compiler_fault] if solution.compiler_fault else []
    at_posture = posture_warnings(prepared, solution.initial, postures[answer], holding[answer], answer)
    told = (warning for evaluation in evaluations.values() for warning in evaluation.warnings)
    warnings = (*prepared.warnings, *told, *fault, *at_posture)
    curve = {} if tradeoff is None else {"tradeoff": tradeoff.to_list(), "tradeoff_against": tradeoff.against}
    return {
        "schema": SCHEMA,
        "verdict": verdict(impact, evaluations["initial"], evaluations[answer], known).to_dict(),
        **impact.to_dict(solution.initial),
        "constraints": solution.problem.describe(),
        **blocks,
        "initial": {"given_q": prepared.problem.given.tolist(), "moved": solution.moved, **blocks["initial"]},
        "reduction": solution.reduction,
        **({} if robustness is None else {"robustness": robustness.to_dict()}),
        "redundancy": solution.redundancy,
        "certificate": solution.certificate.to_dict(),
        **({"collision": around.to_dict(solution.initial, solution.q)} if around and around.constraints else {}),
        "active": [active.to_dict() for active in solution.certificate.active],
        "solver": {
            **{key: getattr(solution, key) for key in _SOLVER},
            "seed": prepared.settings.seed,
            "optima": [optimum.to_dict() for optimum in solution.optima],
        },
        "search": solution.estimate.to_dict(),
        **({} if global_search is None else {"global": global_search.to_dict()}),
        **curve,
        **({} if path is None else {"path": path}),
        "notes": [*filter(None, [impact.choice]), *solution.notes, *(tradeoff.notes if tradeoff else ())],
        "warnings": list(dict.fromkeys(warnings)),
        "versions": versions(),
    }


def versions() -> dict[str, str]:
    """Return the versions of all software that a result depends on."""
    software = {"impact-posture": __version__, "python": platform.python_version()}
    software |= {"casadi": ca.CasadiMeta.version(), "pinocchio": pin.__version__, "numpy": np.__version__}
    data = _version_of("example-robot-data")
    return software | ({} if data is None else {"example-robot-data": data})


@cache
def _version_of(package: str) -> str | None:
    """Return the version of an installed package; the result is cached, because finding it takes milliseconds."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def result_arrays(
    solution: PostureSolution,
    path: NullSpacePath,
    tradeoff: TradeOff | None = None,
    mapped: SelfMotionMap | None = None,
) -> dict[str, NDArray[Any]]:
    """Return the content of ``result.npz``: postures, ellipsoids, jumps, path, trade-off and self-motion map."""
    oracle = solution.problem.impact.oracle
    arrays: dict[str, NDArray[Any]] = {}
    for name, q in (("initial", solution.initial), ("optimal", solution.q)):
        quantities = oracle.quantities(q)
        arrays |= {
            f"{name}_q": q,
            f"{name}_jump": quantities.jump,
            f"{name}_ellipsoid": quantities.ellipsoid,
            f"{name}_mobility": quantities.mobility,
            f"{name}_gradient": oracle.gradient_H(q),
        }
    arrays |= {f"path_{key}": getattr(path, key) for key in ("q", "s", "H", "G", "V", "S", "objective")}
    if mapped is not None:
        arrays |= {f"self_motion_{key}": value for key, value in vars(mapped).items()}
    return arrays if tradeoff is None else arrays | tradeoff.arrays()
