"""Result views that several tests of the figures draw."""

from __future__ import annotations

from itertools import pairwise

import matplotlib
import matplotlib.image
import numpy as np
import pinocchio as pin
from matplotlib.figure import Figure

from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.metric import Metric
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.output.plot import ResultView, TradeOffData
from impact_posture.path.path_timing import LimitUse
from impact_posture.path.posture_path import PosturePath
from impact_posture.posture.manifold.null_space_path import NullSpacePath
from impact_posture.posture.search.global_search import SelfMotionMap
from impact_posture.robot.robot_loader import load_robot

PENDULUM = "example-robot-data:double_pendulum_description/urdf/double_pendulum.urdf"


def sample_path(objective: WorstCaseObjective, postures: list[np.ndarray]) -> NullSpacePath:
    model = objective.robot.model
    steps = [np.linalg.norm(pin.difference(model, q, p)) for q, p in pairwise(postures)]
    impacts = [objective.oracle.quantities(q) for q in postures]
    # Undefined values of S become NaN.
    curves = {name: np.array([getattr(f, name) for f in impacts], dtype=float) for name in "HGVS"}
    values = np.array([objective.value(q) for q in postures])
    return NullSpacePath(np.array(postures), np.concatenate([[0.0], np.cumsum(steps)]), **curves, objective=values)


def make_view(
    name: str,
    normal: tuple[float, float, float],
    frame: str | None = None,
    *,
    q0: np.ndarray | None = None,
    scale: float = 0.2,
    path: bool = True,
    **keys: object,
) -> ResultView:
    robot = load_robot(name)
    supports = robot.spec.supports
    frame = frame or robot.spec.contact.frame or robot.frame_names[-1]
    normal_frame = keys.pop("normal_frame", "world")
    contact = ImpactContact(frame, normal, normal_frame=normal_frame)  # type: ignore[arg-type]
    objective = WorstCaseObjective(robot, contact, keys.pop("metric", Metric()), supports=supports)  # type: ignore[arg-type]
    q0 = robot.posture() if q0 is None else q0
    v = scale * np.random.default_rng(3).normal(size=robot.nv)
    if robot.floating:
        v[:6] *= 0.2
    postures = [pin.integrate(robot.model, q0, v * t) for t in np.linspace(0, 1, 12)]
    return ResultView(
        objective,
        q0,
        postures[-1],
        path=sample_path(objective, postures) if path else None,
        tradeoff=trade_of(objective, postures) if path else None,
        motion=motion_of(objective, postures, v) if path else None,
        self_motion=map_of(objective, postures) if path else None,
        **keys,  # type: ignore[arg-type]
    )


def map_of(objective: WorstCaseObjective, postures: list[np.ndarray]) -> SelfMotionMap:
    """Return a map with two components: the path, and the reversed path, whose end is infeasible."""
    path = sample_path(objective, postures)
    count = len(postures)
    return SelfMotionMap(
        q=np.concatenate([path.q, path.q[::-1]]),
        component=np.repeat([0, 1], count),
        s=np.tile(path.s, 2),
        objective=np.concatenate([path.objective, path.objective[::-1]]),
        feasible=np.arange(2 * count) < 2 * count - 4,
        start=np.array([0]),
        optimum=np.array([count - 1]),
        ends=np.array([count - 1, count + 2]),
    )


def trade_of(objective: WorstCaseObjective, postures: list[np.ndarray], knee: int | None = None) -> TradeOffData:
    """Return a synthetic trade-off curve, not necessarily decreasing; its second last point is not certified."""
    path = sample_path(objective, postures)
    certified = np.arange(len(postures)) != len(postures) - 2
    return TradeOffData(path.s, path.objective, path.H, path.G, path.V, path.S, certified, knee)


def motion_of(objective: WorstCaseObjective, postures: list[np.ndarray], v: np.ndarray) -> PosturePath:
    """Return a motion with constant velocity in 1 s and unknown thrusts."""
    t = np.linspace(0, 1, len(postures))
    use = LimitUse(t, np.full(t.size, 0.4), 0.5 + 0.3 * t, np.full(t.size, np.nan), {"active": None})
    values = np.array([objective.value(q) for q in postures])
    return PosturePath(
        objective.robot.model, t, np.array(postures), np.tile(v, (t.size, 1)), np.zeros((t.size, v.size)),
        False, "a reason", "continuation", "scaled", values[-1], float(np.linalg.norm(v)), 0.0, use, values,
    )  # fmt: skip


def spin(seed: int = 0) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q


def text_of(figure: Figure) -> str:
    """Return all texts of a figure, with line breaks replaced by spaces."""
    return " | ".join(" ".join(t.get_text().split()) for t in figure.findobj(matplotlib.text.Text))
