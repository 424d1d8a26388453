"""A scenario that is ready to run: the loaded robot in its start posture, and the world around it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace

from impact_posture.errors import ImpactPostureError, JointLocked, NameNotFound, SpecError
from impact_posture.impact.impact_contact import point_on
from impact_posture.robot.actuation import allocation
from impact_posture.robot.posture_files import read_posture, set_joints
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import load_robot
from impact_posture.simulation.scenario_file import Scenario, ScenarioTable
from impact_posture.simulation.world.mjcf_contacts import contact_warnings, solid_links
from impact_posture.simulation.world.scene import Shape
from impact_posture.simulation.world.world import World, build_world
from impact_posture.system.arrays import Array
from impact_posture.system.progress import tell

# Keys of a scenario file.
_KEYS = {field.name for field in fields(ScenarioTable)}


@dataclass(frozen=True, eq=False)
class Setup:
    """Scenario that is ready to run.

    Attributes:
        scenario: Content of the scenario file, with shapes for the feet of an MJCF.
        robot: Robot of the scenario.
        q: Start posture, shape (nq,).
        world: Simulated world before its first reset.
        expected_gap: Distance between shape and surface that controllers expect at the start, m; ``None`` if they
            know the true distance.
    """

    scenario: Scenario
    robot: Robot
    q: Array
    world: World
    expected_gap: float | None = None

    @property
    def gap(self) -> float:
        """Expected distance of shape and surface at the start, m; InputError if the scenario has no contacts."""
        if self.expected_gap is not None:
            return self.expected_gap
        return self.world.built.gaps[self.scenario.surface.name, self.scenario.shape.frame]

    @property
    def landed(self) -> Array:
        """Start posture, shape (nq,).  A robot that falls is lowered, so that its feet are on the ground."""
        q = self.q.copy()
        q[:3] -= self.gap * self.scenario.normal if self.scenario.falls else 0.0
        return q

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the scenario that are known before a run."""
        control, lines = self.scenario.control, tuple(contact_warnings(self.world.built.mjcf, self.robot))
        if not self.robot.floating or control.footing is not None or control.tilt is not None:
            return lines
        fault = f"no task keeps the base of {self.robot.name} level, so the robot may tilt until it falls"
        return (*lines, f"{fault}: add [control.tilt] to the scenario")


def set_up(scenario: Scenario) -> Setup:
    """Load the robot, set its start posture, and build the world around it.

    Raises:
        ImpactPostureError: The robot cannot be loaded, or a value of the scenario is invalid for the robot.
    """
    tell(f"loading {scenario.robot}")
    with naming_keys(scenario):
        robot = load_robot(scenario.robot, scenario)
        _check_base(robot, scenario)
        if rigid := [joint for joint in scenario.joints if joint in robot.locked]:
            raise JointLocked(rigid[0], where=scenario.source)
        start = read_posture(robot, scenario.posture, where="posture")
        q = set_joints(robot, start, scenario.joints, scenario.source)
        q = robot.check_posture(q, where=scenario.source)
        robot.frame_id(scenario.task.frame)
        scenario = replace(scenario, shapes=(*scenario.shapes, *_own_feet(scenario, robot)))
        return Setup(scenario, robot, q, build_world(robot, scenario, q, scenario.throw))


def _own_feet(scenario: Scenario, robot: Robot) -> Iterator[Shape]:
    """Yield a shape of kind ``link`` for each foot that has solid geoms in the MJCF and no shape in the scenario."""
    shaped = {point_on(robot, shape.frame).joint for shape in scenario.shapes}
    solid = {int(frame.parentJoint) for *_, frame, _ in solid_links(robot)}
    for support in robot.spec.supports if scenario.control.footing is not None else ():
        joint = point_on(robot, support.frame).joint
        if joint in solid - shaped:
            shaped.add(joint)
            yield Shape(support.frame, kind="link", offset=support.offset)


@contextmanager
def naming_keys(scenario: Scenario) -> Iterator[None]:
    """In errors, replace names of settings by keys of the scenario, and add the path of its file."""
    try:
        yield
    except ImpactPostureError as error:
        where = error.where
        if {where.partition(" ")[0], where.rpartition(" ")[2]} & _KEYS and scenario.source:
            where = f"{scenario.source}, {where}"
        elif where in ("", "problem") or (isinstance(error, NameNotFound) and "." not in where):
            # The scenario names a frame or joint that the robot does not have.  Do not change a ``where`` with a dot,
            # because this ``where`` is a key of robot.toml.
            where = scenario.source
        what, hint = (
            text.replace("`contact_pose`", "control.end_effector.pose").replace("`", "")
            for text in (error.what, error.hint)
        )
        error.reword(what, where, hint)
        raise


def _check_base(robot: Robot, scenario: Scenario) -> None:
    """Raise a SpecError if a floating base has no feet and its rotors do not control all 6 directions."""
    if not robot.floating or scenario.control.footing is not None:
        return
    propulsion = robot.spec.propulsion
    if propulsion is None:
        feet = "add [control.footing] to the scenario" if robot.spec.supports else (
            "add [propulsion] or [[supports]] to its robot.toml, or set root to fixed"
        )  # fmt: skip
        missing = "the scenario has no [control.footing]" if robot.spec.supports else "its data names no feet"
        raise SpecError(f"{robot.name} would fall: it has no rotors and {missing}", where=scenario.source, hint=feet)
    rank = allocation(robot.model, propulsion).rank
    if rank < 6:
        what = f"the rotors of {robot.name} push and turn its base in {rank} of 6 directions"
        hint = "the controllers need all 6: tilt the rotors, or take another robot"
        raise SpecError(what, where=scenario.source, hint=hint)
