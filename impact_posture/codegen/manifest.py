"""What an export is of: the manifest beside the C, and the reference vectors that prove it."""

from __future__ import annotations

import platform
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture import __version__
from impact_posture.dynamics.chart import Chart
from impact_posture.errors import MetricError
from impact_posture.impact.objective import ImpactObjective
from impact_posture.robot.robot import Robot

Vector = NDArray[np.float64]

SCHEMA = "impact-posture/codegen/1"

# A unit vector along no axis, exact in binary to the last digit that matters: no entry of a gradient is idle.
_NORMAL = (0.48, -0.6, 0.64)


def configuration_names(robot: Robot) -> list[str]:
    """A name with unit for each entry of ``q``, shape (nq,)."""
    parts = {
        "free-flyer": ("x (m)", "y (m)", "z (m)", "qx", "qy", "qz", "qw"),
        "spherical": ("qx", "qy", "qz", "qw"),
        "planar": ("x (m)", "y (m)", "cos", "sin"),
        "continuous": ("cos", "sin"),
        "translation": ("x (m)", "y (m)", "z (m)"),
        "prismatic": ("(m)",),
        "revolute": ("(rad)",),
    }
    return [f"{slot.name} {part}" for slot in Chart(robot.model).slots for part in parts[slot.kind.family]]


def unit_slices(robot: Robot) -> list[slice]:
    """Where ``q`` holds numbers of unit norm: quaternions and cosine-sine pairs."""
    found = []
    for slot in Chart(robot.model).slots:
        width = {"free-flyer": 4, "spherical": 4, "planar": 2, "continuous": 2}.get(slot.kind.family)
        if width:
            found.append(slice(slot.q.stop - width, slot.q.stop))
    return found


def sample_postures(robot: Robot, count: int, seed: int) -> list[Vector]:
    """Random configurations around the default posture, on the manifold, each of shape (nq,)."""
    rng = np.random.default_rng(seed)
    start = robot.posture()
    return [np.asarray(pin.integrate(robot.model, start, rng.uniform(-0.5, 0.5, robot.nv))) for _ in range(count)]


def self_test(objective: ImpactObjective) -> dict[str, Any]:
    """Reference values from CasADi's own evaluation at one posture and normal: ``q, n, H, grad, objective, …``.

    Raises:
        MetricError: The objective does not exist there.
    """
    q = sample_postures(objective.robot, 1, 0)[0]
    H, gradient = objective.metric_fun()(q, ca.DM(_NORMAL))
    value, objective_gradient = objective.gradient_fun()(q, ca.DM(objective.contact.normal))
    numbers = np.concatenate([np.array(v, dtype=float).ravel() for v in (H, gradient, value, objective_gradient)])
    if not np.isfinite(numbers).all():
        raise MetricError(
            f"objective '{objective.name}' is not finite at a random posture of {objective.robot.name}",
            where="codegen",
            mend="choose another objective or frame",
        )
    return {
        "q": q.tolist(),
        "n": list(_NORMAL),
        "H": float(H),
        "grad": np.array(gradient).ravel().tolist(),
        "objective": float(value),
        "objective_grad": np.array(objective_gradient).ravel().tolist(),
    }


def build_manifest(objective: ImpactObjective, prefix: str, posture: Vector | None) -> dict[str, Any]:
    """Everything that a reader needs to tell whether the export fits the robot in hand."""
    robot, contact, metric = objective.robot, objective.contact, objective.metric
    symbols = {name: f"{prefix}_{name}" for name in ("eval", "objective", "value")}
    if posture is not None:
        symbols["posture"] = f"{prefix}_posture"
    return {
        "schema": SCHEMA,
        "prefix": prefix,
        "model_sha256": robot.model_sha256,
        "robot": robot.name,
        "joint_names": list(robot.joint_names),
        "convention": robot.convention,
        "q_names": configuration_names(robot),
        "v_names": list(robot.tangent_names),
        "nq": robot.nq,
        "nv": robot.nv,
        "frame": contact.frame,
        "offset": list(contact.offset),
        "normal": list(contact.normal),
        "normal_frame": contact.normal_frame,
        "impulse_bound": contact.impulse,
        "metric": {
            "name": metric.kind,
            "weights": None if metric.weights is None else list(metric.weights),
        },
        "objective": objective.name,
        "objective_units": objective.units,
        "supports": [{"frame": s.frame, "kind": s.kind, "offset": list(s.offset)} for s in objective.supports],
        "support_compliance": objective.compliance if objective.supports else None,
        "armature": robot.armature.tolist(),
        "posture": None if posture is None else posture.tolist(),
        "symbols": symbols,
        "versions": {
            "impact_posture": __version__,
            "casadi": str(ca.CasadiMeta.version()),
            "pinocchio": str(pin.printVersion()),
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
        "self_test": self_test(objective),
    }
