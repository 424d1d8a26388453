"""Impact-robust posture optimization for kinematically redundant robots.

The velocity jump of a rigid impact is ``Δν = M⁻¹(q) Jᵀ n λ``.  This package computes the jump, and
optimizes the posture so that the jump is small under the constraints of a task::

    import impact_posture as ip

    robot = ip.load_robot("tilthex_arm")
    objective = ip.ImpactObjective(robot, ip.ImpactContact("ee", normal=(0, 0, 1)))
    result = ip.optimize(ip.PostureProblem(objective, base="level"))
    result.save("out")

Each name is imported at its first use.  Therefore the online controller ``ip.tsid`` never loads CasADi.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from impact_posture.version import __version__

if TYPE_CHECKING:
    from impact_posture import sweep as sweep
    from impact_posture import tsid as tsid
    from impact_posture.api.impact_objective import ImpactObjective as ImpactObjective
    from impact_posture.api.posture_problem import PostureProblem as PostureProblem
    from impact_posture.api.posture_result import PostureResult as PostureResult
    from impact_posture.api.posture_result import optimize as optimize
    from impact_posture.codegen.export import Export as Export
    from impact_posture.codegen.impact_gradient import ImpactGradient as ImpactGradient
    from impact_posture.controller_export.compiled_controller import CompiledController as CompiledController
    from impact_posture.controller_export.export_controller import export_controller as export_controller
    from impact_posture.errors import ImpactPostureError as ImpactPostureError
    from impact_posture.frameworks import gpu as gpu
    from impact_posture.frameworks import jax_metric as jax  # noqa: F401
    from impact_posture.frameworks import torch_metric as torch  # noqa: F401
    from impact_posture.impact.impact_contact import ImpactContact as ImpactContact
    from impact_posture.impact.metric import Metric as Metric
    from impact_posture.robot.robot import Robot as Robot
    from impact_posture.robot.robot_loader import known_robots as known_robots
    from impact_posture.robot.robot_loader import load_robot as load_robot
    from impact_posture.robot.robot_spec import Support as Support


# Public name of a module → its path in the package.
_MODULES = {
    "gpu": "frameworks.gpu",
    "jax": "frameworks.jax_metric",
    "sweep": "sweep",
    "torch": "frameworks.torch_metric",
    "tsid": "tsid",
}
_HOMES = {
    "CompiledController": "controller_export.compiled_controller",
    "Export": "codegen.export",
    "ImpactContact": "impact.impact_contact",
    "ImpactGradient": "codegen.impact_gradient",
    "ImpactObjective": "api.impact_objective",
    "ImpactPostureError": "errors",
    "Metric": "impact.metric",
    "PostureProblem": "api.posture_problem",
    "PostureResult": "api.posture_result",
    "Robot": "robot.robot",
    "Support": "robot.robot_spec",
    "export_controller": "controller_export.export_controller",
    "known_robots": "robot.robot_loader",
    "load_robot": "robot.robot_loader",
    "optimize": "api.posture_result",
}

# ``from impact_posture import *`` does not hide the packages ``torch`` and ``jax``.
__all__ = ["__version__", *_HOMES, *sorted({*_MODULES} - {"jax", "torch"})]


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return import_module(f"impact_posture.{_MODULES[name]}")
    if name not in _HOMES:
        raise AttributeError(f"module 'impact_posture' has no attribute '{name}'")
    return getattr(import_module(f"impact_posture.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*__all__, *_MODULES})
