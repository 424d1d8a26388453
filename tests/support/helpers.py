"""Helpers of the mathematical tests.  These helpers call the code under test only to load a robot."""

from __future__ import annotations

import functools
import zlib
from dataclasses import replace

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import known_robots, load_robot

Vector = NDArray[np.float64]

NAMES = known_robots()


@functools.cache
def robot(name: str) -> Robot:
    """Load a known robot once per process."""
    return load_robot(name)


def contact_frame(loaded: Robot) -> str:
    assert loaded.spec.contact.frame is not None
    return loaded.spec.contact.frame


@functools.cache
def uncoupled(name: str) -> Robot:
    """Load a known robot without the couplings of its joints, for references that have no couplings."""
    return replace(robot(name), couplings=())


def rng(*key: object) -> np.random.Generator:
    """Return a random generator for a key, the same on every run and machine."""
    return np.random.default_rng(zlib.crc32(repr(key).encode()))


def random_configurations(model: pin.Model, count: int, *key: object, spread: float = 1.0) -> list[Vector]:
    """Draw configurations ``neutral ⊕ v``, where ``v`` is normally distributed."""
    generator = rng(*key)
    return [
        np.array(pin.integrate(model, pin.neutral(model), spread * generator.normal(size=model.nv)))
        for _ in range(count)
    ]


def unit(generator: np.random.Generator, size: int = 3) -> Vector:
    v = generator.normal(size=size)
    return v / np.linalg.norm(v)


def relative(actual: ArrayLike, expected: ArrayLike, scale: float = 0.0) -> float:
    """Return the largest deviation, divided by the largest expected entry or by ``scale``, whichever is larger.

    Pass a scale for values that may be zero.
    """
    x, y = np.array(actual, dtype=float), np.array(expected, dtype=float)
    assert x.size == y.size, (x.shape, y.shape)
    x = x.reshape(y.shape)
    if not np.isfinite(x).all():
        return float("inf")
    return float(np.abs(x - y).max() / max(np.abs(y).max(), scale))


def assert_close(actual: ArrayLike, expected: ArrayLike, tolerance: float, what: str, scale: float = 0.0) -> None:
    """Fail unless the relative error (:func:`relative`) is within the tolerance."""
    error = relative(actual, expected, scale)
    assert error <= tolerance, f"{what}: relative error {error:.2e} above {tolerance:.0e}"
