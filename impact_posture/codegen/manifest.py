"""What an export is of: the manifest beside the C, and the reference vectors that prove it."""

from __future__ import annotations

import platform
from collections.abc import Iterable, Sequence
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.codegen.emitter import DOUBLE, Real
from impact_posture.codegen.functions import ellipsoid_fun, jump_fun, objective_fun
from impact_posture.codegen.naming import FUNCTIONS
from impact_posture.codegen.reader import SCHEMA
from impact_posture.codegen.variants import variants
from impact_posture.dynamics.chart import Chart
from impact_posture.errors import MetricError
from impact_posture.impact.objective import ImpactObjective
from impact_posture.robot.robot import Robot
from impact_posture.version import __version__

Vector = NDArray[np.float64]

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


def self_test(objective: ImpactObjective, real: Real = DOUBLE) -> dict[str, Any]:
    """Reference values from CasADi's own evaluation at one posture and normal: ``q, n, H, grad, objective, …``.

    Posture and normal are numbers of the export's own type, so that nothing is lost on the way into it.

    Raises:
        MetricError: The objective does not exist there.
    """
    q = real.rounded(sample_postures(objective.robot, 1, 0)[0])
    n = real.rounded(_NORMAL)
    H, gradient = objective.metric_fun()(q, n)
    value, objective_gradient = objective_fun(objective)(q)
    jump, G, _ = jump_fun(objective)(q, n)
    numbers = {
        "H": H,
        "grad": gradient,
        "objective": value,
        "objective_grad": objective_gradient,
        "jump": jump,
        "G": G,
        "V": H / G**2,
        "ellipsoid": ellipsoid_fun(objective)(q),
    }
    found = {key: np.array(v, dtype=float).ravel() for key, v in numbers.items()}
    _refuse_infinite(objective, found.values())
    scalars = ("H", "objective", "G", "V")
    return {
        "q": q.tolist(),
        "n": n.tolist(),
        **{key: float(v[0]) if key in scalars else v.tolist() for key, v in found.items()},
    }


def build_manifest(
    objectives: Sequence[ImpactObjective],
    prefix: str,
    posture: Vector | None,
    real: Real = DOUBLE,
    stack_bytes: int = 0,
) -> dict[str, Any]:
    """Everything that a reader needs to tell whether the export fits the robot in hand.

    What belongs to one frame stands in ``frames``, an entry each; that of the first frame at the top as well.  An
    entry's ``free`` has the symbols and the reference of the robot without its supports; null where it has none.
    ``several`` has those of the objective of several contacts at once.
    """
    first = objectives[0]
    robot, metric = first.robot, first.metric
    frames: list[dict[str, Any]] = []
    joint: dict[str, Any] | None = None
    for variant in variants(objectives, prefix):
        if variant.joint:
            joint = _joint_block(variant.objective, variant.stem, real)
            continue
        block = _frame_block(variant.objective, variant.stem, real)
        if variant.free:
            frames[-1]["free"] = {key: block[key] for key in ("symbols", "self_test")}
        else:
            frames.append(block | {"free": None})
    symbols = frames[0]["symbols"] | {"manifest": f"{prefix}_manifest"}
    if posture is not None:
        symbols |= {"posture": f"{prefix}_posture"}
    if joint is not None:
        symbols |= joint["symbols"]
    return {
        "schema": SCHEMA,
        "prefix": prefix,
        "real": real.name,
        "stack_bytes": stack_bytes,
        "model_sha256": robot.model_sha256,
        "robot": robot.name,
        "joint_names": list(robot.joint_names),
        "convention": robot.convention,
        "q_names": configuration_names(robot),
        "v_names": list(robot.tangent_names),
        "nq": robot.nq,
        "nv": robot.nv,
        "metric": {
            "name": metric.kind,
            "weights": None if metric.weights is None else list(metric.weights),
        },
        "objective": first.name,
        "objective_units": first.units,
        "normal_cone_deg": first.normal_cone_deg,
        "scenarios": [variant.to_dict() for variant in first.model_variants],
        "several": joint,
        "supports": [{"frame": s.frame, "kind": s.kind, "offset": list(s.offset)} for s in first.supports],
        "support_compliance": first.compliance if first.supports else None,
        "armature": robot.armature.tolist(),
        "posture": None if posture is None else posture.tolist(),
        **frames[0],
        "symbols": symbols,
        "frames": frames,
        "versions": {
            "impact_posture": __version__,
            "casadi": str(ca.CasadiMeta.version()),
            "pinocchio": str(pin.printVersion()),
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
    }


def _joint_block(objective: ImpactObjective, stem: str, real: Real) -> dict[str, Any]:
    q = real.rounded(sample_postures(objective.robot, 1, 0)[0])
    value, gradient = (np.array(v, dtype=float).ravel() for v in objective_fun(objective)(q))
    _refuse_infinite(objective, (value, gradient))
    return {
        "contacts": [
            {"frame": c.frame, "normal": list(c.normal), "normal_frame": c.normal_frame, "impulse_bound": c.impulse}
            for c in objective.contacts
        ],
        "bilateral": objective.bilateral,
        "symbols": {"objective": f"{stem}_objective"},
        "self_test": {"q": q.tolist(), "objective": float(value[0]), "objective_grad": gradient.tolist()},
    }


def _refuse_infinite(objective: ImpactObjective, values: Iterable[Vector]) -> None:
    if not all(np.isfinite(v).all() for v in values):
        raise MetricError(
            f"objective '{objective.name}' is not finite at a random posture of {objective.robot.name}",
            where="codegen",
            hint="choose another objective or frame",
        )


def _frame_block(objective: ImpactObjective, stem: str, real: Real) -> dict[str, Any]:
    contact = objective.contact
    return {
        "frame": contact.frame,
        "offset": list(contact.offset),
        "normal": list(contact.normal),
        "normal_frame": contact.normal_frame,
        "impulse_bound": contact.impulse,
        "symbols": {name: f"{stem}_{name}" for name in FUNCTIONS},
        "self_test": self_test(objective, real),
    }
