"""Coordinates that an optimizer can move in, and the manifold's retraction as expressions."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.dynamics.joints import JointKind, joint_kind
from impact_posture.dynamics.spatial import quaternion_matrix, quaternion_product

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class JointSlot:
    """Where one joint sits in ``q``, ``v`` and the chart ``x``."""

    index: int
    name: str
    kind: JointKind
    q: slice
    v: slice
    x: slice


class Chart:
    """Chart ``x`` of the configuration space: as ``q``, but every continuous or planar rotation is one angle.

    Quaternions stay four numbers; :meth:`norms` gives the unit-norm equations that go with them.  So ``q(x)`` and all
    that is built on it is smooth, has no singular chart point, and costs nothing.
    """

    def __init__(self, model: pin.Model) -> None:
        self.slots: list[JointSlot] = []
        start = 0
        for i in range(1, model.njoints):
            kind = joint_kind(model.joints[i], str(model.names[i]))
            width = {"continuous": 1, "planar": 3}.get(kind.family, kind.nq)
            q0, v0 = int(model.idx_qs[i]), int(model.idx_vs[i])
            self.slots.append(
                JointSlot(
                    i,
                    str(model.names[i]),
                    kind,
                    slice(q0, q0 + kind.nq),
                    slice(v0, v0 + kind.nv),
                    slice(start, start + width),
                )
            )
            start += width
        self.nx = start
        self.nq, self.nv = int(model.nq), int(model.nv)
        self._model = model

    def configuration(self, x: ca.SX) -> ca.SX:
        """``q(x)``, shape (nq, 1)."""
        parts = []
        for slot in self.slots:
            piece = x[slot.x]
            if slot.kind.family == "continuous":
                piece = ca.vertcat(ca.cos(piece), ca.sin(piece))
            elif slot.kind.family == "planar":
                piece = ca.vertcat(piece[:2], ca.cos(piece[2]), ca.sin(piece[2]))
            parts.append(piece)
        return ca.vertcat(*parts)

    def quaternion_slices(self) -> list[slice]:
        """Where ``x`` holds quaternions (x y z w)."""
        found = []
        for slot in self.slots:
            if slot.kind.family in ("free-flyer", "spherical"):
                found.append(slice(slot.x.stop - 4, slot.x.stop))
        return found

    def norms(self, x: ca.SX) -> ca.SX:
        """``|quaternion|² − 1`` for each quaternion in ``x``."""
        return ca.vertcat(ca.SX(0, 1), *[ca.sumsqr(x[s]) - 1 for s in self.quaternion_slices()])

    def to_x(self, q: Vector) -> Vector:
        """Chart coordinates of a configuration."""
        x = np.zeros(self.nx)
        for slot in self.slots:
            piece = q[slot.q]
            if slot.kind.family == "continuous":
                x[slot.x] = np.arctan2(piece[1], piece[0])
            elif slot.kind.family == "planar":
                x[slot.x] = piece[0], piece[1], np.arctan2(piece[3], piece[2])
            else:
                x[slot.x] = piece
        return x

    def to_q(self, x: Vector) -> Vector:
        """Configuration of chart coordinates, quaternions normalized."""
        q = np.zeros(self.nq)
        for slot in self.slots:
            piece = x[slot.x]
            if slot.kind.family == "continuous":
                q[slot.q] = np.cos(piece[0]), np.sin(piece[0])
            elif slot.kind.family == "planar":
                q[slot.q] = piece[0], piece[1], np.cos(piece[2]), np.sin(piece[2])
            else:
                q[slot.q] = piece
        return np.asarray(pin.normalize(self._model, q))

    def bounds(self) -> tuple[Vector, Vector]:
        """Position limits in chart coordinates, infinite where there are none."""
        lower, upper = np.full(self.nx, -np.inf), np.full(self.nx, np.inf)
        for slot in self.slots:
            if slot.kind.family in ("revolute", "prismatic", "translation"):
                low = np.array(self._model.lowerPositionLimit[slot.q])
                high = np.array(self._model.upperPositionLimit[slot.q])
                # Pinocchio writes "no limit" as the largest double.
                lower[slot.x] = np.where(low < -1e10, -np.inf, low)
                upper[slot.x] = np.where(high > 1e10, np.inf, high)
        return lower, upper


def tangent_map(chart: Chart, q: ca.SX) -> ca.SX:
    """``∂(q ⊕ v)/∂v`` at ``v = 0``, shape (nq, nv): turns ``∂/∂q`` into the tangent gradient."""
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
    """``½ quaternion ⊗ [w; 0]`` as a (4, 3) matrix acting on the body angular velocity ``w``."""
    x, y, z, w = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    return 0.5 * ca.blockcat([[w, -z, y], [z, w, -x], [-y, x, w], [-x, -y, -z]])


def integrate(chart: Chart, q: ca.SX, v: ca.SX) -> ca.SX:
    """``q ⊕ v``: Pinocchio's ``integrate`` as an expression, smooth at ``v = 0``."""
    parts = []
    for slot in chart.slots:
        piece, step, family = q[slot.q], v[slot.v], slot.kind.family
        if family == "free-flyer":
            R = quaternion_matrix(piece[3:])
            translation, rotation = _exp6(step[:3], step[3:])
            parts += [piece[:3] + R @ translation, quaternion_product(piece[3:], rotation)]
        elif family == "spherical":
            parts.append(quaternion_product(piece, _exp_quaternion(step)))
        elif family == "continuous":
            c, s = ca.cos(step[0]), ca.sin(step[0])
            parts.append(ca.vertcat(piece[0] * c - piece[1] * s, piece[1] * c + piece[0] * s))
        elif family == "planar":
            parts.append(_integrate_planar(piece, step))
        else:
            parts.append(piece + step)
    return ca.vertcat(*parts)


# Below this squared angle the series' next term is under 1e-17.
_SMALL = 1e-4


def _coefficients(t: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
    """``sin(θ/2)/θ, cos(θ/2), (1−cos θ)/θ², (θ−sin θ)/θ³`` of ``t = θ²``, by series near zero."""
    safe = ca.if_else(t < _SMALL, 1.0, t)
    theta = ca.sqrt(safe)
    return (
        ca.if_else(t < _SMALL, 0.5 - t / 48 + t**2 / 3840 - t**3 / 645120, ca.sin(theta / 2) / theta),
        ca.if_else(t < _SMALL, 1 - t / 8 + t**2 / 384 - t**3 / 46080, ca.cos(theta / 2)),
        ca.if_else(t < _SMALL, 0.5 - t / 24 + t**2 / 720 - t**3 / 40320, (1 - ca.cos(theta)) / safe),
        ca.if_else(
            t < _SMALL, 1 / 6 - t / 120 + t**2 / 5040 - t**3 / 362880, (theta - ca.sin(theta)) / (safe * theta)
        ),
    )


def _exp_quaternion(w: ca.SX) -> ca.SX:
    half_sine, half_cosine, _, _ = _coefficients(ca.sumsqr(w))
    return ca.vertcat(half_sine * w, half_cosine)


def _exp6(v: ca.SX, w: ca.SX) -> tuple[ca.SX, ca.SX]:
    _, _, b, c = _coefficients(ca.sumsqr(w))
    wv = ca.cross(w, v)
    return v + b * wv + c * ca.cross(w, wv), _exp_quaternion(w)


def _integrate_planar(q: ca.SX, v: ca.SX) -> ca.SX:
    angle = v[2]
    _, _, b, c = _coefficients(angle**2)
    # exp on SE(2): [sin w / w, -(1 - cos w)/w; (1 - cos w)/w, sin w / w] v
    sine_over = 1 - c * angle**2
    versine_over = b * angle
    step = ca.vertcat(sine_over * v[0] - versine_over * v[1], versine_over * v[0] + sine_over * v[1])
    cosine, sine = ca.cos(angle), ca.sin(angle)
    return ca.vertcat(
        q[0] + q[2] * step[0] - q[3] * step[1],
        q[1] + q[3] * step[0] + q[2] * step[1],
        q[2] * cosine - q[3] * sine,
        q[3] * cosine + q[2] * sine,
    )
