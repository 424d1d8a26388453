"""The metric ``‖Δν‖²_W`` of a velocity jump."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np

from impact_posture.config.checked import checked
from impact_posture.config.demand import Positive
from impact_posture.config.problem_settings import MetricKind
from impact_posture.config.table_validation import read_toml
from impact_posture.errors import MetricError
from impact_posture.impact.impact_contact import LARGEST
from impact_posture.robot.model_joints import v_slice
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array


@checked
@dataclass(frozen=True)
class Metric:
    """Weight matrix ``W`` in the squared norm ``‖Δν‖²_W = ΔνᵀWΔν`` of a velocity jump.

    Attributes:
        kind: ``euclidean`` (W = I), ``kinetic`` (W = M) or ``weighted`` (``W`` diagonal).
        weights: Diagonal of ``W`` for a ``weighted`` metric, shape (nv,); ``None`` otherwise.
        source: Text that states where the weights come from.

    Raises:
        InputError: ``kind`` is unknown, or a weight is not above zero.
        MetricError: A ``weighted`` metric has no weights, or another metric has weights.
    """

    kind: MetricKind = "euclidean"
    weights: tuple[Positive, ...] | None = None
    source: str = ""

    def __post_init__(self) -> None:
        if (self.kind == "weighted") != (self.weights is not None):
            what = "needs weights" if self.weights is None else "takes no weights"
            raise MetricError(f"the {self.kind} metric {what}", where="metric", hint="see build_metric")
        if self.weights is not None:
            # The dataclass can be compared and hashed only if the weights are a tuple, not an array.
            object.__setattr__(self, "weights", tuple(float(weight) for weight in self.weights))

    def diagonal(self, nv: int) -> Array:
        """Return the diagonal of ``W``, shape (nv,).  The metric must not be ``kinetic``."""
        return np.ones(nv) if self.weights is None else np.array(self.weights)


def build_metric(robot: Robot, kind: MetricKind, weights: str | tuple[float, ...] | None = None) -> Metric:
    """Build a ``euclidean``, ``kinetic`` or ``weighted`` metric.

    The weighted metric needs ``weights``: nv numbers, the text ``velocity-limits``, or the path of a TOML file.  The
    file has lines ``joint = weight``, and ``base = [6 numbers]`` for a floating base.

    Raises:
        MetricError: Weights are missing, wrong in number, not between 1e-100 and 1e100, or given for another metric.
    """
    if kind != "weighted":
        if weights is not None and kind in get_args(MetricKind):
            what, hint = f"are given, but the metric is {kind}", "remove them or add `metric` weighted"
            raise MetricError(what, where="weights", hint=hint)
        return Metric(kind)
    if weights is None:
        hint = "add `weights` FILE or `weights` velocity-limits"
        raise MetricError("the weighted metric needs weights", where="metric", hint=hint)
    source = weights if isinstance(weights, str) else "numbers"
    if not isinstance(weights, str):
        check_weights(robot, weights)
        values = np.array(weights, dtype=float)
    elif weights == "velocity-limits":
        values = _from_limits(robot)
    else:
        values = _from_file(robot, Path(weights))
    for name, value in zip(robot.tangent_names, values, strict=True):
        if not 1 / LARGEST <= value <= LARGEST:
            what = f"the weight of '{name}' is {value:g}"
            hint = f"every weight must be above zero: {1 / LARGEST:g} to {LARGEST:g}"
            raise MetricError(what, where=source, hint=hint)
    return Metric("weighted", tuple(float(v) for v in values), source)


def check_weights(robot: Robot, weights: Sequence[float] | None) -> None:
    """Raise ``MetricError`` if ``weights`` does not have nv entries."""
    if weights is not None and np.shape(weights) != (robot.nv,):
        hint = f"give {robot.nv} numbers above zero"
        raise MetricError(f"has {np.size(weights)} entries", where="weights", hint=hint)


def _from_limits(robot: Robot) -> Array:
    limits = robot.velocity_limits
    base = robot.first_joint
    # A floating base has no velocity limits.  1 m/s and 1 rad/s are used to include the base velocity in the norm.
    limits[:base] = 1.0
    for name, limit in zip(robot.tangent_names[base:], limits[base:], strict=True):
        if not limit < 1e6:
            hint = "add the limit to robot.toml [limits.velocity], or give a file with weights"
            raise MetricError(f"joint '{name}' has no velocity limit", where="weights", hint=hint)
    return np.asarray(1.0 / limits**2)


def _from_file(robot: Robot, path: Path) -> Array:
    table = read_toml(path)
    values = np.ones(robot.nv)
    base = robot.first_joint
    for key, value in table.items():
        try:
            if key == "base" and base:
                values[:6] = np.array(value, dtype=float)
            else:
                values[v_slice(robot.model, robot.joint_id(key))] = float(value)  # type: ignore[arg-type]
        except (TypeError, ValueError, OverflowError):
            hint = "write joint = weight, or base = [6 numbers]"
            raise MetricError(f"the value of key '{key}' is not a number", where=str(path), hint=hint) from None
    return values
