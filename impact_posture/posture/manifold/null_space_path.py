"""The path from the initial posture to the optimum along the constraints."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pinocchio as pin

from impact_posture.posture.manifold.feasible_start import Projector
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.system.arrays import Array


@dataclass(frozen=True)
class NullSpacePath:
    """Postures ``q`` of a path along the constraints, shape (N, nq), and the impact quantities at each posture.

    ``s`` is the path length in the tangent norm, shape (N,).  The arrays of the objective, H, G, V and S have the
    shape (N,).  Undefined values of S are NaN.
    """

    q: Array
    s: Array
    H: Array
    G: Array
    V: Array
    S: Array
    objective: Array


def null_space_path(problem: ConstrainedProblem, start: Array, end: Array, points: int = 61) -> NullSpacePath:
    """Interpolate from ``start`` to ``end`` and project every point onto the constraints."""
    projector, model = Projector(problem), problem.robot.model
    postures = [start]
    for t in np.linspace(0, 1, points)[1:-1]:
        postures.append(projector.project(pin.interpolate(model, start, end, float(t))).q)
    postures.append(end)
    steps = [np.linalg.norm(pin.difference(model, a, b)) for a, b in pairwise(postures)]
    quantities = [problem.impact.oracle.quantities(q) for q in postures]
    H, G, V, S = np.array([(v.H, v.G, v.V, np.nan if v.S is None else v.S) for v in quantities]).T
    objective = np.array([problem.objective.value(q) for q in postures])
    return NullSpacePath(np.array(postures), np.concatenate([[0.0], np.cumsum(steps)]), H, G, V, S, objective)
