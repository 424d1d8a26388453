"""The tangent map of the configuration manifold as an expression, to differentiate by CasADi on the tangent space."""

from __future__ import annotations

import casadi as ca

from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.spatial import quaternion_matrix


def tangent_map(chart: Chart, q: ca.SX) -> ca.SX:
    """Return ``∂(q ⊕ v)/∂v`` at ``v = 0``, shape (nq, nv), which turns ``∂/∂q`` into the tangent gradient."""
    blocks = []
    for slot in chart.slots:
        piece, family = q[slot.q], slot.kind.family
        if family == "free-flyer":
            quaternion = piece[3:]
            R = quaternion_matrix(quaternion)
            blocks.append(ca.diagcat(R, _quaternion_rate(quaternion)))
        elif family == "spherical":
            blocks.append(_quaternion_rate(piece))
        elif family == "continuous":
            blocks.append(ca.vertcat(-piece[1], piece[0]))
        elif family == "planar":
            c, s = piece[2], piece[3]
            top = ca.blockcat([[c, -s], [s, c]])
            blocks.append(ca.diagcat(top, ca.vertcat(-s, c)))
        else:
            blocks.append(ca.SX.eye(slot.kind.nv))
    return ca.diagcat(*blocks)


def _quaternion_rate(quaternion: ca.SX) -> ca.SX:
    """Return ``½ quaternion ⊗ [w; 0]`` as a (4, 3) matrix on the body angular velocity ``w``."""
    x, y, z, w = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    return 0.5 * ca.blockcat([[w, -z, y], [z, w, -x], [-y, x, w], [-x, -y, -z]])
