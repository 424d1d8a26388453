"""The impact-robust term as a task of pink (https://github.com/stephane-caron/pink).

    pip install pin-pink
    python pink_impact.py

``ImpactTask`` asks for the velocity ``v = −K ∇f(q)`` and is part of the cost of the QP in pink.  ``f`` is the
objective of the compiled C export, here H.  The tasks that the robot must keep are equality constraints in pink, so
that H decreases only in their null space.  For each contact below, pink runs from the default posture until the robot
rests.  Then the posture is compared with the optima that ``impact-posture optimize`` computes offline under the same
constraints.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pink
import pinocchio as pin
from pink.tasks import FrameTask, Task

from impact_posture.codegen.export import export
from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.config.problem_settings import ProblemSettings
from impact_posture.config.table_validation import validate
from impact_posture.posture.formulation.problem_file import Prepared, prepare
from impact_posture.posture.search.multistart import PostureSolution, solve

DT, DURATION, AT_REST = 0.01, 60.0, 1e-6  # time step, s; longest run, s; norm of v at rest


class ImpactTask(Task):
    """Task ``Δq = −K ∇f(q) Δt``, with the error ``K ∇f Δt`` and the identity as Jacobian, both on the tangent space.

    ``f`` is the objective of an export, such as H or the effective mass.  The size of ``f`` depends on the robot.
    So the argument ``speed``, the norm of v at the first tick, determines K.
    """

    def __init__(self, gradient: ImpactGradient, speed: float, q: np.ndarray) -> None:
        super().__init__(cost=1.0)
        self.gradient, self.K = gradient, speed / np.linalg.norm(gradient.objective(q)[1])

    def compute_error(self, configuration: pink.Configuration) -> np.ndarray:
        return self.K * DT * self.gradient.objective(configuration.q)[1]

    def compute_jacobian(self, configuration: pink.Configuration) -> np.ndarray:
        return configuration.tangent.eye

    def __repr__(self) -> str:
        return f"ImpactTask(K={self.K:.3g})"


class PointTask(Task):
    """Keep the position of a frame and leave its orientation free.  The FrameTask of pink has all six rows."""

    def __init__(self, frame: str, configuration: pink.Configuration) -> None:
        super().__init__(cost=1.0)
        self.frame, self.target = frame, configuration.get_transform_frame_to_world(frame).translation

    def compute_error(self, configuration: pink.Configuration) -> np.ndarray:
        return configuration.get_transform_frame_to_world(self.frame).translation - self.target

    def compute_jacobian(self, configuration: pink.Configuration) -> np.ndarray:
        rotation = configuration.get_transform_frame_to_world(self.frame).rotation
        return rotation @ configuration.get_frame_jacobian(self.frame)[:3]

    def __repr__(self) -> str:
        return f"PointTask({self.frame})"


class LevelTask(Task):
    """Keep the z axis of the base vertical and the yaw free: ``e = (Rᵀ e_z)_xy``, with the rate ``−ω × Rᵀ e_z``."""

    def __init__(self, frame: str) -> None:
        super().__init__(cost=1.0)
        self.frame = frame

    def compute_error(self, configuration: pink.Configuration) -> np.ndarray:
        return configuration.get_transform_frame_to_world(self.frame).rotation[2, :2]

    def compute_jacobian(self, configuration: pink.Configuration) -> np.ndarray:
        up = configuration.get_transform_frame_to_world(self.frame).rotation[2]
        return (pin.skew(up) @ configuration.get_frame_jacobian(self.frame)[3:])[:2]

    def __repr__(self) -> str:
        return f"LevelTask({self.frame})"


def pose_and_level(frame: str, configuration: pink.Configuration) -> list[Task]:
    """Return the tasks that the aerial manipulator must keep."""
    pose = FrameTask(frame, position_cost=1.0, orientation_cost=1.0)
    pose.set_target_from_configuration(configuration)
    return [pose, LevelTask("base_link")]


def point(frame: str, configuration: pink.Configuration) -> list[Task]:
    """Return the task that an arm with a ball tip must keep."""
    return [PointTask(frame, configuration)]


@dataclass(frozen=True)
class Contact:
    """Contact as options of ``optimize``, and the tasks that pink must keep."""

    name: str
    settings: dict[str, object]
    held: Callable[[str, pink.Configuration], list[Task]]


CONTACTS = (
    Contact(
        "tilthex_arm on a floor", {"robot": "tilthex_arm", "frame": "ee", "normal": (0, 0, 1)}, pose_and_level
    ),
    Contact(
        "tilthex_arm against a wall",
        {"robot": "tilthex_arm", "frame": "ee", "normal": (-1, 0, 0), "posture": "brace_forward"},
        pose_and_level,
    ),
    Contact(
        "ur5, ball tip on a table", {"robot": "ur5", "normal": (0, 0, 1), "contact_pose": "position"}, point
    ),
)  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """Posture in which the robot rests under pink, and the offline optimization of the same problem."""

    contact: Contact
    prepared: Prepared
    offline: PostureSolution  # optima of the solution are sorted, the best first
    q: np.ndarray
    H: np.ndarray  # H at the start and after each tick
    errors: np.ndarray  # norm of the errors of the kept tasks, after each tick
    speed: float  # norm of v at the last tick

    def distances(self) -> list[float]:
        """Return the tangent norm from the resting posture to each optimum of ``optimize``."""
        model = self.prepared.impact.robot.model
        return [float(np.linalg.norm(pin.difference(model, self.q, o.q))) for o in self.offline.optima]


def follow(contact: Contact, speed: float = 5.0) -> Outcome:
    """Run pink from the start posture until the robot rests."""
    # This use of pink includes neither collisions nor loads, so the offline problem leaves them out, too.
    settings = {"collision": False, "holdable": False, **contact.settings}
    prepared = prepare(validate(ProblemSettings, settings, "options"))
    impact, offline = prepared.impact, solve(prepared.problem)
    frame = impact.contact.frame
    with tempfile.TemporaryDirectory() as folder:
        export(impact.objective, Path(folder), prefix="impact", check=False)
        gradient = ImpactGradient.load(folder, robot=impact.robot)

    model = limited(prepared)
    configuration = pink.Configuration(model, model.createData(), offline.initial)
    held = contact.held(frame, configuration)
    task = ImpactTask(gradient, speed, configuration.q)
    H, errors = [gradient.objective(configuration.q)[0]], []
    for _ in range(round(DURATION / DT)):
        v = pink.solve_ik(configuration, [task], DT, solver="daqp", constraints=held)
        configuration.integrate_inplace(v, DT)
        H.append(gradient.objective(configuration.q)[0])
        errors.append(np.linalg.norm(np.concatenate([t.compute_error(configuration) for t in held])))
        if np.linalg.norm(v) < AT_REST:
            break
    return Outcome(contact, prepared, offline, configuration.q, np.array(H), np.array(errors), np.linalg.norm(v))


def limited(prepared: Prepared) -> pin.Model:
    """Return the model with the limit margin of ``optimize`` subtracted, because pink reads limits from the model."""
    model = prepared.impact.robot.model.copy()
    joints = slice(7 if prepared.impact.robot.floating else 0, None)
    lower, upper = model.lowerPositionLimit.copy(), model.upperPositionLimit.copy()
    lower[joints] += prepared.problem.requirements.limit_margin
    upper[joints] -= prepared.problem.requirements.limit_margin
    model.lowerPositionLimit, model.upperPositionLimit = lower, upper
    return model


def report(outcome: Outcome) -> None:
    """Print the results of a run."""
    objective, H = outcome.prepared.impact.objective, outcome.H
    print(outcome.contact.name)
    print(f"  H {H[0]:.6g} → {H[-1]:.6g} ({100 * (H[-1] / H[0] - 1):+.1f} %) in {(len(H) - 1) * DT:.1f} s")
    before, after = (objective.oracle.quantities(q) for q in (outcome.offline.initial, outcome.q))
    print("  beside it", ", ".join(f"{k} {getattr(before, k):.4g} → {getattr(after, k):.4g}" for k in "GVS"))
    print(f"  error of the kept tasks: {outcome.errors.max():.1e} at most, {outcome.errors[-1]:.1e} at the end")
    if outcome.speed >= AT_REST:
        print(f"  still moving: |v| = {outcome.speed:.1e}")
    distances, optima = outcome.distances(), outcome.offline.optima
    nearest = int(np.argmin(distances))
    print(f"  offline optima: {len(optima)}")
    for k, words in {nearest: "nearest", 0: "best"}.items():
        print(f"  the {words} of them: H {optima[k].objective:.6g}, posture {distances[k]:.1e} away")


def main() -> list[Outcome]:
    """Run pink with the impact-robust task for all contacts."""
    outcomes = []
    for contact in CONTACTS:
        outcomes.append(follow(contact))
        report(outcomes[-1])
    return outcomes


if __name__ == "__main__":
    main()
