"""Draw outlines of the collision shapes of a robot behind its sticks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from matplotlib.patches import Patch, PathPatch
from matplotlib.path import Path
from mpl_toolkits.mplot3d import proj3d

from impact_posture.collision.robot_shapes import load_shapes
from impact_posture.output.plot.ellipsoid_shapes import Plane, outline
from impact_posture.output.plot.style import ORANGE
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array

NOTE = "Light areas show the collision shapes, each with the hull around it."
_FILL: dict[str, Any] = {"alpha": 0.14, "linewidth": 0.3, "zorder": 1.2}
_HIT: dict[str, Any] = {"facecolor": ORANGE, "edgecolor": ORANGE, "alpha": 0.55, "linewidth": 0.8, "zorder": 1.4}
# Hulls with a smaller sweep radius (m) are drawn with six directions, larger hulls with 24.
_ROUND = 0.01
# Minimum sweep radius in the figure (m), because a point or a line has no outline.
_LEAST = 1e-4


@dataclass(frozen=True, eq=False)
class PlacedHull:
    """Swept hull in world coordinates: vertices, shape (k, 3), sweep radius, m, and whether it is in collision."""

    vertices: Array
    radius: float
    hit: bool


class _Silhouette(PathPatch):
    """Patch with two-dimensional coordinates that 3-D axes draw behind everything else."""

    def do_3d_projection(self) -> float:
        """Return an infinite depth: 3-D axes draw the deepest patch first, so all other patches cover this patch."""
        return float("inf")


def place_hulls(robot: Robot, data: pin.Data, collisions: Iterable[tuple[str, str]] = ()) -> tuple[PlacedHull, ...]:
    """Place the hulls of a robot at the joint placements in ``data``.

    ``collisions`` are pairs of names of colliding shapes or bodies.  Unknown names are ignored.
    """
    shapes = load_shapes(robot)
    links = {name.partition("[")[0] for pair in collisions for name in pair}
    joints = {robot.model.frames[robot.frame_id(link)].parentJoint for link in links if robot.model.existFrame(link)}
    # The hull of a link may be merged into the hull of another link on the same joint.
    alone = {body.joint for body in shapes.bodies if body.link in links}
    return tuple(
        PlacedHull(
            body.vertices @ data.oMi[body.joint].rotation.T + data.oMi[body.joint].translation,
            body.radius,
            body.link in links or (body.joint in joints and body.joint not in alone),
        )
        for body in shapes.bodies
    )


def draw_silhouettes(axes: Any, hulls: Iterable[PlacedHull], color: str, plane: Plane | None) -> None:
    """Draw the outlines of hulls, projected onto ``plane``, or in 3-D if ``plane`` is ``None``."""
    if plane is None:
        across, up, project = _view(axes)
    else:
        (across, up), project = plane.axes, lambda points: points @ plane.axes.T
    screen = np.array([across, up])
    for hit, look in ((False, {"facecolor": color, "edgecolor": color} | _FILL), (True, _HIT)):
        rings = [
            outline(project((hull.vertices[:, None] + _circle(hull.radius) @ screen).reshape(-1, 3)).T).T
            for hull in hulls
            if hull.hit is hit
        ]
        if rings:
            # One path contains all outlines, because separate patches would be darker where they overlap.
            patch = _Silhouette(Path.make_compound_path(*[Path(ring, closed=True) for ring in rings]), **look)
            # Exclude the path from the layout, because measuring it is slow and the limits of the panel are known.
            patch.set_in_layout(False)
            axes.add_artist(patch)


def _circle(radius: float) -> Array:
    angles = np.linspace(0, 2 * np.pi, 6 if radius < _ROUND else 24, endpoint=False)
    return max(radius, _LEAST) * np.array([np.cos(angles), np.sin(angles)]).T


def _view(axes: Any) -> tuple[Array, Array, Callable[[Array], Array]]:
    """Return the world directions to the right and up in 3-D axes, and the function that projects world points."""
    azimuth, elevation = np.radians([axes.azim, axes.elev])
    across = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    toward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    matrix = axes.get_proj()

    def project(points: Array) -> Array:
        return np.array(proj3d.proj_transform(*points.T, matrix)[:2]).T

    return across, np.cross(toward, across), project


def silhouette_handles(hulls: Sequence[PlacedHull], color: str) -> list[Any]:
    """Return the legend entries for shapes and for shapes in collision."""
    handles = [Patch(label="shapes", facecolor=color, edgecolor=color, **_FILL)] if hulls else []
    return [*handles, *([Patch(label="in collision", **_HIT)] if any(hull.hit for hull in hulls) else [])]
