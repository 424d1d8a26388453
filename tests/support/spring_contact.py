"""A spring at a contact with exact Coulomb friction, integrated in small steps: an independent check of forces."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tests.support.helpers import Vector


class SpringImpact(NamedTuple):
    """Result of :func:`spring_impact`, from touch to greatest compression.

    Attributes:
        force: Largest normal force, N.
        time: Time from touch to greatest compression, s.
        normal_impulse: Normal impulse until then, N·s.
        velocity: Change of the velocity until then, shape (nv,).
        sticks: Whether the contact point did not slide.
    """

    force: float
    time: float
    normal_impulse: float
    velocity: Vector
    sticks: bool


def spring_impact(
    M: Vector, J: Vector, n: Vector, friction: float, stiffness: float, speed: float, *, power: float = 1.0
) -> SpringImpact:
    """Integrate the impact of a point on a surface that resists with ``f = stiffness · depth^power`` along ``n``.

    Configuration and ``M``, shape (nv, nv), are constant.  The point with the Jacobian ``J``, shape (3, nv),
    approaches along ``−n`` at ``speed``.  In each step, the friction impulse is the impulse within the friction disk
    that stops the sliding, or opposes it.
    """
    W = np.linalg.solve(M, J.T)
    B = J @ W
    axes = np.linalg.svd(n[None, :])[2][1:].T
    Bt, coupling = axes.T @ B @ axes, axes.T @ B @ n
    inverse = np.linalg.inv(Bt)
    step, damping = 1e-4 / np.sqrt(stiffness * (n @ B @ n)), 1 / np.linalg.norm(Bt, 2)
    if power != 1.0:
        depth = (speed**2 / (stiffness * (n @ B @ n))) ** (1 / (power + 1))
        step = 1e-4 * depth / speed
    u, depth, time, force, impulse = -speed * n, 0.0, 0.0, 0.0, np.zeros(3)
    friction_impulse, sticks = np.zeros(2), True
    while n @ u < 0:
        middle = depth - n @ u * step / 2
        push = stiffness * middle**power * step
        slip = axes.T @ u + coupling * push
        held = -inverse @ slip
        if np.linalg.norm(held) <= friction * push:
            friction_impulse = held
        for _ in range(10_000):
            tried = friction_impulse - damping * (slip + Bt @ friction_impulse)
            tried *= min(1.0, friction * push / max(np.linalg.norm(tried), 1e-300))
            moved, friction_impulse = np.linalg.norm(tried - friction_impulse), tried
            if moved <= 1e-12 * push:
                break
        kick = push * n + axes @ friction_impulse
        depth, time, force = depth - n @ u * step, time + step, max(force, push / step)
        u, impulse = u + B @ kick, impulse + kick
        sticks = sticks and bool(np.linalg.norm(axes.T @ u) < 1e-6 * speed)
    return SpringImpact(force, time, float(n @ impulse), W @ impulse, sticks)
