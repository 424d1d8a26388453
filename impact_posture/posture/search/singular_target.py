"""Detect held poses at which the robot is singular, for example with a stretched arm, and offer a bent start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import pinocchio as pin

from impact_posture.dynamics.numeric import Numeric
from impact_posture.posture.constraints.constraint import Constraint
from impact_posture.posture.program.constrained_problem import ConstrainedProblem, held_rows
from impact_posture.robot.model_joints import scalar_value
from impact_posture.system.arrays import Array
from impact_posture.system.escape import toml

# A direction is lost if the joints move the constrained frame along it by less than this fraction of the largest
# motion.
_LOST = 1e-3
# A direction is nearly lost if the motion along it is below this fraction of the largest motion.
_CLEAR = 5e-3
# Angle by which joints are bent, rad.
_BEND = 0.5
# Largest number of bent joints.
_MOST_BENT = 4
# Number of random postures without singularity.
_SAMPLES = 8


@dataclass(frozen=True)
class SingularTarget:
    """A constraint whose Jacobian has a lower rank at all given postures than at random postures.

    Attributes:
        rank: Largest rank of the Jacobian of the constraint at the given postures.
        full_rank: Rank of the Jacobian of the constraint at random postures.
        bent: Joint positions at which the rank is ``full_rank``, rad; empty if the user stated the target.
    """

    name: str
    rank: int
    full_rank: int
    bent: dict[str, float]

    @property
    def fact(self) -> str:
        """Description of the singularity."""
        return (
            f"{self.name} is held where the robot is singular (its Jacobian has the rank {self.rank} instead of "
            f"{self.full_rank}, as for a stretched arm), so hardly any other posture is left"
        )

    @property
    def hint(self) -> str:
        """What the user can do."""
        if not self.bent:
            return "move the target to where the robot need not stretch"
        return f"start from a bent `posture`, such as [postures.bent] joints = {toml(self.bent)} in robot.toml"


def singular_target(problem: ConstrainedProblem, postures: Sequence[Array]) -> SingularTarget | None:
    """Return the first pose constraint that is singular at all ``postures``, shape (nq,) each, or ``None``."""
    model, random = problem.robot.model, np.random.default_rng(0)
    others = [pin.integrate(model, problem.given, random.uniform(-1, 1, model.nv)) for _ in range(_SAMPLES)]
    for constraint in (c for c in problem.constraints if c.equality):
        gains = _Gains(problem, constraint)
        rank, full = (max(int((gains(q) > _LOST).sum()) for q in some) for some in (postures, others))
        if rank < full:
            stated = problem.requirements.target_position is not None
            return SingularTarget(constraint.name, rank, full, {} if stated else _bent(problem, gains, full))
    return None


class _Gains:
    """Singular values of the Jacobian of a constraint, without held joints, divided by the largest singular value."""

    def __init__(self, problem: ConstrainedProblem, constraint: Constraint) -> None:
        self._numeric, self._constraint = Numeric(problem.robot.model), constraint
        self._moving = held_rows(problem.robot, problem.requirements.hold).sum(axis=0) == 0

    def __call__(self, q: Array) -> Array:
        jacobian = self._constraint.evaluate(self._numeric.at(q))[1] * self._moving
        values = np.linalg.svd(jacobian, compute_uv=False)
        return np.asarray(values / max(values[0], 1e-300))


def _bent(problem: ConstrainedProblem, gains: _Gains, rank: int) -> dict[str, float]:
    """Return positions of as few joints as possible, such that the bent posture is clearly not singular."""
    robot, bent, best = problem.robot, dict[str, float](), problem.given
    model, steps = robot.model, np.eye(robot.nv)
    # Only joints with a single velocity entry are bent.
    turning = {*robot.joint_names} & {*robot.tangent_names} - {*problem.requirements.hold}
    while len(bent) < _MOST_BENT and gains(best)[rank - 1] < _CLEAR:
        trials = []
        for name, angle in product(turning - bent.keys(), (_BEND, -_BEND)):
            q = pin.integrate(model, best, angle * steps[robot.tangent_names.index(name)])
            if (q >= model.lowerPositionLimit).all() and (q <= model.upperPositionLimit).all():
                trials.append((float(np.log(gains(q)[:rank] + 1e-9).sum()), name, angle, q))
        if not trials:
            break
        _, name, _, best = max(trials, key=lambda trial: trial[:3])
        bent[name] = round(scalar_value(model, robot.joint_id(name), best), 3)
    return bent
