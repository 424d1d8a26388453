"""Robot, problems and nonlinear programs of one :class:`Case` of a sweep; each worker process builds them once."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import Any, TypeVar

import numpy as np

from impact_posture.config.setting import Unstated
from impact_posture.dynamics.numeric import Numeric
from impact_posture.impact.impact_contact import point_on
from impact_posture.impact.resolved_impact import resolve
from impact_posture.posture.approach.attainable_speed import AttainableSpeed
from impact_posture.posture.formulation.build_problem import retarget
from impact_posture.posture.formulation.problem_file import Prepared, prepare
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.program.posture_nlp import PostureNLP, build_nlp
from impact_posture.robot.robot_loader import load_robot
from impact_posture.sweep.point_search import Place, Timer, Walk
from impact_posture.sweep.sweep_file import OFFSETS, Case, Grid
from impact_posture.system.arrays import Array

# A worker keeps at least ``_KEPT`` problems and programs in memory, each about 1 MB.  If the speed varies, the worker
# keeps a problem for each speed, but at most ``_MOST_SPEEDS``.  Problems with other normals are removed first,
# because the normal varies slowest.
_KEPT, _MOST_SPEEDS = 4, 64

_Value = TypeVar("_Value")


class CaseSolver:
    """Robot, problems and nonlinear programs of a :class:`Case`, which stay in memory for all its shards.

    Raises:
        ImpactPostureError: A setting of the case is invalid.
    """

    def __init__(self, case: Case, speeds: int = 1) -> None:
        self._case, self.timer = case, Timer()
        self._loaded = load_robot(case.settings.robot, case.settings)
        self._templates = min(max(_KEPT, speeds), _MOST_SPEEDS)
        self.template = lru_cache(self._templates)(self._template)
        self.attainable = lru_cache(self._templates)(self._attainable)
        self._programs: OrderedDict[str, PostureNLP] = OrderedDict()
        self._known: OrderedDict[tuple[Any, ...], Prepared] = OrderedDict()
        self.robot = self.template(*self.normal_and_speed({})).impact.robot

    @property
    def content(self) -> str:
        """Text that changes with the content of any file that the robot or the problem uses."""
        prepared = self.template(*self.normal_and_speed({}))
        around, weights = prepared.problem.surroundings, prepared.impact.objective.metric.weights
        bodies = [] if around is None else [(b.name, b.radius, b.vertices.tolist()) for b in around.shapes.bodies]
        return repr((self.robot.data_sha256, prepared.impact.q.tolist(), weights, bodies))

    def normal_and_speed(self, values: Mapping[str, Any]) -> tuple[Any, float]:
        """Return normal and speed for ``values`` of the grid axes; normal, speed and target determine the problem."""
        settings = self._case.settings
        # A speed in the problem can select the objective and add a constraint on the approach speed.  A speed on a
        # grid axis must neither select the objective nor add this constraint.
        speed = Unstated(values["speed"]) if "speed" in values else settings.speed
        return values.get("normal", settings.normal), speed

    def _template(self, normal: Any, speed: float) -> Prepared:
        """Return the problem for a normal and a speed.  :meth:`target` later replaces the target of this problem."""
        settings = replace(self._case.settings, normal=normal, speed=speed)
        prepared = prepare(settings, resolve(settings, self._loaded))
        # If the problem does not depend on the speed, all speeds use the same problem object and its solutions.
        objective = prepared.impact.objective
        key = objective.structure, tuple(objective.parameters), prepared.problem.requirements
        return replace(kept(self._known, key, lambda: prepared, self._templates), impact=prepared.impact)

    def _attainable(self, normal: Any, speed: float) -> AttainableSpeed:
        prepared = self.template(normal, speed)
        return AttainableSpeed(self.robot, prepared.impact.objective, prepared.problem.requirements)

    def target(self, values: Mapping[str, Any]) -> Place:
        """Return the target position and orientation of the contact frame for ``values`` of the grid axes."""
        position = values.get("target_position", self._case.settings.target_position)
        quaternion = values.get("target_quaternion", self._case.settings.target_quaternion)
        if any(name in values for name in OFFSETS):
            position = self._home if position is None else position
            position = tuple(float(v) + values.get(name, 0.0) for v, name in zip(position, OFFSETS, strict=True))
        return position, quaternion

    @cached_property
    def _home(self) -> Array:
        impact = self.template(*self.normal_and_speed({})).impact
        frame = point_on(self.robot, impact.contact.frame)
        return np.array(Numeric(self.robot.model).at(impact.q).placement(frame).translation)

    def check(self, grid: Grid) -> None:
        """Check that the targets and speeds of the grid are valid for the problem.

        Raises:
            InputError: The problem does not allow a target, a quaternion is not a unit quaternion, or a speed is
                invalid.
        """
        for axis in grid.axes:
            for value in axis.values if axis.name.startswith(("target", "speed")) else axis.values[:1]:
                prepared = self.template(*self.normal_and_speed({axis.name: value}))
                retarget(prepared.problem, *self.target({axis.name: value}))

    def walk(self, template: ConstrainedProblem) -> Walk:
        """Return the :class:`Walk` that solves points of a shard, starting from the problem ``template``.

        A nonlinear program with the same expressions is reused.  Each :class:`Walk` extends its own copy of the
        program, so its rounding errors do not depend on shards that this process solved before.
        """
        key = f"{template.objective.structure}\n{template.structure}"
        built = kept(self._programs, key, lambda: build_nlp(template, compile="never"), _KEPT)
        nlp = replace(built, problem=template, program=built.program.branch())
        return Walk(template, self._case.settings, nlp, self.timer)


def kept(cache: OrderedDict[Any, _Value], key: Any, make: Callable[[], _Value], most: int) -> _Value:
    """Return the value of ``key`` in a cache, and create a missing value with ``make``.

    If the cache has more than ``most`` values, the least recently used value is removed.
    """
    if key not in cache:
        cache[key] = make()
        if len(cache) > most:
            cache.popitem(last=False)
    cache.move_to_end(key)
    return cache[key]
