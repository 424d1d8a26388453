"""Tangent map of the configuration manifold as a CasADi expression, for derivatives on the tangent space."""

from __future__ import annotations

import casadi as ca

from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.spatial import force_to_parent, quaternion_matrix
from impact_posture.dynamics.tree import Tree


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
    """Return the map ``w ↦ ½ quaternion ⊗ [w; 0]`` as a (4, 3) matrix, where w is the body angular velocity."""
    x, y, z, w = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    return 0.5 * ca.blockcat([[w, -z, y], [z, w, -x], [-y, x, w], [-x, -y, -z]])


def composite_mass_matrix(tree: Tree) -> ca.SX:
    """Mass matrix ``M(q)`` by composite rigid bodies (Featherstone 2008, §6.2), shape (nv, nv), with armature."""
    composite = dict(tree._inertia)
    M = ca.SX.zeros(tree.nv, tree.nv)
    for slot, i, parent in reversed(tree._joints):
        carried = composite[i] @ tree._S[i]
        M[slot.v, slot.v] = tree._S[i].T @ carried
        j = i
        while tree._parents[j]:
            columns = ca.horzsplit(carried)
            carried = ca.horzcat(*[force_to_parent(tree._R[j], tree._p[j], column) for column in columns])
            j = tree._parents[j]
            other = tree.chart.slots[j - 1]
            M[other.v, slot.v] = tree._S[j].T @ carried
            M[slot.v, other.v] = M[other.v, slot.v].T
        if parent:
            composite[parent] = composite[parent] + tree._inertia_to_parent(i, composite[i])
    return M + ca.diag(tree.armature)
