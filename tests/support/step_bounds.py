"""Bounds on how much ramps and fades change the desired posture acceleration within a time step."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

import impact_posture as ip
from impact_posture.tsid.state import State
from impact_posture.tsid.tasks.activation import Activation

# Largest slope of the ramp 3x² − 2x³, reached at x = 1/2.
STEEPEST = 1.5


def level_bound(activation: Activation, dt: float) -> float:
    """Return the largest change of the activation level within ``dt`` seconds."""
    return min(1.0, STEEPEST * dt / activation.ramp)


def step_bound(posture: ip.tsid.JointPosture, state: State, dt: float) -> float:
    """Return the largest change of an entry of ``ν̇*`` within ``dt`` that ramps and fades cause (``q``, ν, ∇H fixed).

    The level contributes ``1.5 dt/ramp·(K·reach + K_p|q_des ⊖ q|)``, in addition to the fade of the target posture.
    """
    bound, model = 0.0, posture._model
    if posture._blend < 1:
        step = pin.difference(model, state.q, posture._next) - pin.difference(model, state.q, posture._target)
        bound = float(np.max(posture.kp * np.abs(step))) * STEEPEST * dt / posture._over
    if isinstance(posture, ip.tsid.ImpactRobustPosture):
        released = posture.spring == "release"
        pull = float(np.max(np.abs(posture.kp * posture.error(state)))) if released else 0.0
        bound += level_bound(posture.activation, dt) * (posture.K * posture.reach + pull)
    return bound
