"""Swept hulls: distances compared with a quadratic program, and hulls that contain all given points."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import nnls
from scipy.spatial import ConvexHull

from impact_posture.collision.shape_corners import shape_points
from impact_posture.collision.swept_hull import (
    MOST_VERTICES,
    SweptHull,
    fit_hull,
    hull_corners,
    obstacle_hull,
    separation,
)
from impact_posture.config.obstacle import Obstacle
from impact_posture.system.arrays import Array

SEEDS = st.integers(0, 2**32 - 1)


def distance_of_hulls(a: Array, b: Array) -> float:
    """Return the distance between the hulls of two point sets, by non-negative least squares of convex weights."""
    weight = 1e4
    rows = np.vstack([np.hstack([a.T, -b.T]), weight * np.r_[np.ones(len(a)), np.zeros(len(b))],
                      weight * np.r_[np.zeros(len(a)), np.ones(len(b))]])  # fmt: skip
    shares = nnls(rows, np.r_[0, 0, 0, weight, weight], maxiter=10_000)[0]
    share_a, share_b = shares[: len(a)], shares[len(a) :]
    return float(np.linalg.norm(share_a @ a / share_a.sum() - share_b @ b / share_b.sum()))


def hull(points: Array, radius: float = 0.0) -> SweptHull:
    return SweptHull("hull", "hull", 0, points, radius)


def placement(random: np.random.Generator) -> pin.SE3:
    quaternion = random.normal(size=4)
    return pin.XYZQUATToSE3(np.r_[random.normal(size=3), quaternion / np.linalg.norm(quaternion)])


@given(SEEDS, st.sampled_from([1, 2, 3, 4, 12, 40]), st.sampled_from([1, 2, 4, 40]))
def test_distance_equals_the_quadratic_program(seed: int, count_a: int, count_b: int) -> None:
    random = np.random.default_rng(seed)
    a, b = random.normal(size=(count_a, 3)) * 0.2, random.normal(size=(count_b, 3)) * 0.2
    at_a, at_b = placement(random), placement(random)
    result = separation(hull(a, 0.01), at_a, hull(b, 0.02), at_b)
    world_a, world_b = (p @ at.rotation.T + at.translation for p, at in ((a, at_a), (b, at_b)))
    apart = distance_of_hulls(world_a, world_b)
    if apart < 1e-6:
        assert result.distance <= -0.03 + 1e-6
        return
    # The penalty on the convex weights causes an error of about 1e-8.
    assert result.distance == pytest.approx(apart - 0.03, abs=1e-7)
    assert np.linalg.norm(result.normal) == pytest.approx(1, abs=1e-9)
    np.testing.assert_allclose(result.point_a - result.point_b, result.distance * result.normal, atol=1e-8)
    # The normal points from b to a and separates both hulls.
    assert np.min(world_a @ result.normal) - np.max(world_b @ result.normal) == pytest.approx(apart, abs=1e-7)


def test_penetration_is_the_shortest_way_out() -> None:
    """Two boxes of width 1 m overlap by 0.1 m along x.  Sweep radii of 1 cm make the penetration 0.12 m."""
    box = obstacle_hull(Obstacle(name="box", box=(1.0, 1.0, 1.0)))
    swept = hull(box.vertices, 0.01)
    result = separation(swept, pin.SE3(np.eye(3), np.array([0.9, 0.1, 0.2])), swept, pin.SE3.Identity())
    assert result.distance == pytest.approx(-0.12, abs=1e-6)
    np.testing.assert_allclose(result.normal, [1, 0, 0], atol=1e-6)


@given(SEEDS, st.integers(1, 300), st.sampled_from(["ball", "rod", "plate", "line", "point"]))
def test_fit_contains_all_points(seed: int, count: int, form: str) -> None:
    random = np.random.default_rng(seed)
    extent = {
        "ball": (0.2, 0.2, 0.2), "rod": (0.5, 0.02, 0.02), "plate": (0.3, 0.2, 0.0), "line": (0.4, 0, 0),
        "point": (0, 0, 0),
    }[form]  # fmt: skip
    at = placement(random)
    points = random.normal(size=(count, 3)) * extent @ at.rotation.T + at.translation
    vertices, radius = fit_hull(points)
    assert len(vertices) <= MOST_VERTICES
    assert max(distance_of_hulls(vertices, p[None]) for p in points[:60]) <= radius + 1e-7
    # The sweep radius is the largest distance of a point from the hull, plus the thickness of a flat hull.
    outside = max(distance_of_hulls(vertices, p[None]) for p in points)
    assert radius <= outside + 2.1e-4


def test_fit_stops_at_the_tolerance() -> None:
    """The hull of a box with edges rounded by 3 mm needs hardly more than 8 vertices."""
    random = np.random.default_rng(0)
    box = np.array(np.meshgrid(*[[-0.1, 0.1]] * 3)).reshape(3, -1).T
    edges = random.normal(size=(3000, 3))
    edges *= 0.003 / np.linalg.norm(edges, axis=1)[:, None]
    vertices, radius = fit_hull((box[:, None] + edges[None]).reshape(-1, 3))
    assert len(vertices) < 16
    assert radius <= 0.004 + 1e-6


@pytest.mark.parametrize("kind", ["Box", "Sphere", "Cylinder", "Capsule"])
def test_points_contain_a_primitive_shape(kind: str) -> None:
    """In random directions, the points extend at least as far as the shape and at most 3 % farther."""
    import coal

    sizes = {"Box": (0.2, 0.3, 0.4), "Sphere": (0.2,), "Cylinder": (0.1, 0.6), "Capsule": (0.1, 0.6)}[kind]
    points = shape_points(getattr(coal, kind)(*sizes))
    directions = np.random.default_rng(1).normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    x, y, z = np.abs(directions.T)
    support = {
        "Box": 0.1 * x + 0.15 * y + 0.2 * z,
        "Sphere": np.full(500, 0.2),
        "Cylinder": 0.1 * np.hypot(x, y) + 0.3 * z,
        "Capsule": 0.1 + 0.3 * z,
    }[kind]
    reached = (directions @ points.T).max(axis=1)
    assert np.all(reached >= support - 1e-12)
    assert np.all(reached <= support * 1.03 + 1e-12)


def test_faces_center_and_reach_of_a_box() -> None:
    box = obstacle_hull(Obstacle(name="box", box=(0.2, 0.4, 0.6), position=(1.0, 0.0, 0.0)))
    assert ConvexHull(box.vertices).volume == pytest.approx(0.048)
    assert box.faces.shape == (12, 3)
    np.testing.assert_allclose(box.center, [1, 0, 0])
    assert box.reach == pytest.approx(np.linalg.norm([0.1, 0.2, 0.3]))
    assert len(hull_corners(np.zeros((4, 3)))) == 1


def test_a_corner_on_a_corner_has_a_distance() -> None:
    """A point at a corner of a box touches the box, with and without a sweep radius."""
    box = obstacle_hull(Obstacle(name="box", box=(1.0, 1.0, 1.0), position=(0.5, 0.5, 0.5)))
    for corner in box.vertices:
        for point in (hull(corner[None], 0.01), hull(corner[None])):
            result = separation(point, pin.SE3.Identity(), box, pin.SE3.Identity())
            assert result.distance == pytest.approx(-point.radius, abs=2e-9)
            assert np.linalg.norm(result.normal) == pytest.approx(1)
