"""Projections, half widths, sections, polars and cones, compared with sampled points."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from impact_posture.output.plot import ResultView
from impact_posture.output.plot.ellipsoid_shapes import (
    COORDINATE_PLANES,
    Plane,
    cone_rim,
    cone_shadow,
    half_width,
    outline,
    polar,
    principal_sections,
    shadow,
    square,
    surface,
    upright_plane,
)
from tests.output.views import spin

PLANES = [*COORDINATE_PLANES, upright_plane(np.array([0.6, -0.5, 0.3]))]
RANKS = {3: (2.0, 0.7, 0.1), 2: (2.0, 0.7, 0.0), 1: (2.0, 0.0, 0.0)}


def matrix_of_rank(rank: int, seed: int = 0) -> np.ndarray:
    R = spin(seed)
    return R @ np.diag(np.square(RANKS[rank])) @ R.T


@functools.cache
def sphere(count: int) -> np.ndarray:
    directions = np.random.default_rng(7).normal(size=(3, count))
    return directions / np.linalg.norm(directions, axis=0)


def sampled(matrix: np.ndarray, count: int = 200_000) -> np.ndarray:
    """Return points on the ellipsoid, shape (3, count), computed with a non-symmetric matrix root."""
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.sqrt(np.maximum(values, 0))) @ sphere(count)


@pytest.mark.parametrize("rank", RANKS)
@pytest.mark.parametrize("plane", PLANES, ids=lambda p: p.name)
def test_shadow_is_the_projection_of_sampled_points(rank: int, plane: Plane) -> None:
    matrix = matrix_of_rank(rank)
    edge = shadow(matrix, plane.axes, 2001)
    points = plane.axes @ sampled(matrix)
    angle = np.linspace(0, np.pi, 37)
    directions = np.array([np.cos(angle), np.sin(angle)]).T
    reach = (directions @ edge).max(axis=1)
    seen = (directions @ points).max(axis=1)
    # The support function of the shadow is an upper bound for the samples, tight up to the sampling.
    assert (seen <= reach + 1e-5).all()
    np.testing.assert_allclose(seen, reach, atol=2e-3)


@pytest.mark.parametrize("rank", RANKS)
def test_half_width_is_the_support_function(rank: int) -> None:
    matrix = matrix_of_rank(rank, seed=1)
    points = sampled(matrix)
    for n in spin(5).T:
        assert half_width(matrix, n) == pytest.approx((n @ points).max(), abs=2e-4)


def test_half_width_is_the_root_of_H_and_not_the_radius(tilthex: ResultView) -> None:
    after = tilthex.after
    assert half_width(after.ellipsoid, after.normal) == pytest.approx(np.sqrt(after.H), rel=1e-12)
    radius = 1 / np.sqrt(after.normal @ np.linalg.solve(after.ellipsoid, after.normal))
    assert radius < 0.9 * np.sqrt(after.H)


@pytest.mark.parametrize("rank", RANKS)
def test_surface_and_sections_lie_on_the_ellipsoid(rank: int) -> None:
    matrix = matrix_of_rank(rank, seed=2)
    pseudo = np.linalg.pinv(matrix, rcond=1e-9, hermitian=True)
    cloud = surface(matrix).reshape(3, -1)
    size = np.einsum("ik,ij,jk->k", cloud, pseudo, cloud)
    assert size.max() == pytest.approx(1.0, abs=0.03)
    if rank == 3:
        np.testing.assert_allclose(size, 1.0, rtol=1e-9)
    sections = principal_sections(matrix)
    assert len(sections) == {3: 3, 2: 3, 1: 1}[rank]
    assert max(np.linalg.norm(s, axis=0).max() for s in sections) == pytest.approx(2.0)
    assert principal_sections(np.zeros((3, 3))) == []


def test_polar_dual() -> None:
    A = matrix_of_rank(3, seed=4)
    inverse, endless = polar(A, 1e3)
    np.testing.assert_allclose(inverse, np.linalg.inv(A), rtol=1e-9)
    assert endless.shape == (3, 0)
    A = matrix_of_rank(1, seed=4)
    inverse, endless = polar(A, 1e3)
    assert endless.shape == (3, 2)
    np.testing.assert_allclose(A @ endless, 0, atol=1e-12)
    assert half_width(inverse, endless[:, 0]) == pytest.approx(1e3)
    axis = np.linalg.eigh(A)[1][:, -1]
    assert half_width(inverse, axis) == pytest.approx(1 / 2.0)


@pytest.mark.parametrize("n", [(0, 0, 1), (1, 0, 0), (0.36, 0.48, 0.8)])
def test_square_is_perpendicular(n: tuple[float, float, float]) -> None:
    center = np.array([1.0, 2.0, 3.0])
    corners = square(center, np.array(n), 0.4)
    np.testing.assert_allclose((corners - center[:, None]).T @ n, 0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(np.diff(corners, axis=1), axis=0), 0.4, rtol=1e-12)
    np.testing.assert_allclose(corners[:, :4].mean(axis=1), center, atol=1e-12)


@pytest.mark.parametrize("degrees", [1e-4, 5.0, 45.0, 89.0])
@pytest.mark.parametrize("plane", PLANES, ids=lambda p: p.name)
def test_cone_shadow_is_the_projection_of_the_cone(degrees: float, plane: Plane) -> None:
    axis = spin(6)[:, 0]
    rim = cone_rim(axis, degrees, 2.0, 721)
    np.testing.assert_allclose(np.linalg.norm(rim, axis=0), 2.0, rtol=1e-12)
    np.testing.assert_allclose(axis @ rim, 2.0 * np.cos(np.radians(degrees)), rtol=1e-12)
    outline = cone_shadow(axis, degrees, 2.0, plane.axes)
    np.testing.assert_array_equal(outline[:, 0], outline[:, -1])
    # The outline of a cone has the same support function as its apex and rim together.
    angle = np.linspace(0, 2 * np.pi, 73)
    directions = np.array([np.cos(angle), np.sin(angle)]).T
    seen = np.maximum((directions @ plane.axes @ rim).max(axis=1), 0.0)
    np.testing.assert_allclose((directions @ outline).max(axis=1), seen, atol=4e-3)


@pytest.mark.parametrize("count", [3, 4, 10, 100, 1000])
def test_an_outline_is_the_convex_hull(count: int) -> None:
    points = np.random.default_rng(count).normal(size=(2, count)) * [[1e-2], [3.0]]
    ring = outline(points)
    np.testing.assert_array_equal(ring[:, 0], ring[:, -1])
    hull = points[:, ConvexHull(points.T).vertices]
    assert sorted(map(tuple, ring[:, 1:].T)) == sorted(map(tuple, hull.T))
    # The corners are sorted counter-clockwise, like the corners of SciPy.
    x, y = ring
    assert float(x[:-1] @ y[1:] - x[1:] @ y[:-1]) / 2 == pytest.approx(ConvexHull(points.T).volume, rel=1e-12)


def test_an_outline_of_points_in_a_row() -> None:
    np.testing.assert_array_equal(outline(np.array([[0.0, 2.0, 1.0], [1.0, 5.0, 3.0]])), [[0, 2, 0], [1, 5, 1]])
    np.testing.assert_array_equal(outline(np.ones((2, 3))), 1.0)
