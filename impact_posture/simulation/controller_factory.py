"""The controllers that are compared: one name, one driver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from impact_posture.errors import ControllerNotFound, InputError
from impact_posture.impact.objective import ImpactObjective
from impact_posture.settings import ObjectiveKind
from impact_posture.simulation.baselines import (
    FlowPosture,
    InvariantDriver,
    StiffDriver,
    StiffPosture,
    WalkerDriver,
)
from impact_posture.simulation.driver import Driver, PostureDriver, RobustDriver
from impact_posture.simulation.offline import OfflinePosture, offline_posture
from impact_posture.simulation.scenario import Setup
from impact_posture.simulation.scenario_objective import Gradient, compiled, scenario_objective
from impact_posture.simulation.task_formulations import base_weight, nominal_posture
from impact_posture.tsid.activation import Activation
from impact_posture.tsid.impact_robust import ImpactRobustPosture

Array = NDArray[np.float64]
ControllerName = Literal[
    "nominal", "robust", "robust-speed", "robust-sticking", "posture", "stiff", "invariant", "walker"
]
Mode = Literal["live", "held"]
CONTROLLERS: tuple[ControllerName, ...] = get_args(ControllerName)
# In words, for tables and help.
MEANING: dict[str, str] = {
    "nominal": "TSID with the start posture",
    "robust": "its posture task with -K grad H, the paper's",
    "robust-speed": "the same with the gradient of V, the jump per approach speed",
    "robust-sticking": "the same with the gradient of S, the jump where the contact sticks",
    "posture": "the offline optimum as posture, no gradient",
    "stiff": "the start posture, as stiff as the term would make it",
    "invariant": "nominal, feedback projected on the impact-invariant subspace around the impact",
    "walker": "the gradient's flow as reference of the posture task",
}
_KINDS: dict[str, ObjectiveKind] = {"robust-speed": "speed", "robust-sticking": "sticking"}


@dataclass(eq=False)
class ControllerFactory:
    """A scenario with what its controllers are made of, each part made when first asked for.

    Attributes:
        setup: The experiment.
        free: Gradients and optimum of the robot without its feet.
        gradient_of: From an objective to its gradient: the C export, or interpreted.
    """

    setup: Setup
    free: bool = False
    gradient_of: Callable[[ImpactObjective], Gradient] = compiled
    _objectives: dict[ObjectiveKind, ImpactObjective] = field(default_factory=dict)
    _gradients: dict[ObjectiveKind, Gradient] = field(default_factory=dict)
    _offline: OfflinePosture | None = None

    def objective(self, kind: ObjectiveKind = "impulse") -> ImpactObjective:
        """The scenario's impact in one of the metric family."""
        if kind not in self._objectives:
            self._objectives[kind] = scenario_objective(self.setup, kind, free=self.free)
        return self._objectives[kind]

    def gradient(self, kind: ObjectiveKind = "impulse") -> Gradient:
        """Its gradient."""
        if kind not in self._gradients:
            self._gradients[kind] = self.gradient_of(self.objective(kind))
        return self._gradients[kind]

    @property
    def offline(self) -> OfflinePosture:
        """The posture of the ``posture`` controller."""
        if self._offline is None:
            self._offline = offline_posture(self.setup, self.objective())
        return self._offline

    def driver(self, name: str, mode: Mode = "live", gain: float | None = None) -> Driver:
        """Make a controller.

        Args:
            name: Which.
            mode: Whether the impact-robust term stays on through the impact, or the reached posture is held.
            gain: K instead of the scenario's, 1/s².

        Raises:
            NameNotFound: No such controller.
            InputError: No such mode; ``held`` for a controller that has nothing to hold.
        """
        if name not in CONTROLLERS:
            raise ControllerNotFound(name, CONTROLLERS, hint=f"one of: {', '.join(CONTROLLERS)}")
        if mode not in get_args(Mode):
            raise InputError(
                f"there is no mode '{mode}'", where="--mode", hint=f"one of: {', '.join(get_args(Mode))}"
            )
        if mode == "held" and not (name.startswith("robust") or name == "walker"):
            raise InputError(f"'{name}' has no term to hold", where="--mode", hint="only robust… and walker have one")
        setup, robot, gains = self.setup, self.setup.robot, self.setup.scenario.control.posture
        term = setup.scenario.control.robust
        K = term.gain if gain is None else gain
        if name == "posture":
            return PostureDriver(setup, nominal_posture(setup), self.offline.q)
        if name == "nominal":
            return Driver(setup, nominal_posture(setup))
        if name == "invariant":
            return InvariantDriver(setup, nominal_posture(setup))
        gradient = self.gradient(_KINDS.get(name, "impulse"))
        base = base_weight(setup)
        if name == "stiff":
            return StiffDriver(setup, StiffPosture(robot, gradient, K, gains.kp, base, gains.weight))
        robust = ImpactRobustPosture(
            robot,
            gradient,
            K=K,
            kp=gains.kp,
            # The same damping as every other controller's.
            kd=2 * np.sqrt(gains.kp) if gains.kd is None else gains.kd,
            weight=gains.weight,
            base_weight=base,
            fade=term.fade,
            activation=Activation(ramp=term.ramp, live=mode == "live"),
        )
        if name == "walker":
            return WalkerDriver(setup, FlowPosture(robot, robust, base, gains.weight))
        return RobustDriver(setup, robust)
