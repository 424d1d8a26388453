"""Changes that a seed makes in a scenario: start posture, speed or force of the impact, friction, and surface.

Seed 0 changes nothing.  For the same seed, every controller gets the same changes.
"""

from __future__ import annotations

import zlib
from dataclasses import replace

import numpy as np
import pinocchio as pin

from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import Infeasible
from impact_posture.impact.impact_contact import point_on
from impact_posture.impact.worst_case.worst_normal import cone_axes
from impact_posture.posture.constraints.requirements import Requirements
from impact_posture.posture.formulation.build_problem import build_problem
from impact_posture.posture.manifold.feasible_start import Projector
from impact_posture.simulation.scenario_file import RepeatedContacts, Scenario, SinglePush, Spread
from impact_posture.simulation.scenario_objective import scenario_objective
from impact_posture.simulation.setup import Setup, set_up
from impact_posture.simulation.world.world import build_world
from impact_posture.system.arrays import Array

# Least distance of the center of mass of a standing robot from the edges of the support polygon, m.
_COM_MARGIN = 0.02
# Ratio of the random changes of a standing base to the random changes of the joints.
_BASE = 0.2
# ``_DRAWS`` is the number of attempts to draw a start whose feet keep their places.  ``_FEET`` is the largest error
# of the feet, m.
_DRAWS, _FEET = 20, 1e-8


def set_up_with(scenario: Scenario, seed: int) -> Setup:
    """Set up a scenario with the changes of a seed (``[spread]`` in the scenario file).

    Raises:
        ImpactPostureError: The same errors as in :func:`~impact_posture.simulation.setup.set_up`.
        Infeasible: The feet of a standing robot cannot keep their places at any drawn start.
    """
    spread = scenario.spread
    if seed == 0 or spread == Spread():
        return set_up(scenario)
    generator = np.random.default_rng([seed, zlib.crc32(scenario.name.encode())])
    speed, friction = 1 + np.array([spread.speed, spread.friction]) * generator.uniform(-1, 1, 2)
    setup = set_up(_scaled(scenario, float(speed), float(friction)))
    if spread.joints:
        q, changed = _start(setup, spread.joints, generator), setup.scenario
        setup = replace(setup, q=q, world=build_world(setup.robot, changed, q, changed.throw))
    return _displaced(setup, generator) if spread.normal or spread.gap else setup


def _displaced(setup: Setup, generator: np.random.Generator) -> Setup:
    """Return the scenario with a surface that is shifted and tilted relative to the expected surface."""
    scenario, robot, n, spread = setup.scenario, setup.robot, setup.scenario.normal, setup.scenario.spread
    angle, heading, shift = generator.uniform(-1, 1, 3) * [np.deg2rad(spread.normal), np.pi, spread.gap]
    across = cone_axes(n)[:, 1:] @ [np.cos(heading), np.sin(heading)]
    numeric, contacts = Numeric(robot.model).at(setup.q), scenario_objective(setup).contacts
    middle = np.mean([numeric.placement(point_on(robot, c.frame, c.offset)).translation for c in contacts], axis=0)
    nx, ny, nz = (np.cos(angle) * n + np.sin(angle) * across).tolist()
    height = n @ (middle - setup.world.built.points[scenario.surface.name])
    x, y, z = (middle - (height + shift) * n).tolist()
    displaced = replace(scenario.surface, normal=(nx, ny, nz), point=(x, y, z))
    surfaces = tuple(displaced if s == scenario.surface else s for s in scenario.surfaces)
    world = build_world(robot, replace(scenario, surfaces=surfaces), setup.q)
    return replace(setup, world=world, expected_gap=setup.gap)


def _scaled(scenario: Scenario, speed: float, friction: float) -> Scenario:
    surfaces = tuple(replace(s, friction=friction * s.friction) for s in scenario.surfaces)
    scenario, task = replace(scenario, surfaces=surfaces), scenario.task
    if isinstance(task, RepeatedContacts):
        if scenario.falls:
            # The height of a fall increases with the square of the speed.
            surfaces = tuple(replace(s, gap=speed**2 * s.gap) if s.name == task.surface else s for s in surfaces)
            scenario = replace(scenario, surfaces=surfaces)
        return replace(scenario, contacts=replace(task, speed=speed * task.speed))
    if isinstance(task, SinglePush):
        x, y, z = (speed * value for value in task.force)
        return replace(scenario, push=replace(task, force=(x, y, z)))
    return replace(scenario, throw=replace(task, speed=speed * task.speed, friction=friction * task.friction))


def _start(setup: Setup, size: float, generator: np.random.Generator) -> Array:
    """Return a random start posture near ``setup.q`` with the same base (flying robot) or feet (standing robot)."""
    robot, model = setup.robot, setup.robot.model
    for _ in range(_DRAWS):
        step = size * generator.uniform(-1, 1, robot.nv)
        step[robot.held_entries] = 0.0
        step[: robot.first_joint] *= 0.0 if setup.scenario.control.footing is None else _BASE
        q = np.clip(pin.integrate(model, setup.q, step), model.lowerPositionLimit, model.upperPositionLimit)
        if setup.scenario.control.footing is None:
            return robot.check_posture(q, where=setup.scenario.source)
        start = stand(setup, q)
        if start is not None:
            return start
    raise Infeasible({"feet": size}, where=f"{setup.scenario.source}, spread.joints")


def stand(setup: Setup, q: Array) -> Array | None:
    """Return the posture nearest to ``q`` whose feet are at their places; ``None`` if the search fails.

    The center of mass stays above the support polygon.
    """
    robot = setup.robot
    requirements = Requirements(
        contact_pose="free", hold=robot.held, com_over_feet=True, com_margin=_COM_MARGIN, com_asked=False
    )
    problem = build_problem(robot, scenario_objective(setup), setup.q, requirements)
    projected = Projector(problem).project(q)
    return None if projected.violation > _FEET else robot.check_posture(projected.q, where=setup.scenario.source)
