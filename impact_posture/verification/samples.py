"""Random postures and normals for comparisons."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impact_posture.arrays import Array
from impact_posture.dynamics.chart import Chart
from impact_posture.robot.robot import Robot


@dataclass(frozen=True, eq=False)
class Sample:
    """A configuration and a normal.

    Attributes:
        q: Configuration, shape (nq,).
        normal: Unit vector, shape (3,), in the contact's normal frame.
    """

    q: Array
    normal: Array


def random_samples(robot: Robot, count: int, seed: int, normal: Array | None = None) -> tuple[Sample, ...]:
    """Return random postures, each with a random normal; one seed gives one result.

    The first sample has ``normal``, shape (3,), if it is given.

    Joints are uniform within their limits.  Without limits, angles are within ±π and lengths within 1 m of the
    default posture, and orientations are uniform.  A limit missing on one side lies as far from the default posture.
    """
    generator, chart = np.random.default_rng(seed), Chart(robot.model)
    start = chart.to_x(robot.posture())
    lower, upper = chart.bounds()
    reach = np.ones(chart.nx)
    for slot in chart.slots:
        if slot.kind.family in ("revolute", "continuous", "planar"):
            reach[slot.x.stop - 1] = np.pi
    lower = np.where(np.isfinite(lower), lower, np.minimum(start, upper) - reach)
    upper = np.where(np.isfinite(upper), upper, np.maximum(start, lower) + reach)
    found = []
    for k in range(count):
        x = generator.uniform(lower, upper)
        for quaternion in chart.quaternion_slices():
            x[quaternion] = _direction(generator, 4)
        drawn = _direction(generator, 3)
        found.append(Sample(chart.to_q(x), drawn if k or normal is None else normal))
    return tuple(found)


def _direction(generator: np.random.Generator, size: int) -> Array:
    """Return a unit vector, uniform on the sphere."""
    vector = generator.normal(size=size)
    return np.asarray(vector / np.linalg.norm(vector))
