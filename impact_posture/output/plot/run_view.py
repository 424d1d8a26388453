"""Data for the figures of a simulated run: robot, contact, and arrays with a row for each controller tick."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from impact_posture.errors import InputError
from impact_posture.impact.evaluation.impact_effect import tangent_units
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.output.plot.result_view import SEPARATOR, number
from impact_posture.robot.actuation import torque_limits
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import Support
from impact_posture.system.arrays import Array

if TYPE_CHECKING:
    from impact_posture.simulation.series import Window

Flags = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class RunView:
    """Run of a controller in a scenario, with n ticks.  Each row contains the state at the end of a tick.

    Attributes:
        contact: Impact contact with its frame, its offset, and the world normal out of the surface (or along a push).
        t: Time, s, increasing, shape (n,).
        q: Configuration, shape (n, nq).
        v: Generalized velocity ν, shape (n, nv).
        torque: Commanded joint torques, N·m (N for sliding joints), shape (n, joints).
        rotor_command: Commanded rotor speeds, shape (n, rotors).
        rotor_speed: Measured rotor speeds, shape (n, rotors).
        force: Force of the surface or push on the robot, world, N, shape (n, 3).
        peak: Largest normal force within each tick, N, shape (n,).
        objective: H of the impact, shape (n,); NaN if it was not evaluated.
        level: Activation of the impact-robust term, 0 to 1, shape (n,).
        at_stop: Whether a joint is at a position limit, shape (n, nv).
        windows: Time windows.  Figures shade windows of the kinds ``impact`` and ``dwell``.
        surface: A point on the surface, world, m, shape (3,); ``None`` for a push.
        supports: Feet that stay on the ground.
        label: Name of the run in figures of several runs; empty for the name of the controller.
        facts: Texts for the lines below the title, such as the seed and the sign of the push.
    """

    scenario: str
    controller: str
    robot: Robot
    contact: ImpactContact
    t: Array
    q: Array
    v: Array
    torque: Array
    rotor_command: Array
    rotor_speed: Array
    force: Array
    peak: Array
    objective: Array
    level: Array
    at_stop: Flags
    windows: tuple[Window, ...] = ()
    surface: Array | None = None
    supports: tuple[Support, ...] = ()
    label: str = ""
    facts: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Refuse arrays of a wrong shape, fewer than two ticks, or times that do not increase."""
        n, nv = len(self.t), self.robot.nv
        rotors = np.shape(self.rotor_command)[1:]
        shapes: dict[str, tuple[int, ...]] = {
            "t": (n,), "q": (n, self.robot.nq), "v": (n, nv), "torque": (n, nv - self.robot.first_joint),
            "rotor_command": (n, *rotors), "rotor_speed": (n, *rotors), "force": (n, 3), "peak": (n,),
            "objective": (n,), "level": (n,), "at_stop": (n, nv),
        }  # fmt: skip
        where = f"run view {self.scenario}, {self.controller}"
        for name, shape in shapes.items():
            if np.shape(getattr(self, name)) != shape:
                actual = np.shape(getattr(self, name))
                raise InputError(f"{name} has the shape {actual}", where=where, hint=f"give {shape}")
        if len(rotors) != 1 or n < 2 or not (np.diff(self.t) > 0).all():
            fault = "has fewer than two ticks, or times that do not increase"
            raise InputError(fault, where=where, hint="give at least two ticks at increasing times")

    @property
    def name(self) -> str:
        """Name of the run in figures of several runs."""
        return self.label or self.controller

    @property
    def impacts(self) -> tuple[Window, ...]:
        """Impact windows, sorted by time."""
        return tuple(sorted((w for w in self.windows if w.kind == "impact"), key=lambda w: w.begin))

    @property
    def pushed(self) -> bool:
        """Whether the impact is a push, without a surface."""
        return self.surface is None

    @cached_property
    def speed(self) -> Array:
        """``‖ν‖``, shape (n,)."""
        return np.asarray(np.linalg.norm(self.v, axis=1))

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the entries of ν that belong to joints."""
        return self.robot.tangent_names[self.robot.first_joint :]

    @cached_property
    def joint_units(self) -> tuple[str, ...]:
        """Unit of each joint position, ``rad`` or ``m``."""
        return tuple(unit.removesuffix("/s") for unit in tangent_units(self.robot)[self.robot.first_joint :])

    @cached_property
    def positions(self) -> Array:
        """Position of each joint, rad or m, shape (n, joints).  Angles of continuous joints are unwrapped.

        Entries are NaN for joints with several degrees of freedom.
        """
        model, q = self.robot.model, np.asarray(self.q)
        positions = np.full((len(self.t), self.robot.nv), np.nan)
        for joint in range(1, model.njoints):
            if int(model.nvs[joint]) == 1:
                at, v = int(model.idx_qs[joint]), int(model.idx_vs[joint])
                # For a continuous joint, q contains the cosine and sine of the angle.
                endless = int(model.nqs[joint]) == 2
                positions[:, v] = np.unwrap(np.arctan2(q[:, at + 1], q[:, at])) if endless else q[:, at]
        return positions[:, self.robot.first_joint :]

    @property
    def torque_limits(self) -> Array:
        """Torque limit of each joint, N·m (N), shape (joints,); infinite for a joint without a limit."""
        return torque_limits(self.robot.model)[self.robot.first_joint :]

    @property
    def rotor_limits(self) -> tuple[float, float] | None:
        """Lowest and highest rotor speed; ``None`` for a robot without rotors."""
        propulsion = self.robot.spec.propulsion
        return None if propulsion is None else (propulsion.speed_min, propulsion.speed_max)

    def index(self, time: float) -> int:
        """Return the index of the last tick that ends at or before ``time`` (s), at least 0."""
        return max(int(np.searchsorted(self.t, time, side="right")) - 1, 0)


def run_header(views: Sequence[RunView]) -> tuple[str, list[str]]:
    """Return the title of a figure of runs, and the lines below the title."""
    first = views[0]
    names = ", ".join(view.name for view in views) if len(views) < 5 else f"{len(views)} controllers"
    n = ", ".join(number(value) for value in first.contact.normal)
    facts = [f"robot {first.robot.name}"]
    if first.pushed:
        facts += [f"pushed at {first.contact.frame}", f"H along ({n})"]
    else:
        touched = [sum(w.touched for w in view.impacts) for view in views]
        counts = ", ".join(str(count) for count in (touched if len(set(touched)) > 1 else touched[:1]))
        facts += [f"contact {first.contact.frame}", f"n = ({n})", f"contacts {counts} of {len(first.impacts)}"]
    facts.append(f"on {', '.join(s.frame for s in first.supports)}" if first.supports else "no supports")
    facts += [fact for fact in first.facts if all(fact in view.facts for view in views)]
    return f"{first.scenario}: {names}", [SEPARATOR.join(facts)]


def check_same(views: Sequence[RunView], where: str) -> tuple[RunView, ...]:
    """Return the views with the nominal controller first.

    Raises:
        InputError: There is no view, or the views belong to different scenarios or robots.
    """
    if not views:
        raise InputError("there is no run to draw", where=where, hint="give at least one view")
    first = views[0]
    for view in views:
        compared: dict[str, Any] = {
            "scenario": (view.scenario, first.scenario),
            "robot": (view.robot.name, first.robot.name),
            "number of joint speeds": (view.robot.nv, first.robot.nv),
            "number of rotors": (view.rotor_command.shape[1], first.rotor_command.shape[1]),
        }
        for what, (value, expected) in compared.items():
            if value != expected:
                fault = f"the {what} of {view.name} is {value}, but for {first.name} it is {expected}"
                raise InputError(fault, where=where, hint="compare runs of the same scenario")
    return tuple(sorted(views, key=lambda view: view.controller != "nominal"))
