"""Triangles of a mesh file with several parts, as coal should have read them.

Where a node of the file holds several parts (one for each material), coal 3.0 appends the corners of all, but numbers
the triangles of each part from the first corner of the node.  A part begins with its corners 0, 1 and 2 and uses all
of its corners, so the places where parts begin can be found, and the find can be checked.
"""

from __future__ import annotations

import numpy as np

from impact_posture.arrays import Array
from impact_posture.collision.parts import Triangles


def renumbered(points: Array, faces: Triangles) -> Triangles | None:
    """Return triangles that use every corner; ``None`` where the parts of the file cannot be told apart.

    Args:
        points: Corners, shape (k, 3).
        faces: Triangles as coal numbers them, shape (n, 3).
    """
    corners = np.arange(len(points))
    candidates = (faces, _shifted(faces, False), _shifted(faces, True))
    return next((found for found in candidates if np.array_equal(np.unique(found), corners)), None)


def _shifted(faces: Triangles, across: bool) -> Triangles:
    """Return the triangles with each part numbered after the last.

    A part begins where the first corners of its node come again; ``across`` nodes, also where those of the next do.
    """
    starts, shifts, begin = [0], [0], 0
    for k in np.flatnonzero((np.diff(faces, axis=1) == 1).all(axis=1))[1:]:
        first = int(faces[starts[-1], 0])
        end = begin + int(faces[starts[-1] : k].max()) + 1 - first
        if faces[k, 0] == first or (across and faces[k, 0] == end):
            starts.append(int(k))
            shifts.append(end - int(faces[k, 0]))
            begin = end
    return np.asarray(faces + np.repeat(shifts, np.diff([*starts, len(faces)]))[:, None])
