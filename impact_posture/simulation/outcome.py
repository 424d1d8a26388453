"""Outcome of a run: completed, or the bound of the scenario that the run violated."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import pinocchio as pin
from scipy import ndimage
from scipy.spatial.transform import Rotation

from impact_posture.errors import listed
from impact_posture.simulation.metrics import Metrics
from impact_posture.simulation.recorder import feet_of
from impact_posture.simulation.run import Run
from impact_posture.simulation.series import Flags, Series
from impact_posture.simulation.setup import Setup
from impact_posture.system.arrays import Array
from impact_posture.system.escape import xml_name
from impact_posture.system.optional_package import import_mujoco

# The outcomes are listed from the best to the worst.
Outcome = Literal["completed", "lost contact", "control lost", "fell"]
OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)
# Links behind a surface are searched only in every 25th tick.
_EVERY = 25
# Largest number of pairs of touching links that a warning lists.
_MOST = 4
# A link has moved through a surface if its joint origin is farther than this behind the surface, m.  The penetration
# of a simulated contact is smaller.
_DEEP = 0.02
# The prediction fits if the measured velocity jump divided by the predicted velocity jump is in this range.
_FITS = (0.67, 1.5)


@dataclass(frozen=True)
class Event:
    """Violation of a bound of the scenario: description ``what``, ``time`` (s), and ``status`` of the run."""

    status: Outcome
    time: float
    what: str


def gravest(outcomes: Iterable[Outcome]) -> Outcome:
    """Return the worst of the outcomes, or ``completed`` if there are no outcomes."""
    return max(outcomes, key=OUTCOMES.index, default="completed")


def links_behind(setup: Setup, runs: Iterable[Run]) -> tuple[str, ...]:
    """Return a warning for each surface that links without shapes moved through.

    The simulation does not stop a link without a shape at a surface.  The warning lists the joints whose origin was
    in front of the plane at the start and later more than 2 cm behind the plane.
    """
    robot, built = setup.robot, setup.world.built
    shaped = {int(robot.model.frames[robot.frame_id(s.frame)].parentJoint) for s in setup.scenario.shapes}
    joints = [k for k in range(1, robot.model.njoints) if k not in shaped]
    q = np.vstack([setup.q, *[run.series.q[::_EVERY] for run in runs]])
    origins = _origins(robot.model, joints, q)
    lines = []
    for name, n in built.normals.items():
        heights = (origins - built.points[name]) @ n
        through = (heights[0] > 0) & (heights.min(axis=0) < -_DEEP)
        if through.any():
            names = ", ".join(robot.model.names[joints[k]] for k in np.flatnonzero(through))
            lines.append(
                f"{names} went up to {-heights[:, through].min():.2g} m behind the surface '{name}': these links "
                "have no shapes that stop them (scenario.toml [[shapes]])"
            )
    return tuple(lines)


def doubts(setup: Setup, runs: Iterable[Run], metrics: Iterable[Metrics], ratio: float | None) -> tuple[str, ...]:
    """Return a warning for each reason to doubt the numbers of completed runs.

    ``ratio`` is the mean of the measured jump divided by the predicted jump.  A push gets no warning about its ratio,
    because the prediction neglects the controller, which acts during the whole push.
    """
    lines = []
    if setup.scenario.push is None and ratio is not None and not _FITS[0] <= ratio <= _FITS[1]:
        lines.append(f"the measured jump is {ratio:.2g} times the predicted jump: the model does not fit this impact")
    counts = np.zeros(2, dtype=int)
    for run in runs:
        series = run.series
        for window in run.of("impact"):
            inside = series.slice(window.begin, window.end)
            counts += series.relaxed[inside].sum(), series.held[inside].sum()
    for count, what in zip(counts, ("limits made a task give way", "the last command was repeated"), strict=True):
        if count:
            lines.append(f"{what} in {count} ticks of the impact windows")
    if (seconds := sum(m.saturation_inside for m in metrics)) > 0:
        lines.append(f"an actuator was at its limit for {seconds:.2g} s of the impact windows")
    return (*lines, *_rotors_touch(setup, runs), *_links_touch(setup, runs))


def _rotors_touch(setup: Setup, runs: Iterable[Run]) -> Iterator[str]:
    built = setup.world.built
    if not len(built.rotor_link):
        return
    propulsion = setup.robot.spec.propulsion
    assert propulsion is not None  # noqa: S101 (the link exists)
    for name, n in built.normals.items():
        for run in runs:
            t = run.series.t[_below(setup, run.series.q, n, built.points[name])]
            if t.size:
                yield f"{propulsion.frame} or a rotor on it touched the surface '{name}' at t = {t[0]:.2f} s"
                break


def _links_touch(setup: Setup, runs: Iterable[Run]) -> Iterator[str]:
    built = setup.world.built
    if not built.link_geoms:
        return
    mujoco, model, layout = import_mujoco(), built.mjcf.compile(), built.mjcf.layout
    data, begins = mujoco.MjData(model), dict[str, float]()
    labels = {model.geom(name).id: link.body for name, link in built.link_geoms.items()}
    labels |= {model.geom(xml_name(f"surface {name}")).id: f"the surface '{name}'" for name in built.normals}
    for t, q in (state for run in runs for state in zip(run.series.t, run.series.q, strict=True)):
        data.qpos[: layout.nqpos] = layout.qpos(q)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        for pair in data.contact.geom[data.contact.dist < 0].tolist() if data.ncon else ():
            if all(geom in labels for geom in pair):
                begins.setdefault(" and ".join(sorted(labels[geom] for geom in pair)), float(t))
    if begins:
        pairs = [f"{pair} (t = {t:.2f} s)" for pair, t in sorted(begins.items(), key=lambda item: item[1])]
        yield f"links touched: {listed(pairs, _MOST)}"


def _below(setup: Setup, q: Array, n: Array, point: Array) -> Flags:
    """Return, for each posture, whether the link with the rotors touches the plane (``point``, normal ``n``)."""
    turned = Rotation.from_quat(q[:, 3:7]).inv().apply(n)
    depth = (turned @ setup.world.built.rotor_link.T).min(axis=1)
    return np.asarray((q[:, :3] - point) @ n + depth < 0)


def _origins(model: pin.Model, joints: Sequence[int], postures: Array) -> Array:
    """Return the origins of joints in each posture, world, m, shape (postures, joints, 3)."""
    data, origins = model.createData(), np.empty((len(postures), len(joints), 3))
    for k, q in enumerate(postures):
        pin.forwardKinematics(model, data, q)
        for column, joint in enumerate(joints):
            origins[k, column] = data.oMi[joint].translation
    return origins


def judge(setup: Setup, run: Run) -> tuple[Event, ...]:
    """Return the bounds of the scenario that a run violated, sorted by time."""
    events = [*_falls(setup, run.series), *_losses(setup, run), *_contacts(setup, run)]
    return tuple(sorted(events, key=lambda event: event.time))


def _falls(setup: Setup, series: Series) -> list[Event]:
    if not setup.robot.floating:
        return []
    bounds, built, places = setup.scenario.bounds, setup.world.built, series.q[:, :3]
    upright = pin.Quaternion(setup.q[3:7]).matrix()[2]
    x, y, z, w = series.q[:, 3:7].T
    tilt = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1) @ upright
    normal = setup.scenario.normal if setup.scenario.contacts else np.zeros(3)
    sunk = setup.q[2] - normal[2] * series.reference - places[:, 2]
    broken = {
        f"the base tilted beyond {bounds.tilt_deg:g}°": tilt < np.cos(np.radians(bounds.tilt_deg)),
        f"the base sank by more than {bounds.sink:g} m": sunk > bounds.sink,
    }
    for name, n in built.normals.items():
        if (setup.q[:3] - built.points[name]) @ n < bounds.clearance:
            # Ignore a surface if the base is behind it at the start, because real surfaces do not extend that far.
            continue
        words = f"the base came closer than {bounds.clearance:g} m to" if bounds.clearance else "the base went into"
        broken[f"{words} the surface '{name}'"] = (places - built.points[name]) @ n < bounds.clearance
    return [Event("fell", float(series.t[np.argmax(flags)]), what) for what, flags in broken.items() if flags.any()]


def _losses(setup: Setup, run: Run) -> list[Event]:
    bounds, series, period = setup.scenario.bounds, run.series, setup.scenario.control.period
    events, relaxed = [], series.relaxed
    if relaxed.mean() > bounds.relaxed:
        words = f"limits made tasks give way in {100 * relaxed.mean():.0f} % of all ticks, first"
        events.append(Event("control lost", float(series.t[np.argmax(relaxed)]), words))
    begin, length = _longest(series.held)
    if length * period > bounds.held + 1e-9:
        words = f"the controller had no command for {length * period:.3g} s, so the last command was held,"
        events.append(Event("control lost", float(series.t[begin]), words))
    if run.away is not None:
        events.append(Event("control lost", run.away, "the state ran away"))
    return events


def _contacts(setup: Setup, run: Run) -> list[Event]:
    bounds, series, period = setup.scenario.bounds, run.series, setup.scenario.control.period
    events, impacts = [], run.of("impact")
    missed = [window for window in impacts if not window.touched]
    if missed:
        words = f"{len(missed)} of {len(impacts)} contacts were never made, the first expected"
        events.append(Event("lost contact", missed[0].begin, words))
    lifted = [(*_longest(~touches.astype(bool)), foot) for foot, touches in enumerate(series.feet.T)]
    lifted = [each for each in lifted if each[1] * period > bounds.lifted + 1e-9]
    if lifted:
        # Report only the first foot, because other feet often leave the ground as a consequence.
        begin, length, foot = min(lifted)
        words = f"{feet_of(setup)[foot]} left the ground for {length * period:.3g} s"
        events.append(Event("lost contact", float(series.t[begin]), words))
    return events


def _longest(flags: Flags) -> tuple[int, int]:
    """Return the first index and the length of the longest sequence of true flags."""
    sequences = [ticks for (ticks,) in ndimage.find_objects(ndimage.label(flags)[0])]
    longest = max(sequences, key=lambda ticks: ticks.stop - ticks.start, default=slice(0, 0))
    return longest.start, longest.stop - longest.start
