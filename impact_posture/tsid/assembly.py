"""Assembly of the QP of a tick from a formulation and a state."""

from __future__ import annotations

import numpy as np

from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array, null_space
from impact_posture.tsid.actuators import Actuators
from impact_posture.tsid.limits.acceleration_bounds import AccelerationBounds
from impact_posture.tsid.qp.level_rank import LevelRank
from impact_posture.tsid.qp.quadratic_program import EQUALITY, QP, stacked_rows
from impact_posture.tsid.state import State
from impact_posture.tsid.support_contact import ContactStack
from impact_posture.tsid.task_formulation import TaskFormulation
from impact_posture.tsid.tasks.task import TaskStack

# Least weight of each acceleration in the cost, so that the minimum is unique.
_IDLE = 1e-8
# Weight of a squared moment, (N·m)², relative to a squared force, N².
_MOMENT = 100.0
# The tasks leave a direction of motion free if its singular value is below this fraction of the largest one.
_REDUNDANT = 1e-6


class Assembly:
    """QP of a formulation, in buffers that each tick fills again.

    The variables are ``z = [ν̇; w; f]``: the accelerations, the thrusts ``w`` in the null space of redundant rotors,
    and the contact forces in world axes.  Controls are not variables, because ``u`` follows from
    ``p = Mν̇ + h − Jᵀf − J_eᵀF̂`` (:class:`Actuators`).  The QP has these rows, in this order:

    - ``blind``: ``blindᵀ p_base = 0``, the unactuated part of the dynamics;
    - ``contacts``: ``J ν̇ = a`` of the hard contacts;
    - ``levels``: ``J ν̇ = a`` of each strict level;
    - ``controls``: ``u_min ≤ u(z) ≤ u_max``;
    - ``cones``: friction cones;
    - ``limits``: limits of expected impacts (``TaskFormulation.row_limits``).

    The bounds on ``ν̇`` keep the joints within their limits (:class:`AccelerationBounds`).

    Attributes:
        qp: The QP of the last :meth:`build_qp`.
        rank: Finds dependent rows of the strict levels, and contains the QP without them.
        levels: Names and rows of the strict levels, the most important first.  If there are hard contacts, the first
            entry is ``contacts``.
        limits: Indices of the entries of ``[z; A z]`` with bounds from joint limits or from limits of expected
            impacts.
        names: Name of each entry of ``[z; A z]``.
    """

    def __init__(self, robot: Robot, formulation: TaskFormulation, actuators: Actuators) -> None:
        self.formulation, self.actuators = formulation, actuators
        nv = self._nv = robot.nv
        self.contacts = ContactStack(robot, formulation.contacts)
        strict = [task for level in formulation.levels for task in level]
        self._hard_rows, self._soft = np.flatnonzero(self.contacts.hard), np.flatnonzero(~self.contacts.hard)
        widths = (actuators.blind.shape[1], self._hard_rows.size, sum(task.size for task in strict))
        (blind, hard, levels, controls, cones, *self._row_limits), m = stacked_rows(
            (*widths, actuators.controls, self.contacts.cone.shape[0], *(r.size for r in formulation.row_limits))
        )
        spare, forces = actuators.spare.shape[1], self.contacts.size
        (_, self._w, self._f), n = stacked_rows((nv, spare, forces))
        self.qp = qp = QP.empty(n, m)
        self.strict = TaskStack(strict, nv, qp.A[levels, :nv])
        self.weighted = TaskStack(formulation.weighted, nv)
        law = formulation.law
        self.bounds = None if law is None else AccelerationBounds(robot, law, qp.lower[:nv], qp.upper[:nv])
        self._place_rows(blind, hard, levels, controls, cones)
        self._place_cost(robot)
        self.levels = self._name_levels(hard, levels)
        self.limits = np.concatenate([np.arange(nv), np.arange(qp.n + cones.stop, qp.n + m)])
        # The unit of forces is the mass of the robot times 1 m/s².  With the unit 1 N, a least-squares relaxation
        # would lift the robot to reduce the contact forces.
        units = np.ones(qp.n)
        units[self._f] = robot.mass
        self.rank = LevelRank(qp, blind.stop, [rows for _, rows in self.levels], nv, units)
        self.names = (
            *robot.tangent_names,
            *(f"spare {k}" for k in range(spare)),
            *(f"force {k}" for k in range(forces)),
            *(f"dynamics {k}" for k in range(blind.stop)),
            *(f"contact motion {k}" for k in range(hard.stop - hard.start)),
            *(f"{t.name}[{k}]" for t in strict for k in range(t.size)),
            *actuators.names,
            *(
                f"cone of {c.point.frame}[{k}]"
                for c, rows in zip(self.contacts.contacts, self.contacts.cone_rows, strict=True)
                for k in range(rows.stop - rows.start)
            ),
            *(f"{limit.name}[{k}]" for limit in formulation.row_limits for k in range(limit.size)),
        )
        self._free = np.zeros(nv)

    def reset(self, state: State) -> None:
        """Read gains and weights again, and set the targets of the contacts to their present poses."""
        self.strict.refresh(state)
        self.weighted.refresh(state)
        self.contacts.reset(state)
        self.qp.A[self._cones, self._f] = self.contacts.cone
        self.qp.lower[self._at(self._cones)] = self.contacts.least
        count, posture = self.weighted.size, self.formulation.posture
        self._root[:count, 0] = np.sqrt(self.weighted.weight)
        self._root[count:, 0] = np.sqrt(self.contacts.weight[self._soft])
        self._posture_weight[:] = 0.0 if posture is None else posture.weight
        self._added = np.maximum(self._posture_weight, _IDLE)
        self._H[:] = 0.0
        self._diagonal[:] = self._added
        self.rank.reset()

    def build_qp(self, state: State) -> QP:
        """Compute the QP at ``state`` in the existing buffers.  Each call returns the same object."""
        self.strict.update(state)
        self.weighted.update(state)
        self.contacts.update(state)
        if self.bounds is not None:
            self.bounds.update(state)
        for limit, rows in zip(self.formulation.row_limits, self._row_limits, strict=True):
            at = self._at(rows)
            self.qp.A[rows, : self._nv], self.qp.lower[at], self.qp.upper[at] = limit.rows(state)
        self._fill_dynamics(state)
        self._fill_cost(state)
        self.rank.update()
        return self.qp

    def acceleration(self, z: Array) -> Array:
        """Return ``ν̇``, shape (nv,)."""
        return z[: self._nv]

    def forces(self, z: Array) -> Array:
        """Return the contact forces in world axes, in the order of the contacts."""
        return z[self._f]

    def generalized_force(self, state: State, z: Array) -> Array:
        """Return ``p = Mν̇ + h − Jᵀf − J_eᵀF̂``, the force that the actuators must produce, shape (nv,)."""
        force = state.M @ z[: self._nv]
        force += self._free
        if self.contacts.size:
            force -= self.contacts.J.T @ z[self._f]
        return np.asarray(force)

    def controls(self, state: State, z: Array) -> Array:
        """Return the controls ``u`` in a new array: rotor thrusts (N), then joint torques (N·m).

        The rows of the control limits give the same values as ``actuators.solve(generalized_force(state, z), w)``.
        """
        u = self._A_controls @ z
        u += self._known
        return np.asarray(u)

    def redundancy(self, state: State) -> Array:
        """Return an orthonormal basis of the accelerations that only the posture task determines, shape (nv, r).

        If the weighted tasks leave no acceleration free, the method ignores the weighted tasks.
        """
        rows = [self.contacts.J, self.strict.J, self.weighted.J]
        Z = null_space(np.vstack(rows), _REDUNDANT)
        return np.ascontiguousarray(Z if Z.shape[1] else null_space(np.vstack(rows[:2]), _REDUNDANT))

    def _at(self, rows: slice) -> slice:
        """Return the slice of ``qp.lower`` and ``qp.upper`` that belongs to rows of ``A``."""
        return slice(self.qp.n + rows.start, self.qp.n + rows.stop)

    def _equate(self, rows: slice, value: Array) -> None:
        at = self._at(rows)
        self.qp.lower[at] = value
        self.qp.upper[at] = value

    def _place_rows(self, blind: slice, hard: slice, levels: slice, controls: slice, cones: slice) -> None:
        qp, nv, actuators = self.qp, self._nv, self.actuators
        self._blind, self._hard, self._levels, self._controls, self._cones = blind, hard, levels, controls, cones
        for rows in (blind, hard, levels):
            qp.sense[self._at(rows)] = EQUALITY
        thrusts = slice(controls.start, controls.start + actuators.rotors)
        torques = slice(thrusts.stop, controls.stop)
        qp.A[thrusts, self._w] = actuators.spare
        self._A_hard, self._A_controls = qp.A[hard, :nv], qp.A[controls]
        self._free_blind, self._known = np.zeros(actuators.blind.shape[1]), np.zeros(actuators.controls)
        # Each tuple describes rows of A that the dynamics determine: rows, buffer for constants, entries of a
        # generalized force, and the matrix that maps these entries to the rows (``None`` for the identity).
        base, joints = slice(actuators.base), slice(actuators.base, nv)
        parts: list[tuple[slice, Array, slice, Array | None]] = [
            (blind, self._free_blind, base, np.ascontiguousarray(actuators.blind.T) if actuators.rotors else None),
            (thrusts, self._known[: actuators.rotors], base, actuators.inverse),
            (torques, self._known[actuators.rotors :], joints, None),
        ]
        self._dynamics = [
            (qp.A[rows, :nv], qp.A[rows, self._f], known, part, turn)
            for rows, known, part, turn in parts
            if known.size
        ]

    def _place_cost(self, robot: Robot) -> None:
        nv, contacts = self._nv, self.contacts
        rows = self.weighted.size + self._soft.size
        self._C, self._Cw = np.zeros((rows, nv)), np.zeros((rows, nv))
        self._root, self._wanted = np.zeros((rows, 1)), np.zeros(rows)
        diagonal = self.qp.H.reshape(-1)[:: self.qp.n + 1]
        self._diagonal = diagonal[:nv]
        diagonal[self._w] = self.formulation.spare_weight
        units = [weight for c in contacts.contacts for weight in ([1.0] * 3 + [_MOMENT] * 3)[: c.size]]
        diagonal[self._f] = self.formulation.force_weight * np.array(units)
        self._H, self._g = self.qp.H[:nv, :nv], self.qp.g[:nv]
        self._posture_weight = np.zeros(nv)

    def _name_levels(self, hard: slice, levels: slice) -> tuple[tuple[str, slice], ...]:
        (_, *rows), _ = stacked_rows(
            (levels.start, *(sum(t.size for t in tasks) for tasks in self.formulation.levels))
        )
        named = (", ".join(task.name for task in tasks) for tasks in self.formulation.levels)
        contacts = [("contacts", hard)] if hard.stop > hard.start else []
        return (*contacts, *zip(named, rows, strict=True))

    def _fill_dynamics(self, state: State) -> None:
        qp, actuators, J, M, free = self.qp, self.actuators, self.contacts.J, state.M, self._free
        free[:] = state.h
        if self.formulation.force_point is not None and state.pushed:
            free -= state.force @ state.at(self.formulation.force_point).jacobian
        for A, A_f, known, part, turn in self._dynamics:
            if turn is None:
                A[:], known[:] = M[part], free[part]
            else:
                np.matmul(turn, M[part], out=A)
                np.matmul(turn, free[part], out=known)
            if J.size:
                np.negative(J[:, part].T if turn is None else turn @ J[:, part].T, out=A_f)
        if self._free_blind.size:
            self._equate(self._blind, -self._free_blind)
        at = self._at(self._controls)
        np.subtract(actuators.lower, self._known, out=qp.lower[at])
        np.subtract(actuators.upper, self._known, out=qp.upper[at])
        if self._hard_rows.size:
            self._A_hard[:] = J[self._hard_rows]
            self._equate(self._hard, self.contacts.a[self._hard_rows])
        if self.strict.size:
            self._equate(self._levels, self.strict.a)

    def _fill_cost(self, state: State) -> None:
        g, count, posture = self._g, self.weighted.size, self.formulation.posture
        if self._C.shape[0]:
            C, wanted = self._C, self._wanted
            C[:count], wanted[:count] = self.weighted.J, self.weighted.a
            if self._soft.size:
                C[count:], wanted[count:] = self.contacts.J[self._soft], self.contacts.a[self._soft]
            np.multiply(C, self._root, out=self._Cw)
            wanted *= self._root[:, 0]
            np.matmul(self._Cw.T, self._Cw, out=self._H)
            self._diagonal += self._added
            np.matmul(wanted, self._Cw, out=g)
            np.negative(g, out=g)
        else:
            g[:] = 0.0
        if posture is not None:
            g -= self._posture_weight * posture.desired(state)
