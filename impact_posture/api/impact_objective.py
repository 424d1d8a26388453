"""Objective class ``ip.ImpactObjective``; the robot provides defaults for missing arguments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from impact_posture.config.checked import checked
from impact_posture.config.demand import Factors, HalfAngle, NonNegative
from impact_posture.config.problem_settings import (
    RESTITUTION,
    SPEED,
    ContactPoint,
    ImpactSettings,
    JointModel,
    MetricKind,
    ObjectiveKind,
)
from impact_posture.errors import InputError
from impact_posture.impact.contact_point import at_front
from impact_posture.impact.evaluation.evaluation import Evaluation, evaluate
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.metric import Metric, build_metric, check_weights
from impact_posture.impact.resolved_impact import choose_objective, missing_support
from impact_posture.impact.support_compliance import check_compliance
from impact_posture.impact.supports import refuse_held, refuse_rigid, resolve_supports
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.joint_model import with_joint_model
from impact_posture.robot.model_variant import ModelVariant, Payload, build_model_variants
from impact_posture.robot.posture_files import read_posture
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import Support
from impact_posture.system.arrays import Array

# The C export is imported inside functions, because the import takes longer than solving a small problem.
if TYPE_CHECKING:
    from impact_posture.codegen.export import Export


@checked
class ImpactObjective(WorstCaseObjective):
    """Objective of one impact, or of several simultaneous impacts, of a robot.

    Args:
        robot: The robot.
        contact: Contact of the impact, or several simultaneous contacts.  A contact without an offset gets the
            offset that robot.toml has for its frame.
        metric: Norm of the velocity jump: ``euclidean``, ``kinetic`` or ``weighted``, or a
            :class:`~impact_posture.impact.metric.Metric`.
        kind: Minimized quantity: ``impulse`` (λ̄²H), ``speed`` (V), ``sticking`` (S), ``coulomb`` (C), ``energy`` (E)
            or ``effective-mass`` (m).  λ̄ is the largest impulse of the contact, and ``docs/notation.md`` defines the
            other symbols.  ``None`` selects ``impulse``.  If the contact states its friction, or the
            :class:`PostureProblem` the speed or the elasticity, ``None`` instead selects the quantity that
            ``--objective auto`` selects on the command line.
        supports: Feet that stay in place during the impact, as ``FRAME[:point|surface]``; ``None`` selects the feet
            of robot.toml, ``()`` selects no feet.
        compliance: Compliance ε of the supports, 1/kg; 0 selects 1e-4 divided by the mass of the robot.
        normal_cone_deg: Half angle of the cone of possible normals, degrees.  The objective is the worst value over
            the cone.
        others: Further contacts that act at the same time as ``contact``.
        bilateral: Whether several contacts can pull as well as push.
        model_variants: Robot models, the nominal model first.  The objective is the worst value over the models.
        weights: Weights of the weighted metric: nv numbers, a TOML file, or ``velocity-limits``.
        armature_range: Lowest and highest factor on the armature.  If ``model_variants`` is empty, variants are built
            from this range and from ``payloads``.
        payloads: Payloads as pairs of frame and mass, kg.  The robot carries at most one payload at a time.
        contact_point: ``front`` moves each contact point to the foremost point, along −n, of the links that move with
            the contact frame.
        posture: Posture at which ``front`` determines the contact point: a name, a file or a configuration; ``None``
            selects the default posture.
        joint_model: Model of the inertia at the joints: ``reflected``, ``link`` or ``locked``
            (:func:`~impact_posture.robot.joint_model.with_joint_model`); ``None`` selects the model of the robot.

    Raises:
        ImpactPostureError: An argument is not valid for this robot.
    """

    def __init__(
        self,
        robot: Robot,
        contact: ImpactContact | Sequence[ImpactContact],
        metric: MetricKind | Metric = "euclidean",
        kind: ObjectiveKind | None = None,
        supports: Sequence[str | Support] | None = None,
        compliance: NonNegative = 0.0,
        normal_cone_deg: HalfAngle = 0.0,
        others: Sequence[ImpactContact] = (),
        bilateral: bool = False,
        model_variants: Sequence[ModelVariant] = (),
        *,
        weights: str | Sequence[float] | None = None,
        armature_range: Factors | None = None,
        payloads: Sequence[tuple[str, float]] = (),
        contact_point: ContactPoint = "frame",
        posture: str | Array | Sequence[float] | None = None,
        joint_model: JointModel | None = None,
    ) -> None:
        robot = with_joint_model(robot, joint_model or robot.joint_model)
        contacts = [contact] if isinstance(contact, ImpactContact) else list(contact)
        if not contacts:
            raise InputError("names no contact", where="contact", hint="give an ImpactContact")
        leading, *more = (_with_offset(robot, each) for each in (*contacts, *others))
        if contact_point == "front":
            q = read_posture(robot, posture)
            leading, *more = (at_front(robot, each, q, robot.held) for each in (leading, *more))
        feet = _supports(robot, supports)
        for each in (leading, *more):
            refuse_held(robot, each, feet)
        refuse_rigid(robot, feet)
        if not isinstance(metric, Metric):
            values = weights if weights is None or isinstance(weights, str) else tuple(weights)
            metric = build_metric(robot, metric, values)
        check_weights(robot, metric.weights)
        if compliance:
            check_compliance(robot, compliance)
        loads = [Payload(*payload) for payload in payloads]
        variants = tuple(model_variants) or build_model_variants(robot, armature_range, loads)
        settings = ImpactSettings(
            robot=robot.source, objective=kind, friction=leading.friction, normal_cone=normal_cone_deg
        )
        chosen, _ = choose_objective(settings, several=bool(more))
        super().__init__(
            robot, leading, metric, chosen, feet, compliance, normal_cone_deg, tuple(more), bilateral, variants
        )
        # A PostureProblem may state a speed, and then chooses the objective type again from the given ``kind``.
        object.__setattr__(self, "_stated_kind", kind)
        # A missing support is not an error, because an impact can be evaluated without supports.
        object.__setattr__(self, "_missing", missing_support(robot) if supports is None and not feet else "")

    @checked
    def evaluate(self, q: ArrayLike, speed: float = SPEED, restitution: float = RESTITUTION) -> Evaluation:
        """Compute H, G, V, S, E, the impact ellipsoid and the predicted velocity jump at ``q``."""
        return evaluate(self, self.robot.check_posture(np.asarray(q, dtype=float), limits=False), speed, restitution)

    @checked
    def value_and_gradient(self, q: ArrayLike) -> tuple[float, Array]:
        """Return this objective and its tangent gradient at ``q``, as :meth:`ImpactGradient.objective` does.

        The gradient has shape (nv,): entry i is the derivative along ``ν_i``.  For a floating base, the first six
        entries belong to the linear and angular velocity of the base in base axes, and not to entries of ``q``.

        Raises:
            PostureError: ``q`` has the wrong shape, is not finite, or has a quaternion of zero norm.
            MetricError: The objective does not exist at ``q``.
        """
        at = self.robot.check_posture(np.asarray(q, dtype=float), limits=False)
        return self.value(at), self.gradient(at)

    @checked
    def export(self, out: str | Path, *, build: bool = True, **options: Any) -> Export:
        """Write C code for H, its gradient and this objective into a folder, and compile the code to a library.

        If the folder already contains this code, the code is not written again.

        Args:
            out: The folder.
            build: Whether to compile the code and check the library, if a C compiler is installed.
            options: Options of :func:`write_export`: ``prefix``, ``posture``, ``single``, ``portable``, ``cuda`` and
                ``force``.
        """
        from impact_posture.codegen.existing_export import existing_export
        from impact_posture.codegen.export import write_export

        kept = None if options else existing_export(self, Path(out), build=build)
        return kept or write_export([self], Path(out), build=build, **options)


def _with_offset(robot: Robot, contact: ImpactContact) -> ImpactContact:
    default = robot.spec.contact.offset_of(contact.frame)
    return replace(contact, offset=default) if any(default) and not any(contact.offset) else contact


def _supports(robot: Robot, supports: Sequence[str | Support] | None) -> tuple[Support, ...]:
    if supports is None:
        return resolve_supports(robot, None)
    texts = tuple(support for support in supports if isinstance(support, str))
    return (*resolve_supports(robot, texts), *(support for support in supports if isinstance(support, Support)))
