"""The classes behind ``import impact_posture as ip``: the main job in a few lines of Python.

They use the defaults of the robot, as the command line does, and check their arguments when they are built.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from numpy.typing import ArrayLike

from impact_posture.arrays import Array
from impact_posture.errors import InputError, not_one_of
from impact_posture.impact import objective as core
from impact_posture.impact.contact import ImpactContact, Support
from impact_posture.impact.contact_compression import ContactStiffness
from impact_posture.impact.evaluation import Evaluation, evaluate
from impact_posture.impact.metric import Metric, build_metric
from impact_posture.impact.resolved_impact import ResolvedImpact, missing_support
from impact_posture.impact.supports import refuse_held, refuse_rigid, resolve_supports
from impact_posture.posture.build_problem import build_problem
from impact_posture.posture.certificate import Certificate
from impact_posture.posture.compiled import CompileMode
from impact_posture.posture.global_search import GlobalSearch, SelfMotionMap, check_searchable, search_globally
from impact_posture.posture.null_space_path import null_space_path
from impact_posture.posture.pareto import pareto_front
from impact_posture.posture.problem import PostureProblem as CoreProblem
from impact_posture.posture.problem_settings import Prepared, prepare, requirements
from impact_posture.posture.result import result_document
from impact_posture.posture.robustness import Robustness, compare_variants, solve_robustly
from impact_posture.posture.search import Progress
from impact_posture.posture.solve import PostureSolution
from impact_posture.posture.tradeoff import TradeOff
from impact_posture.result_folder import FORMATS, Finish, Written, write_result
from impact_posture.result_view import result_view
from impact_posture.robot.joint_model import with_joint_model
from impact_posture.robot.model_variant import ModelVariant, Payload, build_model_variants
from impact_posture.robot.postures import read_posture
from impact_posture.robot.robot import Robot
from impact_posture.settings import (
    Against,
    ImpactSettings,
    JointModel,
    MetricKind,
    ObjectiveKind,
    ProblemSettings,
    RobotSettings,
    Search,
)
from impact_posture.tables import validate

# The C export and the pictures are imported where they are used, because that takes longer than a small problem.
if TYPE_CHECKING:
    from impact_posture.codegen.export import Export
    from impact_posture.path.posture_path import PosturePath


class ImpactObjective(core.ImpactObjective):
    """The objective of one or several impacts, by default with the supports of the robot.

    Args:
        robot: The robot.
        contact: Contact of the impact, or several contacts that act at once.  A contact without an offset at the
            contact frame of robot.toml takes the offset from there.
        metric: ``euclidean``, ``kinetic`` or ``weighted``, or a :class:`~impact_posture.impact.metric.Metric`.
        kind: ``impulse`` (λ̄²H), ``speed`` (V), ``sticking`` (S), ``coulomb`` (C) or ``energy`` (E).
        supports: Feet that stay, as ``FRAME[:point|surface]``; ``None`` for those of robot.toml, ``()`` for none.
        compliance: ε of the supports, 1/kg; 0 for 1e-4 over the robot's mass.
        normal_cone_deg: Half angle of the cone of normals whose worst counts, degrees.
        others: More contacts that act at the same time.
        bilateral: Whether several contacts can pull as well as push.
        model_variants: Robot models whose worst counts, the robot as modeled first.
        weights: Weights of the weighted metric: nv numbers, a TOML file, or ``velocity-limits``.
        armature_range: Lowest and highest factor on the armature; the worst counts.
        payloads: Frame and mass in kg of payloads that the robot may carry, one at a time; the worst counts.
        joint_model: Inertia at the joints: ``reflected``, ``link`` or ``locked``
            (:func:`~impact_posture.robot.joint_model.with_joint_model`); ``None`` for that of the robot.

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
        compliance: float = 0.0,
        normal_cone_deg: float = 0.0,
        others: Sequence[ImpactContact] = (),
        bilateral: bool = False,
        model_variants: Sequence[ModelVariant] = (),
        *,
        weights: str | Sequence[float] | None = None,
        armature_range: tuple[float, float] | None = None,
        payloads: Sequence[tuple[str, float]] = (),
        joint_model: JointModel | None = None,
    ) -> None:
        _check_choice("joint_model", joint_model or robot.joint_model, get_args(JointModel))
        _check_choice("kind", kind, get_args(ObjectiveKind))
        robot = with_joint_model(robot, joint_model or robot.joint_model)
        given = [contact] if isinstance(contact, ImpactContact) else list(contact)
        if not given:
            raise InputError("names no contact", where="contact", hint="give an ImpactContact")
        leading, *more = (_at_own_frame(robot, one) for one in (*given, *others))
        feet = _supports(robot, supports)
        for one in (leading, *more):
            refuse_held(robot, one, feet)
        refuse_rigid(robot, feet)
        if not isinstance(metric, Metric):
            values = weights if weights is None or isinstance(weights, str) else tuple(weights)
            metric = build_metric(robot, metric, values)
        loads = [Payload(*payload) for payload in payloads]
        variants = tuple(model_variants) or build_model_variants(robot, armature_range, loads)
        super().__init__(
            robot, leading, metric, kind, feet, compliance, normal_cone_deg, tuple(more), bilateral, variants
        )
        # This is a hint and no error, because evaluating an impact needs no support.
        object.__setattr__(self, "_missing", missing_support(robot) if supports is None and not feet else "")

    def evaluate(self, q: ArrayLike, speed: float = 1.0, restitution: float = 0.0) -> Evaluation:
        """Compute H, G, V, S, E, the ellipsoid and the predicted jump at ``q``; see :func:`evaluate`."""
        return evaluate(self, self.robot.check_posture(np.asarray(q, dtype=float), limits=False), speed, restitution)

    def export(self, out: str | Path, *, build: bool = True, **options: Any) -> Export:
        """Write the C code of H, its gradient and this objective into a folder, and build its library.

        Args:
            out: The folder.
            build: Whether to build and check the library, if a C compiler is installed.
            options: Options ``prefix``, ``posture``, ``single``, ``portable`` and ``force`` of :func:`write_export`.
        """
        from impact_posture.codegen.export import write_export

        return write_export([self], Path(out), build=build, **options)


def _check_choice(name: str, value: object, choices: Sequence[str]) -> None:
    if value not in choices:
        what, hint = not_one_of(value, choices)
        raise InputError(what, where=name, hint=hint)


def _at_own_frame(robot: Robot, contact: ImpactContact) -> ImpactContact:
    own = robot.spec.contact
    if contact.frame != own.frame or any(contact.offset) or not any(own.offset):
        return contact
    return replace(contact, offset=own.offset)


def _supports(robot: Robot, supports: Sequence[str | Support] | None) -> tuple[Support, ...]:
    if supports is None:
        return resolve_supports(robot, None)
    texts = tuple(support for support in supports if isinstance(support, str))
    return (*resolve_supports(robot, texts), *(support for support in supports if isinstance(support, Support)))


# Settings that the objective and its robot hold already.
_OF_THE_OBJECTIVE = {field.name for field in fields(ImpactSettings)} - {"contact_stiffness", "contact_duration"}


class PostureProblem:
    """``min_q objective(q)`` under the constraints of a task; a missing argument comes from the robot.

    Args:
        objective: An :class:`ImpactObjective`, or another implementation of
            :class:`~impact_posture.impact.objective.Objective`.
        posture: Start of the search: a name, a file, or a configuration (nq,); ``None`` for the default posture.
        speed: Approach speed of the predicted jumps, m/s.
        restitution: Coefficient of restitution of the predicted jumps.
        task: Other fields of :class:`~impact_posture.settings.ProblemSettings` about the task, such as
            ``base="level"``, ``target_position=(x, y, z)``, ``keep_contacts=True`` or ``hold=("joint",)``.

    Attributes:
        problem: Constraints and bounds, before any solver sees them.
        prepared: The problem with its settings; ``None`` for an objective that is not that of an impact.

    Raises:
        ImpactPostureError: An argument is wrong.
    """

    def __init__(
        self,
        objective: core.Objective,
        posture: str | ArrayLike | None = None,
        *,
        speed: float = 1.0,
        restitution: float = 0.0,
        **task: Any,
    ) -> None:
        robot = objective.robot
        if posture is None or isinstance(posture, str):
            q, name = read_posture(robot, posture), posture or robot.default_posture
        else:
            q, name = robot.check_posture(np.asarray(posture, dtype=float), where="posture"), "a configuration"
        loaded = robot.settings or RobotSettings(robot=robot.source)
        given = {field.name: getattr(loaded, field.name) for field in fields(RobotSettings)}
        given |= {"speed": speed, "restitution": restitution, "joint_model": robot.joint_model}
        if isinstance(objective, core.ImpactObjective):
            given["friction"] = objective.contact.friction
        for name in _OF_THE_OBJECTIVE & set(task):
            raise InputError(
                "belongs to the objective", where=name, hint="give it to ImpactObjective or ImpactContact"
            )
        settings = validate(ProblemSettings, given | task, "PostureProblem")
        self.prepared: Prepared | None = None
        if isinstance(objective, core.ImpactObjective):
            missing = getattr(objective, "_missing", "")
            contact = ContactStiffness.of(settings.contact_stiffness, settings.contact_duration)
            impact = ResolvedImpact(objective, q, name, speed, restitution, missing, contact)
            self.prepared = prepare(settings, impact)
            self.problem: CoreProblem = self.prepared.problem
        else:
            self.problem = build_problem(robot, objective, q, requirements(settings, objective))

    @classmethod
    def of(cls, prepared: Prepared) -> PostureProblem:
        """Return the problem of settings from a file or a command line."""
        made = cls.__new__(cls)
        made.prepared, made.problem = prepared, prepared.problem
        return made

    def describe(self) -> list[str]:
        """Describe the constraints, one line each."""
        return self.problem.describe()


class PostureResult:
    """An optimized posture with its certificate, which can be saved, drawn and exported.

    Attributes:
        problem: The solved problem.
        solution: Result of the search.
        robustness: Cost and gain of the model variants; ``None`` without model variants.
        tradeoff: The best objective within each distance from the start; ``None`` before :meth:`trade_off`.
        motion: The path from the start to the optimum; ``None`` before :meth:`path`.
        global_search: Finding of the search ``global``; ``None`` without it.
    """

    def __init__(
        self,
        problem: PostureProblem,
        solution: PostureSolution,
        robustness: Robustness | None = None,
        tradeoff: TradeOff | None = None,
        motion: PosturePath | None = None,
        global_search: GlobalSearch | None = None,
    ) -> None:
        self.problem, self.solution, self.robustness = problem, solution, robustness
        self.tradeoff, self.motion, self.global_search = tradeoff, motion, global_search

    def _with(self, **found: Any) -> PostureResult:
        """The same result with more found about it."""
        kept = {key: getattr(self, key) for key in ("tradeoff", "motion", "global_search")}
        return PostureResult(self.problem, self.solution, self.robustness, **kept | found)

    @property
    def q(self) -> Array:
        """The best certified posture, shape (nq,)."""
        return self.solution.q

    @property
    def initial(self) -> Array:
        """The start, moved to the constraints if it did not satisfy them, shape (nq,)."""
        return self.solution.initial

    @property
    def reduction(self) -> float:
        """``1 − objective(q)/objective(initial)``."""
        return self.solution.reduction

    @property
    def certificate(self) -> Certificate:
        """Stationarity, violation and multipliers, recomputed from Pinocchio's numbers."""
        return self.solution.certificate

    @cached_property
    def document(self) -> dict[str, Any]:
        """The content of ``result.json``.

        Raises:
            InputError: The objective is not that of an impact.
        """
        path = None if self.motion is None else self.motion.to_dict()
        extras = self.robustness, self.tradeoff, path, self.global_search
        return result_document(self._prepared, self.solution, *extras)

    @property
    def _mapped(self) -> SelfMotionMap | None:
        return None if self.global_search is None else self.global_search.map

    @property
    def _prepared(self) -> Prepared:
        if self.problem.prepared is None:
            # This raises an error that names the remedy.
            _ = self.problem.problem.impact
            raise AssertionError
        return self.problem.prepared

    def trade_off(
        self,
        points: int = 16,
        against: Against = "distance",
        *,
        compile: CompileMode = "auto",
        progress: Progress | None = None,
    ) -> PostureResult:
        """Return the same result with the best objective within each of ``points`` prices.

        Args:
            points: Number of points.
            against: The price: the ``distance`` from the start, or the peak ``force`` of the impact.
            compile: Whether to compile the program.
            progress: Called with the solves done and planned.

        Raises:
            InputError: The force is asked for, but the elasticity of the contact is not known.
        """
        force = None
        if against == "force":
            impact = self._prepared.impact
            if impact.contact_stiffness is None:
                raise InputError(
                    "force needs the elasticity of the contact",
                    where="tradeoff_against",
                    hint="add `contact_stiffness` (N/m, or a material) or `contact_duration`",
                )
            force = impact.contact_stiffness, impact.speed
        curve = pareto_front(self.solution, points, force=force, compile=compile, progress=progress)
        return self._with(tradeoff=curve)

    def path(self, *, seed: int = 0) -> PostureResult:
        """Return the same result with a path from the start to the optimum, timed within the robot's limits.

        See :func:`~impact_posture.path.posture_path.posture_path`.

        Args:
            seed: Seed of the sampling planner.

        Raises:
            InputError: The package of the extra ``path`` is not installed.
        """
        from impact_posture.path.posture_path import posture_path

        return self._with(motion=posture_path(self.solution, seed=seed))

    def save(
        self,
        out: str | Path,
        *,
        force: bool = False,
        codegen: bool = True,
        formats: Sequence[str] = FORMATS,
        report: bool = True,
        meshes: bool = False,
        jobs: int = 2,
        progress: Progress | None = None,
        finish: Finish | None = None,
    ) -> Written:
        """Write the result folder: result.json, problem.toml, posture.json, pictures and C code; whole or not at all.

        Args:
            out: The folder.
            force: Replace an earlier result.
            codegen: Whether to export, build and check the C code as well.
            formats: Formats of the pictures: ``png``, ``svg``, ``pdf``.
            report: Whether to write ``report.html``, a page with all of it and the robot in 3-D.
            meshes: Whether the page may hold the meshes of the user's own URDF, which it then passes on.
            jobs: Processes that draw and compile side by side.
            progress: Called after each figure, the C code and the report with the numbers done and in all.
            finish: What draws and compiles; :func:`~impact_posture.early_writer.early_writer` by the command line.

        Returns:
            The folder, the export in it, and the reason if its C code could not be built.

        Raises:
            OutputError: The folder exists without ``force``, or cannot be written.
        """
        return write_result(
            self._prepared, self.solution, self.document, Path(out), tradeoff=self.tradeoff, motion=self.motion,
            mapped=self._mapped,
            force=force, codegen=codegen, formats=formats, report=report, meshes=meshes, jobs=jobs,
            progress=progress, finish=finish,
        )  # fmt: skip

    def plot(
        self, out: str | Path, formats: Sequence[str] = FORMATS, only: Sequence[str] | None = None
    ) -> list[Path]:
        """Draw the figures into a folder; return their paths."""
        from impact_posture.plot import draw_all

        found = self.solution
        path = null_space_path(found.problem, found.initial, found.q)
        view = result_view(self._prepared, found.initial, found.q, path, self.document, self.motion, self._mapped)
        return draw_all(view, Path(out), formats, only)

    def export(self, out: str | Path, *, build: bool = True, **options: Any) -> Export:
        """Write the C code as :meth:`ImpactObjective.export` does, with the optimal posture as a constant."""
        from impact_posture.codegen.export import write_export

        objective = self.problem.problem.impact
        return write_export([objective], Path(out), posture=self.q, build=build, **options)


def optimize(
    problem: PostureProblem,
    *,
    starts: int = 16,
    seed: int = 0,
    jobs: int = 2,
    compile: CompileMode = "auto",
    search: Search = "multistart",
    progress: Progress | None = None,
) -> PostureResult:
    """Find the posture with the least objective, from many starts, and certify it.

    Args:
        problem: The problem.
        starts: Number of starts: the given posture, then random feasible postures.
        seed: Seed of the random starts.
        jobs: Processes that search side by side.
        compile: Whether the program is compiled: ``auto`` (if it pays), ``always`` or ``never``.
        search: ``multistart``, or ``global`` (:func:`~impact_posture.posture.global_search.search_globally`).
        progress: Called after each start with the numbers done and in all.

    Raises:
        InputError: The problem is none for the search ``global``.
        Infeasible: No posture satisfies the constraints; the error names the conflicting constraints.
        SolverFailed: No run ended at a certified posture.
    """
    _check_choice("search", search, get_args(Search))
    if search == "global":
        check_searchable(problem.problem)
    found = solve_robustly(problem.problem, starts=starts, seed=seed, jobs=jobs, compile=compile, progress=progress)
    if search == "multistart":
        return PostureResult(problem, found.solution, found.robustness)
    best = search_globally(found.solution, seed=seed, jobs=jobs, compile=compile, progress=progress)
    robustness = found.robustness and compare_variants(
        best.solution, [variant.q for variant in found.robustness.model_variants], seed
    )
    return PostureResult(problem, best.solution, robustness, global_search=best.search)
