"""Several contacts at once with friction: Coulomb's law at each contact, uncoupled contacts, and MuJoCo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st

from impact_posture.dynamics.mjcf import build_mjcf
from impact_posture.impact.evaluation.coulomb_jump import coulomb_jump, coulomb_jumps
from impact_posture.impact.friction.contact_impulses import contact_impulses
from impact_posture.impact.friction.coulomb_impact import coulomb_impact
from impact_posture.impact.impact_contact import ImpactContact, point_on
from impact_posture.impact.metric import Metric
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.system.optional_package import import_mujoco
from tests.support.helpers import Vector, assert_close, contact_frame, random_configurations, rng, robot, unit

FEET = ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")


def assert_laws(B: Vector, normals: Vector, friction: Vector, p: Vector, tolerance: float) -> None:
    """Check Signorini's and Coulomb's laws at every contact, and check that the impact dissipates energy."""
    before = -normals
    after = before + (B @ p.ravel()).reshape(p.shape)
    scale = float(np.abs(p).max())
    for n, mu, impulse, u in zip(normals, friction, p, after, strict=True):
        normal, tangential = float(n @ impulse), impulse - (n @ impulse) * n
        slip = u - (n @ u) * n
        assert normal >= -tolerance * scale and n @ u >= -tolerance
        assert abs(normal * (n @ u)) <= tolerance * scale
        assert np.linalg.norm(tangential) <= mu * normal + tolerance * scale
        # The friction at a sliding point has its maximum size and opposes the slip.
        assert np.linalg.norm(tangential * np.linalg.norm(slip) + mu * normal * slip) <= tolerance * scale
    assert (p * (before + after)).sum() <= tolerance * scale


@given(st.integers(0, 2**32 - 1), st.integers(1, 4))
def test_the_laws_hold_at_every_contact(seed: int, count: int) -> None:
    generator = np.random.default_rng(seed)
    A = generator.normal(size=(3 * count, 3 * count + 3))
    normals = np.array([unit(generator) for _ in range(count)])
    friction = generator.uniform(0, 1, count)
    B = A @ A.T / (3 * count)
    p = contact_impulses(B, -normals, normals, friction)
    assert p is not None
    assert_laws(B, normals, friction, p, 1e-7)


def test_contacts_that_do_not_feel_each_other_are_single_contacts() -> None:
    generator = rng("apart")
    blocks = [a @ a.T + 0.1 * np.eye(3) for a in generator.normal(size=(3, 3, 3))]
    B = np.zeros((9, 9))
    for i, block in enumerate(blocks):
        B[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = block
    normals = np.array([unit(generator) for _ in range(3)])
    friction = np.array([0.0, 0.2, 5.0])
    together = contact_impulses(B, -normals, normals, friction)
    assert together is not None
    for i, block in enumerate(blocks):
        alone = contact_impulses(block, -normals[i : i + 1], normals[i : i + 1], friction[i : i + 1])
        assert alone is not None
        assert_close(together[i], alone[0], 1e-8, f"contact {i}")


@pytest.mark.parametrize("friction", (0.0, 0.2, 0.6, 3.0))
def test_one_contact_is_the_single_solution(friction: float) -> None:
    for name in ("panda", "tilthex_arm", "talos"):
        loaded = robot(name)
        contact = ImpactContact(contact_frame(loaded), (0.2, -0.4, 0.8), friction=friction)
        objective = WorstCaseObjective(loaded, contact, kind="coulomb")
        for q in random_configurations(loaded.model, 3, name, friction):
            impact, o = coulomb_impact(objective.oracle, q), objective.oracle.quantities(q)
            p = contact_impulses(o.mobility, -o.normal[None, :], o.normal[None, :], np.array([friction]))
            assert p is not None
            assert_close(p[0], impact.impulse, 1e-7, name)
            jump = coulomb_jump(objective, q, 2.0)
            assert jump is not None
            assert_close(jump.velocity, 2 * impact.jump, 1e-12, name)


def feet_of(friction: float) -> tuple[WorstCaseObjective, Vector]:
    """Return the objective of solo12 in the air, whose four feet hit tilted ground, and its posture."""
    loaded = robot("solo12")
    n = np.array([0.35, 0.1, 1.0])
    contacts = [ImpactContact(foot, tuple(n / np.linalg.norm(n)), friction=friction) for foot in FEET]
    objective = WorstCaseObjective(loaded, contacts[0], Metric(), "impulse", (), others=tuple(contacts[1:]))
    return objective, np.array(
        pin.integrate(loaded.model, loaded.posture(), 0.2 * rng("feet").normal(size=loaded.nv))
    )


@pytest.mark.parametrize("friction", (0.0, 0.15, 0.4, 2.0))
def test_four_feet_land_in_mujoco(friction: float) -> None:
    """Only sticking feet get a tight tolerance, because MuJoCo's convex friction model lifts sliding feet."""
    objective, q = feet_of(friction)
    jumps = coulomb_jumps(objective, q, 1.0)
    assert jumps is not None
    velocity = jumps[0].velocity
    oracles = [single.oracle.at(q) for single in objective.singles]
    impulse = np.sum([o.J.T @ jump.impulse for o, jump in zip(oracles, jumps, strict=True)], axis=0)
    assert_close(oracles[0].solve(impulse), velocity, 1e-9, "jump")
    measured = drop(objective, q)
    if friction in (0.0, 2.0):
        # Without slip or without friction, MuJoCo and Coulomb's law agree.
        assert all(jump.sticks for jump in jumps) is (friction == 2.0)
        assert_close(measured, velocity, 0.02, "Δν")
    else:
        assert any(not jump.sticks for jump in jumps)
        ratio = np.linalg.norm(measured) / np.linalg.norm(velocity)
        assert abs(ratio - 1) < 0.2


def drop(objective: WorstCaseObjective, q: Vector) -> Vector:
    """Return ``Δν`` in MuJoCo for a robot that moves along ``−n`` without gravity and motor torques."""
    mujoco, result = import_mujoco(), objective.robot
    written = build_mjcf(result.model)
    n, radius, time = objective.oracle.at(q).n.copy(), 0.005, 2e-4
    option = written.spec.option
    option.gravity, option.timestep, option.integrator = np.zeros(3), time / 50, mujoco.mjtIntegrator.mjINT_EULER
    option.cone, option.iterations, option.tolerance = mujoco.mjtCone.mjCONE_ELLIPTIC, 200, 0.0
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    numeric = objective.oracle.numeric.at(q)
    for k, contact in enumerate(objective.contacts):
        point = point_on(result, contact.frame, contact.offset)
        position = numeric.placement(point).translation
        center = numeric.data.oMi[point.joint].actInv(position + radius * n)
        written.add_geom(point.joint, f"ball_{k}", "sphere", (radius,), pin.SE3(np.eye(3), center))
        written.add_plane(f"ground_{k}", position - 1e-6 * n, n)
        written.spec.add_pair(
            geomname1=f"ground_{k}", geomname2=f"ball_{k}", condim=3 if contact.friction else 1,
            friction=(contact.friction, contact.friction, 0, 0, 0), solimp=(0.9999, 0.9999, 0.001, 0.5, 2),
            solref=(-1 / time**2, -20 / time), solreffriction=(-1 / time**2, -40 / time),
        )  # fmt: skip
    model = written.spec.compile()
    data = mujoco.MjData(model)
    before = np.zeros(result.nv)
    before[:3] = -pin.Quaternion(q[3:7]).matrix().T @ n
    data.qpos[:], data.qvel[:] = written.layout.qpos(q), written.layout.qvel(q, before)
    quiet = 0
    for _ in range(4000):
        mujoco.mj_step(model, data)
        quiet = quiet + 1 if data.ncon == 0 or not np.any(data.efc_force) else 0
        if quiet > 20 and data.time > 2 * time:
            break
    return np.asarray(written.layout.state(data.qpos, data.qvel)[1] - before)


def test_the_conditions_of_the_prediction() -> None:
    objective, q = feet_of(0.3)
    assert coulomb_jumps(replace(objective, bilateral=True), q, 1.0) is None
