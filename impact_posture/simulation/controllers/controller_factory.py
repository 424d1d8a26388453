"""Names of the controllers, and the factory that builds their drivers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import metadata
from typing import Literal, get_args

import numpy as np

from impact_posture.config.problem_settings import ObjectiveKind
from impact_posture.controller_export.controller_structure import structure_of
from impact_posture.errors import ControllerNotFound, ImpactPostureError, InputError
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.path.posture_path import PosturePath, check_package, fall_path, posture_path
from impact_posture.posture.formulation.build_problem import build_problem
from impact_posture.posture.program.compiled_solver import CompileMode
from impact_posture.simulation.controllers.baselines import (
    FlowPosture,
    ReleaseDriver,
    WalkerDriver,
    resting_posture,
    spring_of_term,
)
from impact_posture.simulation.controllers.compiled_tick import CompiledTick, compiled_tick
from impact_posture.simulation.controllers.driver import Driver, FlowDriver, PathDriver, PostureDriver, RobustDriver
from impact_posture.simulation.controllers.impact_baselines import (
    ImpactAwareDriver,
    InvariantDriver,
    ReferenceSpreadingDriver,
)
from impact_posture.simulation.controllers.strike_driver import LandingDriver, StrikeDriver
from impact_posture.simulation.controllers.task_formulations import nominal_posture, posture_options
from impact_posture.simulation.offline_posture import (
    OFFLINE_STARTS,
    OfflinePosture,
    offline_posture,
    scenario_requirements,
)
from impact_posture.simulation.scenario_objective import Gradient, compiled, interpreted, scenario_objective
from impact_posture.simulation.setup import Setup
from impact_posture.system.arrays import Array
from impact_posture.system.progress import tell
from impact_posture.system.toolchain import find_compiler
from impact_posture.tsid.flow.reference_flow_posture import ReferenceFlowPosture
from impact_posture.tsid.tasks.activation import Activation
from impact_posture.tsid.tasks.impact_robust import ImpactRobustPosture
from impact_posture.tsid.tasks.joint_posture import JointPosture

Mode = Literal["live", "held"]
# Controller name → description in tables and help.
MEANING: dict[str, str] = {
    "nominal": "TSID with the start posture",
    "robust": "nominal, with the impact-robust term -K grad H of the paper",
    "robust-speed": "like robust, with the gradient of V (jump per approach speed)",
    "robust-sticking": "like robust, with the gradient of S (jump if the contact sticks)",
    "robust-release": "like robust, without the nominal posture stiffness until H stops decreasing",
    "robust-flow": "the posture flows to lower H before the impact, without a gain",
    "robust-flow-sticking": "like robust-flow, but lowers S instead of H, for impacts at a given speed",
    "posture": "moves to the offline optimum, without the gradient",
    "posture-sticking": "like posture, with the optimum of S, for impacts at a given speed",
    "path": "like posture, but along a timed path without collisions",
    "strike": "arrives at the optimum of the sticking jump with the stated speed along a path, then stops",
    "stiff": "holds the start posture, as stiff as the impact-robust term is where robust comes to rest",
    "posture-stiff": "like posture, with the stiffness of the impact-robust term at the optimum",
    "invariant": "nominal, but impulses do not affect the velocity feedback around the impact",
    "reference-spreading": "nominal, with references before and after the impact, no velocity feedback in between",
    "impact-aware": "nominal, with an approach so slow that an impact keeps joint rates and torques within limits",
    "walker": "the posture target follows the negative gradient of H",
}
CONTROLLERS = tuple(MEANING)
# Suffix of a name that adds the stiffness of the impact-robust term at the posture where the controller rests.
_STIFF = "-stiff"
_PLAIN = {
    "nominal": Driver,
    "invariant": InvariantDriver,
    "reference-spreading": ReferenceSpreadingDriver,
    "impact-aware": ImpactAwareDriver,
}
# Driver classes that can use a controller in C.
_IN_C = (Driver, RobustDriver, FlowDriver, PostureDriver, PathDriver, StrikeDriver)
_KINDS: dict[str, ObjectiveKind] = {
    "robust-speed": "speed",
    "robust-sticking": "sticking",
    "robust-flow-sticking": "sticking",
    "posture-sticking": "sticking",
    "strike": "sticking",
}
# Controllers that move to an offline posture.
_OFFLINE = ("posture", "posture-sticking", "path", "strike")
# Controllers of a robot that falls.
_FALLING = ("strike", "posture", "nominal")
# Entry points by which other installed packages add controllers.
GROUP = "impact_posture.controllers"


def check_gain(name: str, gain: float | None) -> None:
    """Raise an InputError if a gain is given for a controller of this package that has no gain."""
    has = name.startswith(("robust", "walker", "stiff")) and not name.startswith("robust-flow")
    if gain is not None and name in CONTROLLERS and not (has or name.endswith(_STIFF)):
        hint = "robust, its variants, walker and stiff have a gain"
        raise InputError(f"'{name}' has no gain", where="gain", hint=hint)


@dataclass(eq=False)
class ControllerFactory:
    """Factory of the controllers of a scenario.  Parts that several controllers need are built once, at first use.

    Attributes:
        setup: Scenario that is ready to run.
        free: If true, gradients and the offline optimum ignore the contacts at the feet.
        gradient_of: Function that builds the gradient of an objective, compiled or interpreted.
        offline_of: Function that computes the offline posture, with the same arguments and result as
            :func:`~impact_posture.simulation.offline_posture.offline_posture`.
        compile: When controllers run as machine code: ``always``, ``never``, or ``auto`` for controllers that can be
            compiled.
        starts: Number of starts of the optimizer for offline postures.
        in_c: True if the last built driver runs as machine code.
        warnings: Parts of the last built driver that could not be compiled, with reasons.
    """

    setup: Setup
    free: bool = False
    gradient_of: Callable[[WorstCaseObjective], Gradient] = compiled
    offline_of: Callable[..., OfflinePosture] = offline_posture
    compile: CompileMode = "never"
    starts: int = OFFLINE_STARTS
    in_c: bool = False
    warnings: list[str] = field(default_factory=list)
    _fault: str = ""
    _objectives: dict[ObjectiveKind, WorstCaseObjective] = field(default_factory=dict)
    _gradients: dict[ObjectiveKind, tuple[Gradient, tuple[str, ...]]] = field(default_factory=dict)
    _offline: dict[tuple[ObjectiveKind, bool, bool], OfflinePosture] = field(default_factory=dict)

    def objective(self, kind: ObjectiveKind = "impulse") -> WorstCaseObjective:
        """Return the objective of type ``kind`` (``impulse``, ``speed``, …) for the impact of the scenario."""
        if kind not in self._objectives:
            self._objectives[kind] = scenario_objective(self.setup, kind, free=self.free)
        return self._objectives[kind]

    def gradient(self, kind: ObjectiveKind = "impulse") -> Gradient:
        """Return the gradient of :meth:`objective`, compiled or, with a warning, interpreted if compiling fails."""
        if kind not in self._gradients:
            try:
                self._gradients[kind] = self.gradient_of(self.objective(kind)), ()
            except InputError as error:
                # If the error comes from the objective and not from compiling, the next statement raises it again.
                warning = f"the gradient is interpreted, not compiled, which is slower: {error.line}"
                self._gradients[kind] = interpreted(self.objective(kind)), (warning,)
        gradient, warnings = self._gradients[kind]
        self.warnings += [warning for warning in warnings if warning not in self.warnings]
        return gradient

    @cached_property
    def metric(self) -> Callable[[Array], float]:
        """Function ``q → H``, evaluated by the CasADi interpreter, which does not compile the function."""
        tell("building the expressions")
        function, normal = self.objective().value_fun(), np.array(self.objective().contact.normal, dtype=float)
        return lambda q: float(function(q, normal))

    def offline(self, name: str = "posture") -> OfflinePosture | None:
        """Return the offline posture of a controller; ``None`` if the controller uses no offline posture."""
        name = name.removesuffix(_STIFF)
        return self._optimum(name) if name in _OFFLINE else None

    def _optimum(self, name: str) -> OfflinePosture:
        # With the controller ``path``, the end effector must stay at its start, so the optimal posture differs from
        # the optimal posture of ``posture``.  The plan of a strike assumes that the feet stay in place.
        kind, strikes = _KINDS.get(name, "impulse"), name == "strike" and self.setup.scenario.contacts is not None
        key = kind, name != "path", strikes
        if key not in self._offline:
            self._offline[key] = self.offline_of(
                self.setup, self.objective(kind), starts=self.starts, at_contact=key[1], strikes=strikes
            )
        return self._offline[key]

    @cached_property
    def path(self) -> PosturePath:
        """Path that the controller ``path`` follows."""
        check_package()
        solution = self._optimum("path").solution
        tell("looking for a path to the offline posture")
        return posture_path(solution)

    @cached_property
    def strike(self) -> PosturePath:
        """Path of the controller ``strike`` from the start posture to the contact at the stated speed.

        Raises:
            InputError: The scenario has no contacts, or no strike is possible.
        """
        check_package()
        setup, scenario = self.setup, self.setup.scenario
        solution = replace(self._optimum("strike").solution, initial=setup.q)
        tell("looking for a path that strikes")
        speed, restitution = 0.0, 0.0
        if scenario.contacts is not None:
            speed = scenario.contacts.speed
            restitution = scenario.surface.restitution(speed, scenario.physics.timestep)
        path = posture_path(solution, strike=speed, restitution=restitution)
        if path.strike is None:
            raise InputError(f"cannot strike: {path.reason}", where="strike", hint="change the start posture")
        return path

    @cached_property
    def landing(self) -> PosturePath:
        """Path of the controller ``nominal`` in a fall: it lands in the start posture, without a planned stop."""
        setup, objective = self.setup, self.objective()
        demands = scenario_requirements(setup, objective)
        speed = 0.0 if setup.scenario.contacts is None else setup.scenario.contacts.speed
        return fall_path(build_problem(setup.robot, objective, setup.landed, demands), setup.landed, speed)

    def path_of(self, name: str) -> PosturePath | None:
        """Return the path that a controller follows; ``None`` for a controller without a path."""
        name = name.removesuffix(_STIFF)
        if name == "strike" and self.setup.scenario.contacts is not None:
            return self.strike
        if self.setup.scenario.falls and name in _FALLING:
            return self.landing if name == "nominal" else _without_stop(self.strike)
        return self.path if name == "path" else None

    def driver(self, name: str, mode: Mode = "live", gain: float | None = None) -> Driver:
        """Build the driver of a controller.

        Other installed packages can add controllers by entry points of the group :data:`GROUP`.  An entry point is a
        function that gets this factory, the mode and the gain, and returns the driver.  The arguments are the same as
        in :func:`impact_posture.simulation.run.run`.

        Raises:
            ControllerNotFound: The controller is unknown.
            InputError: The mode is unknown, the mode is ``held`` and the controller has no impact-robust term, or the
                code of another package fails.
        """
        self.warnings.clear()
        self.in_c = False
        modes = get_args(Mode)
        if mode not in modes:
            raise InputError(f"there is no mode '{mode}'", where="mode", hint=f"one of: {', '.join(modes)}")
        if self.compile not in (choices := get_args(CompileMode)):
            raise InputError(f"no mode '{self.compile}'", where="compile", hint=f"choose from {', '.join(choices)}")
        if name.removesuffix(_STIFF) not in CONTROLLERS:
            return self._driver_from_outside(name, mode, gain)
        if mode == "held" and not (name.startswith("robust") or name == "walker"):
            raise InputError(f"'{name}' has no mode held", where="mode", hint="use robust, its variants, or walker")
        driver = self._build(name, mode, gain)
        driver.compiled = self._compiled(driver, name)
        self.in_c = driver.compiled is not None
        return driver

    def _build(self, name: str, mode: Mode, gain: float | None) -> Driver:
        setup, robot = self.setup, self.setup.robot
        if setup.scenario.falls:
            path = self.path_of(name) if name in _FALLING else None
            if path is None:
                hint = f"choose from {', '.join(_FALLING)}"
                raise InputError(f"'{name}' cannot control a fall", where=setup.scenario.source, hint=hint)
            return LandingDriver(setup, nominal_posture(setup), path)
        if name == "stiff":
            return self._stiffened("nominal", "robust", gain)
        if name.endswith(_STIFF):
            return self._stiffened(name.removesuffix(_STIFF), name.removesuffix(_STIFF), gain)
        if (path := self.path_of(name)) is not None:
            follower = PathDriver if path.strike is None else StrikeDriver
            return follower(setup, nominal_posture(setup), path)
        if name in _OFFLINE:
            return PostureDriver(setup, nominal_posture(setup), self._optimum(name).q)
        if name in _PLAIN:
            return _PLAIN[name](setup, nominal_posture(setup))
        term, gradient = setup.scenario.control.robust, self.gradient(_KINDS.get(name, "impulse"))
        K, options = term.gain if gain is None else gain, posture_options(setup)
        if name.startswith("robust-flow"):
            return FlowDriver(setup, ReferenceFlowPosture(robot, gradient, **options))
        if name == "robust-release":
            options |= {"activation": Activation(ramp=term.ramp, live=False), "spring": "release"}
            posture = ImpactRobustPosture(robot, gradient, K=K, fade=term.fade, **options)
            return ReleaseDriver(setup, posture, gradient, self._optimum(name).q)
        activation = Activation(ramp=term.ramp, live=mode == "live")
        driver, task = (WalkerDriver, FlowPosture) if name == "walker" else (RobustDriver, ImpactRobustPosture)
        return driver(setup, task(robot, gradient, K=K, fade=term.fade, activation=activation, **options))

    def _compiled(self, driver: Driver, name: str) -> CompiledTick | None:
        """Return the compiled controller of a driver, or ``None`` if the controller must run in Python.

        Only the driver classes in :data:`_IN_C` can use compiled code.  Other drivers read the state of the Python
        controller.
        """
        always, controller = self.compile == "always", driver.controller
        if not always and (self.compile == "never" or self._fault or find_compiler() is None):
            return None
        try:
            if type(driver) not in _IN_C:
                raise InputError(f"'{name}' has no C code", where="compile", hint="give auto or never")
            structure = structure_of(controller.robot, controller.formulation)
        except InputError:
            if always:
                raise
            return None
        plain = type(controller.formulation.posture) is JointPosture
        objective = None if plain else self.objective(_KINDS.get(name.removesuffix(_STIFF), "impulse"))
        try:
            return compiled_tick(controller, structure, objective)
        except InputError as error:
            if always:
                raise
            # Remember that the build or the download failed, so that the next runs do not try again.
            self._fault = f"the controller runs in Python, not in C, which is slower: {error.line}"
            self.warnings.append(self._fault)
            return None

    def _stiffened(self, name: str, at: str, gain: float | None) -> Driver:
        """Build controller ``name`` with the stiffness of the impact-robust term where controller ``at`` rests."""
        robust = self.driver("robust", gain=gain)
        assert isinstance(robust, RobustDriver)  # noqa: S101 (the name says it)
        seconds = self.setup.scenario.task.settle
        reached = resting_posture(robust, seconds)
        if at != "robust":
            reached = resting_posture(self.driver(at), seconds)
        driver, strength = self._build(name, "live", None), robust.posture.K / robust.posture.scale
        driver.posture.stiffen(spring_of_term(self.setup.robot, self.gradient(), reached, strength))
        return driver

    def _driver_from_outside(self, name: str, mode: Mode, gain: float | None) -> Driver:
        added = metadata.entry_points(group=GROUP)
        if name not in added.names:
            known = (*CONTROLLERS, *sorted(added.names))
            raise ControllerNotFound(name, known, hint=f"one of: {', '.join(known)}")
        with self.errors_named(name):
            driver = added[name].load()(self, mode, gain)
        if not isinstance(driver, Driver):
            where, what = _from_outside(name), f"returns an object of type {type(driver).__name__}"
            raise InputError(what, where=where, hint="return a Driver")
        return driver

    @contextmanager
    def errors_named(self, name: str) -> Iterator[None]:
        """Convert exceptions into errors that name controller ``name``, if it belongs to another package.

        Raises:
            InputError: The code of the other package raised an exception, or returned an object of the wrong type.
        """
        try:
            yield
        except (Exception, SystemExit, GeneratorExit) as error:
            if name.removesuffix(_STIFF) in CONTROLLERS or isinstance(error, MemoryError):
                raise
            if isinstance(error, ImpactPostureError):
                # The simulated world refuses the command of the controller.
                if error.where != "command":
                    raise
                raise InputError(error.what, where=f"{_from_outside(name)}, command", hint=error.hint) from error
            what = f"fails: {type(error).__name__}: {error}"
            hint = "correct or uninstall the package that adds it"
            raise InputError(what, where=_from_outside(name), hint=hint) from error


def _without_stop(path: PosturePath) -> PosturePath:
    return replace(path, strike=path.strike and replace(path.strike, follow_through=None))


def _from_outside(name: str) -> str:
    """Return text that names a controller of another package and its entry point."""
    return f"controller '{name}' ({metadata.entry_points(group=GROUP)[name].value})"
