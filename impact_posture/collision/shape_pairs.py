"""Pairs of shapes that must not touch, and pairs that touch by design."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.collision.mjcf_shapes import disabled_bodies
from impact_posture.collision.swept_hull import SweptHull, separation, transform
from impact_posture.robot.model_joints import v_slice
from impact_posture.robot.robot import Robot
from impact_posture.robot.urdf import read_srdf
from impact_posture.system.arrays import Array

# Number of random postures in ``touching_by_design``, and in ``nested_pairs``.
_POSTURES = 1000
_COUNTED = 100
_SEED = 0
# Sliding joints are parallel if all but one of the singular values of their directions are at most this value.
_PARALLEL = 1e-6

Pair = tuple[int, int]


def pairs_apart(
    model: pin.Model, joints: Sequence[int], links: Sequence[str], disabled: set[frozenset[str]]
) -> NDArray[np.bool_]:
    """Return whether each two shapes must not touch, shape (n, n), from the joint and the link of each shape.

    Shapes of the same joint or of consecutive joints may touch.  Links of a pair in ``disabled`` may also touch.
    """
    joint = np.array(joints, dtype=int)
    parent = np.array(model.parents, dtype=int)[joint]
    apart = (joint[:, None] != joint) & (parent[:, None] != joint) & (joint[:, None] != parent)
    allowed = np.array([[frozenset((a, b)) in disabled for b in links] for a in links], dtype=bool)
    return np.asarray(apart & ~allowed.reshape(apart.shape))


def pairs_of(apart: NDArray[np.bool_]) -> list[Pair]:
    """Return the pairs that must not touch, with the smaller index first."""
    return [(int(i), int(j)) for i, j in np.argwhere(np.triu(apart))]


def touching_by_design(robot: Robot, shapes: Sequence[pin.GeometryObject], pairs: list[Pair]) -> list[Pair]:
    """Return the pairs of shapes that overlap by design, for example the covers of a wrist.

    Such shapes touch at the default posture and at more than half of 1,000 random postures.  Parts of a telescope,
    which slide in each other along one line, only need to touch at a named posture.
    """
    data, touch = robot.model.createData(), touch_of(shapes)
    jacobians = np.array(pin.computeJointJacobians(robot.model, data, robot.posture()))
    supports = [set(robot.model.supports[shape.parentJoint]) for shape in shapes]
    sliding = [(i, j) for i, j in pairs if _telescopic(robot.model, jacobians, supports[i], supports[j])]
    nested: set[Pair] = set()
    for q in robot.postures.values() if sliding else ():
        pin.forwardKinematics(robot.model, data, q)
        nested.update(pair for pair in sliding if touch(pair, data))
    pin.forwardKinematics(robot.model, data, robot.posture())
    count = {pair: 0 for pair in pairs if pair not in nested and touch(pair, data)}
    for q in random_postures(robot, _POSTURES) if count else ():
        pin.forwardKinematics(robot.model, data, q)
        for pair in count:
            count[pair] += touch(pair, data)
    return [pair for pair in pairs if pair in nested or count.get(pair, 0) > _POSTURES / 2]


def _telescopic(model: pin.Model, jacobians: Array, first: set[int], second: set[int]) -> bool:
    """Return whether one joint carries the other, and all joints between them slide along the same direction.

    ``first`` and ``second`` each contain a joint and all joints that carry it; ``jacobians`` has the shape (6, nv).
    """
    if not (first < second or second < first):
        return False
    J = jacobians[:, np.r_[tuple(v_slice(model, joint) for joint in first ^ second)]]
    return not J[3:].any() and np.linalg.matrix_rank(J, _PARALLEL) == 1


def nested_pairs(
    robot: Robot, bodies: Sequence[SweptHull], pairs: list[Pair], touch: Callable[[Pair, pin.Data], bool]
) -> list[Pair]:
    """Return the pairs of nested bodies, for example a shaft in a fork.

    The hulls of nested bodies overlap at more than half of the postures where the shapes do not touch.  A constraint
    that keeps the hulls apart would forbid most postures.  ``touch`` tells whether the shapes touch at given
    placements.
    """
    data = robot.model.createData()
    apart, forbidden = np.zeros((2, len(pairs)), dtype=int)
    first, second = np.array(pairs, dtype=int).reshape(-1, 2).T
    reach = np.array([body.reach for body in bodies])
    for q in [robot.posture(), *random_postures(robot, _COUNTED)]:
        pin.forwardKinematics(robot.model, data, q)
        center = np.array([data.oMi[body.joint].act(body.center) for body in bodies]).reshape(-1, 3)
        far = np.linalg.norm(center[first] - center[second], axis=1) > reach[first] + reach[second]
        apart += far
        for k in np.flatnonzero(~far):
            a, b = (bodies[i] for i in pairs[k])
            if separation(a, data.oMi[a.joint], b, data.oMi[b.joint]).distance > 0:
                apart[k] += 1
            elif not touch(pairs[k], data):
                forbidden[k] += 1
    return [pair for pair, lost, kept in zip(pairs, forbidden, apart, strict=True) if lost >= kept]


def touch_of(shapes: Sequence[pin.GeometryObject]) -> Callable[[Pair, pin.Data], bool]:
    """Return a function that tells whether two shapes touch at the joint placements in a ``pin.Data``."""

    def touch(pair: Pair, data: pin.Data) -> bool:
        a, b = (shapes[k] for k in pair)
        at_a, at_b = (transform(data.oMi[shape.parentJoint] * shape.placement) for shape in (a, b))
        return bool(coal.collide(a.geometry, at_a, b.geometry, at_b, coal.CollisionRequest(), coal.CollisionResult()))

    return touch


def random_postures(robot: Robot, count: int) -> Iterator[Array]:
    """Yield random postures within the limits, and within half a turn of the default posture."""
    model, random, start = robot.model, np.random.default_rng(_SEED), robot.posture()
    low = np.maximum(model.lowerPositionLimit, start - np.pi)
    high = np.minimum(model.upperPositionLimit, start + np.pi)
    bounded = [model.idx_qs[i] for i in range(1, model.njoints) if model.nqs[i] == model.nvs[i] == 1]
    for _ in range(count):
        q = np.array(pin.integrate(model, start, random.uniform(-np.pi, np.pi, model.nv)))
        q[bounded] = random.uniform(np.minimum(low, high), high)[bounded]
        yield robot.coupled(q)


def disabled_links(robot: Robot) -> set[frozenset[str]]:
    """Return the pairs of links that the SRDF or the MJCF allows to touch."""
    pairs = set() if robot.mjcf is None else disabled_bodies(robot.mjcf.model)
    path = None if robot.files is None else robot.files.srdf
    if path is None:
        return pairs
    tags = read_srdf(path).iter("disable_collisions")
    return pairs | {frozenset((tag.get("link1", ""), tag.get("link2", ""))) for tag in tags}
