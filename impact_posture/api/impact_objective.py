"""The objective behind ``ip.ImpactObjective``, with the defaults of the robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from impact_posture.config.checked import checked
from impact_posture.config.demand import Factors, HalfAngle, NonNegative
from impact_posture.config.problem_settings import JointModel, MetricKind, ObjectiveKind
from impact_posture.errors import InputError
from impact_posture.impact.evaluation.evaluation import Evaluation, evaluate
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.metric import Metric, build_metric, check_weights
from impact_posture.impact.resolved_impact import missing_support
from impact_posture.impact.support_compliance import check_compliance
from impact_posture.impact.supports import refuse_held, refuse_rigid, resolve_supports
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.joint_model import with_joint_model
from impact_posture.robot.model_variant import ModelVariant, Payload, build_model_variants
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import Support

# The C export is imported where it is used, because that takes longer than a small problem.
if TYPE_CHECKING:
    from impact_posture.codegen.export import Export


@checked
class ImpactObjective(WorstCaseObjective):
    """The objective of one or several impacts, by default with the supports of the robot.

    Args:
        robot: The robot.
        contact: Contact of the impact, or several contacts that act at once.  A contact without an offset at the
            contact frame of robot.toml takes the offset from there.
        metric: ``euclidean``, ``kinetic`` or ``weighted``, or a :class:`~impact_posture.impact.metric.Metric`.
        kind: ``impulse`` (λ̄²H), ``speed`` (V), ``sticking`` (S), ``coulomb`` (C) or ``energy`` (E).
        supports: Feet that stay, as ``FRAME[:point|surface]``; ``None`` for the feet of robot.toml, ``()`` for none.
        compliance: ε of the supports, 1/kg; 0 for 1e-4 divided by the mass of the robot.
        normal_cone_deg: Half angle of the cone of normals, degrees; the worst normal counts.
        others: More contacts that act at the same time.
        bilateral: Whether several contacts can pull as well as push.
        model_variants: Robot models, the robot as modeled first; the worst model counts.
        weights: Weights of the weighted metric: nv numbers, a TOML file, or ``velocity-limits``.
        armature_range: Lowest and highest factor on the armature; the worst counts.
        payloads: Frame and mass in kg of payloads that the robot may carry, one at a time; the worst counts.
        joint_model: Inertia at the joints: ``reflected``, ``link`` or ``locked``
            (:func:`~impact_posture.robot.joint_model.with_joint_model`); ``None`` for the value of the robot.

    Raises:
        ImpactPostureError: An argument does not fit the robot.
    """

    def __init__(
        self,
        robot: Robot,
        contact: ImpactContact | Sequence[ImpactContact],
        metric: MetricKind | Metric = "euclidean",
        kind: ObjectiveKind = "impulse",
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
        joint_model: JointModel | None = None,
    ) -> None:
        robot = with_joint_model(robot, joint_model or robot.joint_model)
        contacts = [contact] if isinstance(contact, ImpactContact) else list(contact)
        if not contacts:
            raise InputError("names no contact", where="contact", hint="give an ImpactContact")
        leading, *more = (_with_offset(robot, each) for each in (*contacts, *others))
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
        super().__init__(
            robot, leading, metric, kind, feet, compliance, normal_cone_deg, tuple(more), bilateral, variants
        )
        # This is a hint, not an error, because the evaluation of an impact needs no support.
        object.__setattr__(self, "_missing", missing_support(robot) if supports is None and not feet else "")

    @checked
    def evaluate(self, q: ArrayLike, speed: float = 1.0, restitution: float = 0.0) -> Evaluation:
        """Compute H, G, V, S, E, the ellipsoid and the predicted jump at ``q``; see :func:`evaluate`."""
        return evaluate(self, self.robot.check_posture(np.asarray(q, dtype=float), limits=False), speed, restitution)

    @checked
    def export(self, out: str | Path, *, build: bool = True, **options: Any) -> Export:
        """Write the C code of H, its gradient and this objective into a folder, and build its library.

        A folder that holds this code already, such as ``c/`` of a result, is used as it is.

        Args:
            out: The folder.
            build: Whether to build and check the library, if a C compiler is installed.
            options: Options ``prefix``, ``posture``, ``single``, ``portable`` and ``force`` of :func:`write_export`.
        """
        from impact_posture.codegen.existing_export import existing_export
        from impact_posture.codegen.export import write_export

        kept = None if options else existing_export(self, Path(out), build=build)
        return kept or write_export([self], Path(out), build=build, **options)


def _with_offset(robot: Robot, contact: ImpactContact) -> ImpactContact:
    """Return the contact with the offset of robot.toml if it has the frame of robot.toml and no offset."""
    default = robot.spec.contact
    missing = contact.frame == default.frame and not any(contact.offset) and any(default.offset)
    return replace(contact, offset=default.offset) if missing else contact


def _supports(robot: Robot, supports: Sequence[str | Support] | None) -> tuple[Support, ...]:
    if supports is None:
        return resolve_supports(robot, None)
    texts = tuple(support for support in supports if isinstance(support, str))
    return (*resolve_supports(robot, texts), *(support for support in supports if isinstance(support, Support)))
