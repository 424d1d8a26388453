"""Impulses at several simultaneous contacts with Coulomb friction.

Let ``u⁻`` be the velocities of the contact points before the impact, ``B = JM⁻¹Jᵀ``, and ``u = u⁻ + Bp`` the
velocities after the impact.  At each contact, ``0 ≤ p_n ⊥ u_n ≥ 0`` and ``‖p_t‖ ≤ μ p_n``.  A point that slides has
``p_t = −μ p_n u_t/‖u_t‖``.  Pinocchio solves this problem by ADMM (Carpentier, Le Lidec and Montaut, From Compliant
to Rigid Contact Simulation, 2024).
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from impact_posture.system.arrays import Array

# Absolute tolerance of ADMM, after scaling.
_TOLERANCE = 1e-12
# Largest number of iterations of ADMM.
_ITERATIONS = 20_000
# Rules for the penalty of ADMM.  If ADMM does not converge with the first rule, the second rule is used.  ADMM may
# fail to converge if the forces on the corners of a sole are not unique.
_RULES = (pin.ADMMUpdateRule.SPECTRAL, pin.ADMMUpdateRule.OSQP)
# Largest error of impulses that fulfill the conditions, divided by the largest impulse.
_ERROR = 1e-7


def contact_impulses(B: Array, before: Array, normals: Array, friction: Array) -> Array | None:
    """Return the impulses, world axes, shape (m, 3); ``None`` if no impulses fulfill the conditions.

    ``B`` has shape (3m, 3m).  ``before`` contains the velocities ``u⁻``, and ``normals`` the unit normals towards the
    robot, both in world axes with shape (m, 3).  ``friction`` has shape (m,).
    """
    # ADMM needs a symmetric matrix, without rounding errors.
    B = (B + B.T) / 2
    axes = [np.vstack([np.linalg.svd(n[None, :])[2][1:], n]) for n in normals]
    turned = np.zeros_like(B)
    for i, rows in enumerate(axes):
        turned[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = rows
    # The tolerances of ADMM are absolute, so mobility and velocities are scaled to one.
    size, speed = float(np.trace(B)) / len(B), float(np.abs(before).max())
    if not (size > 0 and speed > 0):
        return np.zeros_like(normals) if speed == 0 else None
    for rule in _RULES:
        impulses = _admm(turned @ (B / size) @ turned.T, turned @ (before.ravel() / speed), friction, rule)
        p = np.asarray(turned.T @ impulses).reshape(normals.shape) * speed / size
        u = before + (B @ p.ravel()).reshape(p.shape)
        slip = np.linalg.norm(u - (u * normals).sum(1, keepdims=True) * normals, axis=1)
        # The impulses are the fixed point of this projection onto the friction cones (De Saxcé and Feng, 1998).
        step = p - (u + (friction * slip)[:, None] * normals) / size
        error = np.abs(p - [_on_cone(row, n, mu) for row, n, mu in zip(step, normals, friction, strict=True)]).max()
        if error <= _ERROR * max(float(np.abs(p).max()), speed / size):
            return p
    return None


def _admm(B: Array, before: Array, friction: Array, rule: pin.ADMMUpdateRule) -> Array:
    """Return the stacked impulses in axes whose third axis is the normal of the contact."""
    # The solver reads only the friction of these contacts.  The model ``body`` is required but not used.
    body = pin.Model()
    body.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "body")
    contacts, data = pin.StdVec_ConstraintModel(), pin.StdVec_ConstraintData()
    for mu in friction:
        contact = pin.PointContactConstraintModel(body, 1)
        contact.setFriction(float(mu))
        contacts.append(pin.ConstraintModel(contact))
        data.append(contacts[-1].createData())
    settings, result = pin.ADMMSolverSettings(), pin.ADMMSolverResult()
    settings.admm_update_rule = rule
    settings.max_iterations = _ITERATIONS
    settings.absolute_feasibility_tol = settings.absolute_complementarity_tol = _TOLERANCE
    settings.relative_feasibility_tol = settings.relative_complementarity_tol = _TOLERANCE
    pin.ADMMConstraintSolver().solve(pin.DelassusOperatorDense(B), before, contacts, data, settings, result)
    return np.asarray(result.retrieveConstraintImpulses()).ravel()


def _on_cone(p: Array, n: Array, mu: float) -> Array:
    """Project an impulse onto the friction cone ``‖p_t‖ ≤ μ p_n`` about the normal ``n``."""
    along = float(n @ p)
    across = p - along * n
    size = float(np.linalg.norm(across))
    if size <= mu * along:
        return p
    if mu * size <= -along:
        return np.zeros(3)
    height = (along + mu * size) / (1 + mu**2)
    return np.asarray(height * (n + mu * across / size))
