"""Operations at one joint in a sweep over the kinematic tree.

Notation follows Featherstone (2008).  ``S`` is the motion subspace of the joint, shape (6, nv), and ``I`` the
articulated inertia of its link.  ``pivot`` is ``D = SᵀIS + armature``, or ``1/D`` for a joint with one axis.  For
coupled joints at one link, all quantities of their links are stacked, and ``nv`` is 1.
"""

from __future__ import annotations

import casadi as ca

from impact_posture.dynamics.spatial import motion_cross_force, symmetric, template


@template
def pivot(inertia: ca.SX, S: ca.SX, armature: ca.SX) -> ca.SX:
    """Return ``D = SᵀIS + armature``, shape (nv, nv)."""
    return symmetric(S.T @ (inertia @ S) + ca.diag(armature))


@template
def reduce(inertia: ca.SX, S: ca.SX, pivot: ca.SX) -> tuple[ca.SX, ...]:
    """Return ``gain``, the matrix ``D⁻¹SᵀI``, shape (nv, 6), and the inertia ``I − I S D⁻¹SᵀI`` for the parent."""
    U = inertia @ S
    gain = solve(pivot, U.T)
    return gain, symmetric(inertia - U @ gain)


@template
def drive(S: ca.SX, tau: ca.SX, bias: ca.SX, gain: ca.SX) -> tuple[ca.SX, ...]:
    """Return the driving force of a joint, ``τ − Sᵀp``, shape (nv,), and the bias force on its parent, shape (6,)."""
    driving = tau - S.T @ bias
    return driving, bias + gain.T @ driving


@template
def respond(
    before: ca.SX, S: ca.SX, drive: ca.SX, bias: ca.SX, pivot: ca.SX, inertia: ca.SX, gain: ca.SX
) -> tuple[ca.SX, ...]:
    """Return the joint velocity, the velocity of the link after the joint, and the force through the joint.

    ``before`` is the velocity of the link without the motion of the joint, and ``bias`` is its bias force.  ``drive``
    and ``gain`` are results of :func:`drive` and :func:`reduce`.
    """
    rates = solve(pivot, drive) - gain @ before
    velocity = before + S @ rates
    return rates, velocity, inertia @ velocity + bias


@template
def gradient(S: ca.SX, turning: ca.SX, known: ca.SX, *pairs: ca.SX) -> ca.SX:
    """Return ``known − S_ωᵀ turning + Σ Sᵀ(v ×* F)``, shape (nv,); ``pairs`` is ``v₁, F₁, v₂, F₂, …``."""
    row = known - S[3:, :].T @ turning
    for velocity, force in zip(pairs[::2], pairs[1::2], strict=True):
        row = row + S.T @ motion_cross_force(velocity, force)
    return row


def solve(pivot: ca.SX, rhs: ca.SX) -> ca.SX:
    """Return ``D⁻¹ rhs``; for a joint with several axes, by an ``LDLᵀ`` factorization without pivoting."""
    if pivot.is_scalar():
        return pivot * rhs
    D, LT, order = ca.ldl(pivot, False)
    solution: ca.SX = ca.ldl_solve(rhs, D, LT, order)
    return solution
