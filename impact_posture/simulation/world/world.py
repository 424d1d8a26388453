"""Robot in MuJoCo under rotor and motor commands, with sensor readings and the true state."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from impact_posture.errors import InputError, SimulationDiverged
from impact_posture.impact.impact_contact import point_on
from impact_posture.robot.actuation import hover
from impact_posture.robot.robot import Robot
from impact_posture.simulation.world.actuator_command import (
    RUNAWAY,
    ActivePushes,
    ActuatorCommand,
    CommandLimits,
    JointStops,
    Push,
    Trace,
    Truth,
)
from impact_posture.simulation.world.contact_forces import ContactLog, ShapeTruth
from impact_posture.simulation.world.rotors import Rotors, Vibration
from impact_posture.simulation.world.scene import Scene
from impact_posture.simulation.world.sensor_noise import NO_FORCE, ForceFilter, Reading, Sample, SensorNoise
from impact_posture.simulation.world.throw import Ball, Throw
from impact_posture.simulation.world.world_builder import BuiltScene, build_scene
from impact_posture.system.arrays import Array
from impact_posture.system.optional_package import import_mujoco, unwarned
from impact_posture.tsid.controller import Command
from impact_posture.tsid.state import checked_velocity

_NOTHING = np.zeros(0)


class World:
    """Simulated robot in its surroundings, which :func:`build_world` builds.

    Call :meth:`reset` first.  All coordinates are in the convention of Pinocchio.

    Attributes:
        built: MuJoCo model and positions of the surfaces.
        timestep: Time step of the physics, s.
        limits: Limits of rotor speeds and joint torques.
        stops: Position limits of the joints.
    """

    def __init__(self, robot: Robot, scene: Scene, built: BuiltScene) -> None:
        self._mujoco = import_mujoco()
        self.robot, self.scene, self.built = robot, scene, built
        self.timestep = scene.physics.timestep
        self._layout = built.mjcf.layout
        self._model = built.mjcf.compile()
        self._data = self._mujoco.MjData(self._model)
        frames, sensors, propulsion = tuple(s.frame for s in scene.shapes), scene.sensors, robot.spec.propulsion
        self.ball = None if built.throw is None else Ball(self._model, built.throw)
        self._frames, self._log = frames, ContactLog(self._model, built.shape_geoms)
        self._noise = SensorNoise(robot, sensors)
        self._rotors = None if propulsion is None else Rotors(propulsion, self.timestep)
        self._vibration = None
        if propulsion is not None and sensors.unbalance:
            self._vibration = Vibration(robot.model, propulsion, sensors.unbalance)
        self._count = 0 if propulsion is None else len(propulsion.rotors)
        self.limits = CommandLimits(robot, self._rotors)
        self._torques: Array = np.zeros(self.limits.effort.size)
        self._felt = None if sensors.force_frame is None else frames.index(sensors.force_frame)
        self._filter = ForceFilter(sensors.force_cutoff * self.timestep)
        self._marks: list[tuple[float, Sample, Array, Array]] = []
        self._past: deque[Sample] = deque(maxlen=1 + round(sensors.delay / self.timestep))
        self._pushes = ActivePushes(self._model)
        self._steps = 0
        self.stops = JointStops(self._model)

    def reset(
        self, q: ArrayLike, v: ArrayLike | None = None, seed: int = 0, *, rotor_speed: ArrayLike | None = None
    ) -> None:
        """Reset the simulation to a state at time zero.

        Args:
            q: Configuration, shape (nq,).
            v: Generalized velocity ν, shape (nv,).  Zero by default.
            seed: Seed of all noise.
            rotor_speed: Speeds of the propellers, shape (rotors,).  By default, the speeds that make the robot hover
                at ``q``.

        Raises:
            PostureError: The configuration or the velocity has a wrong size or is not finite.
            InputError: The rotor speeds have a wrong size or are not finite.
        """
        q = self.robot.check_posture(np.asarray(q, dtype=float), limits=False, where="reset")
        v = checked_velocity(self.robot, np.zeros(self.robot.nv) if v is None else v)
        self._mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[: self._layout.nqpos] = self._layout.qpos(q)
        self._data.qvel[: self._layout.nv] = self._layout.qvel(q, v)
        generator = np.random.default_rng(seed)
        if self._rotors is not None and (propulsion := self.robot.spec.propulsion) is not None:
            self._rotors.reset(hover(self.robot.model, propulsion, q).speeds if rotor_speed is None else rotor_speed)
        if self._vibration is not None:
            self._vibration.reset(q, generator.uniform(0, 2 * np.pi, self._count))
        self._noise.reset(generator)
        self._log.reset()
        self._marks.clear()
        self._filter.force = NO_FORCE
        self._torques = np.zeros(self.limits.effort.size)
        self._pushes.active.clear()
        self._steps = 0
        self._mujoco.mj_step1(self._model, self._data)
        self._past.clear()
        speeds = _NOTHING if self._rotors is None else self._rotors.speeds
        self._past.append(self._sample(speeds, _NOTHING if self._vibration is None else self._vibration.phases))

    @property
    def speed(self) -> float:
        """``‖ν‖``."""
        rates = self._past[-1].qvel
        return math.sqrt(rates.dot(rates))

    @property
    def time(self) -> float:
        """Time since the reset, s."""
        return self._steps * self.timestep

    def push(self, push: Push) -> None:
        """Begin a push now.  Several pushes add up.

        Raises:
            FrameNotFound: The robot has no such frame.
            InputError: The force is not finite, the duration is not finite, or the duration is shorter than a time
                step.
        """
        point = point_on(self.robot, push.frame, push.offset)
        body = int(self._model.body(self.built.mjcf.bodies[point.joint]).id)
        self._pushes.begin(push, body, point.position, self._steps)

    def throw(self, sign: int = 1) -> None:
        """Throw the ball now, along its direction (sign 1) or against its direction (sign −1).

        Raises:
            InputError: The scenario has no ball.
        """
        if self.ball is None:
            raise InputError("has no ball", where="world", hint="use a scenario with [throw]")
        self.ball.throw(self._data, sign)
        self._mujoco.mj_step1(self._model, self._data)

    def step(self, command: Command | ActuatorCommand, count: int = 1) -> None:
        """Take ``count`` physics steps with a constant command, which is clipped to the limits.

        Raises:
            InputError: :meth:`reset` was not called, or the command has a wrong size or is not finite.
            SimulationDiverged: The state diverged.
        """
        self._check_ready()
        speed, self._torques = self.limits.within(command)
        self._data.ctrl[self._count :] = self._torques
        if not count:
            return
        with unwarned():
            self._advance(speed, count)
        state = self._data.qpos, self._data.qvel
        # If the sum of squares is below ``RUNAWAY²``, every number is below ``RUNAWAY``.  Only a larger sum requires
        # a check of each number.
        usual = state[0].dot(state[0]) + state[1].dot(state[1]) < RUNAWAY**2
        if not usual and not all(np.abs(part).max() < RUNAWAY for part in state):
            raise SimulationDiverged(self.time, where=self.robot.name)

    def _advance(self, command: Array, count: int) -> None:
        """Take ``count`` physics steps; ``command`` contains rotor speeds that are within the limits."""
        model, data, first, second = self._model, self._data, self._mujoco.mj_step1, self._mujoco.mj_step2
        rotors, vibration, speeds, phases = self._rotors, self._vibration, np.zeros((count, 0)), np.zeros((count, 0))
        if rotors is not None:
            # The speeds of the propellers do not depend on the robot, so compute them for all steps at once.
            speeds = rotors.steps(command, count)
            thrusts = rotors.thrusts(speeds)
            phases = phases if vibration is None else vibration.steps(speeds, self.timestep)
        control, log, delayed = data.ctrl[: self._count], self._log, self._past.maxlen != 1
        log.fold(self._steps)
        for k in range(count):
            if rotors is not None:
                control[:] = thrusts[k]
            if self._pushes.active:
                self._pushes.apply(data, self._steps)
            second(model, data)
            self._steps += 1
            if data.ncon:
                log.step(data, self._steps)
            if self._felt is not None:
                self._filter.feel(log.force(self._felt) if data.ncon else NO_FORCE)
            # After this call, MuJoCo stores positions, velocities and contacts of the new state, but the contact
            # forces of the last step.
            first(model, data)
            if delayed or k == count - 1:
                self._past.append(self._sample(speeds[k], phases[k]))

    def _sample(self, speeds: Array, phases: Array) -> Sample:
        data, layout = self._data, self._layout
        qpos, qvel = data.qpos[: layout.nqpos].copy(), data.qvel[: layout.nv].copy()
        return Sample(layout, qpos, qvel, speeds, phases, self._filter.force)

    def read(self) -> Reading:
        """Return the present sensor readings.  Every call draws new noise."""
        self._check_ready()
        sample = self._past[0]
        q, v = sample.state
        if self._vibration is not None:
            v = v.copy()
            v[:6] += self._vibration.twist(sample.speeds, sample.phases)
        return self._noise.read(self.time, q, v, None if self._felt is None else np.array(sample.force))

    def mark(self) -> None:
        """Record the present state, so that the next :meth:`trace` returns it."""
        self._check_ready()
        speeds = _NOTHING if self._rotors is None else self._rotors.speeds
        self._marks.append((self.time, self._past[-1], self._torques, speeds))
        self._log.mark(self._data, self._steps)

    def trace(self) -> Trace:
        """Return the true states recorded by :meth:`mark`, and clear the records.

        Raises:
            InputError: :meth:`mark` was not called since the last trace.
        """
        if not self._marks:
            raise InputError("has no marks", where="world", hint="call mark() first")
        times, samples, torques, speeds = zip(*self._marks, strict=True)
        self._marks = []
        q, v = zip(*(sample.state for sample in samples), strict=True)
        stopped = self.stops.reached(np.array([sample.qpos for sample in samples]))
        parts = [np.array(column) for column in (times, q, v, speeds, torques)]
        return Trace._make([*parts, stopped, *self._log.look()])

    def truth(self) -> Truth:
        """Return the true state, and clear recorded states, peak forces and times of first touches."""
        self.mark()
        t, q, v, speeds, torques, stopped, *contacts = (column[-1] for column in self.trace())
        shapes = tuple(
            ShapeTruth(frame, bool(on), force, impulse, float(peak), None if np.isnan(began) else float(began), slip)
            for frame, on, force, impulse, peak, began, slip in zip(self._frames, *contacts, strict=True)
        )
        thrusts = speeds if self._rotors is None else self._rotors.thrusts(speeds)
        stops = tuple(name for name, there in zip(self.stops.names, stopped, strict=True) if there)
        return Truth(float(t), q, v, speeds, thrusts, torques, shapes, stops)

    def in_c(self, count: int) -> dict[str, Any] | None:
        """Return the values of this world for the struct in ``c/world_ticks.c``; a tick has ``count`` physics steps.

        Return ``None`` if C cannot simulate this world.  C supports neither delayed readings nor joints other than a
        floating base, hinges and slides.
        """
        self._check_ready()
        places, sample, floating = self._layout.places, self._past[-1], self.robot.floating
        if places is None or self._past.maxlen != 1:
            return None
        q, v = sample.state
        core = {"model": self._model._address, "data": self._data._address, "runaway": RUNAWAY**2,
                "nq": q.size, "nv": v.size, "nqpos": self._data.qpos.size, "floating": int(floating),
                "q_at": places[0], "v_at": places[1], "true_q": q, "true_v": v, "joints": self.limits.effort.size,
                "effort": self.limits.effort, "torque": self._torques, "steps": self._steps, "count": count,
                "timestep": self.timestep, "rotors": 0, "vibrates": 0, "refused": 0,
                "felt": -1 if self._felt is None else self._felt}  # fmt: skip
        parts = [core, self._filter.in_c(), self._noise.in_c(), self._log.in_c()]
        parts += [] if self._rotors is None else [self._rotors.in_c(count)]
        parts += [] if self._vibration is None else [self._vibration.in_c()]
        return {key: value for part in parts for key, value in part.items()}

    def next_in_c(self, n: int) -> dict[str, Any]:
        """Return the values for C that change between calls: the noise of n readings, and the pushes."""
        return {"noise": self._noise.draw(n), **self._pushes.in_c()}

    def go_to(self, steps: int) -> None:
        """Set the number of physics steps since the reset, after C code has computed steps."""
        self._steps = steps

    def _check_ready(self) -> None:
        if not self._past:
            raise InputError("has not been reset", where="world", hint="call reset(q) first")


def build_world(robot: Robot, scene: Scene, q: ArrayLike | None = None, throw: Throw | None = None) -> World:
    """Build the simulation of a robot in its surroundings.  With ``throw``, the world has a ball.

    The gaps of surfaces are measured at the posture ``q``, shape (nq,), by default the robot's default posture.

    Raises:
        InputError: MuJoCo is not installed, MuJoCo cannot compile the model, or the scene does not match the robot.
    """
    start = robot.posture() if q is None else robot.check_posture(np.asarray(q, dtype=float), where="start posture")
    return World(robot, scene, build_scene(robot, scene, start, throw))
