"""Result class ``ip.PostureResult``, and function ``ip.optimize``, which computes a result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from impact_posture.api.posture_problem import PostureProblem
from impact_posture.config.checked import checked
from impact_posture.config.demand import OneOrMore, ZeroOrMore
from impact_posture.config.problem_settings import JOBS, SCREENED, STARTS, TRADEOFF_POINTS, Against, Search
from impact_posture.errors import Infeasible, InputError
from impact_posture.impact.elasticity.contact_compression import GIVE_ELASTICITY
from impact_posture.output.picture_formats import DEFAULT_FORMATS
from impact_posture.output.result_folder import Written, finish_result
from impact_posture.output.result_reader import SolvedPostures, result_view
from impact_posture.posture.analysis.least_force import explain_force_bound
from impact_posture.posture.analysis.pareto_front import pareto_front
from impact_posture.posture.analysis.result_document import result_arrays, result_document
from impact_posture.posture.analysis.robustness import Robustness, compare_variants, solve_robustly
from impact_posture.posture.analysis.trade_off import TradeOff
from impact_posture.posture.formulation.problem_file import Prepared, dump_settings, resolved_settings
from impact_posture.posture.manifold.null_space_path import null_space_path
from impact_posture.posture.program.certificate import Certificate
from impact_posture.posture.program.compiled_solver import CompileMode
from impact_posture.posture.search.global_search import GlobalSearch, check_searchable, search_globally
from impact_posture.posture.search.growing_search import Progress
from impact_posture.posture.search.multistart import PostureSolution
from impact_posture.robot.posture_files import write_posture
from impact_posture.system.arrays import Array
from impact_posture.system.output_folder import whole_folder, write_json

# Functions import the following modules, because the imports take longer than solving a small problem.
if TYPE_CHECKING:
    from impact_posture.codegen.export import Export
    from impact_posture.path.posture_path import PosturePath


@dataclass(frozen=True, eq=False, repr=False)
class PostureResult:
    """Optimized posture with its certificate.  The result can be saved, drawn and exported.

    Attributes:
        problem: The solved problem.
        solution: Result of the search.
        robustness: Comparison with the optima of the model variants; ``None`` if there are no model variants.
        tradeoff: Best objective under each of several bounds on the distance or the peak force; ``None`` before a
            call of :meth:`trade_off`.
        motion: Timed path from the start to the optimum; ``None`` before a call of :meth:`path`.
        global_search: Result of the search ``global``; ``None`` if another search was used.
    """

    problem: PostureProblem
    solution: PostureSolution
    robustness: Robustness | None = None
    tradeoff: TradeOff | None = None
    motion: PosturePath | None = None
    global_search: GlobalSearch | None = None

    @property
    def q(self) -> Array:
        """The best certified posture, shape (nq,)."""
        return self.solution.q

    @property
    def initial(self) -> Array:
        """The initial posture, moved onto the constraints if it violates them, shape (nq,)."""
        return self.solution.initial

    @property
    def answer(self) -> Array:
        """The posture of ``posture.json``, shape (nq,): ``q``, or the end of a path that does not reach ``q``."""
        return self.q if self.motion is None or self.motion.found else self.motion.q[-1]

    @property
    def reduction(self) -> float:
        """``1 − objective(q)/objective(initial)``."""
        return self.solution.reduction

    @property
    def certificate(self) -> Certificate:
        """Stationarity, violation and multipliers, recomputed with Pinocchio."""
        return self.solution.certificate

    @property
    def verdict(self) -> str:
        """The verdict in one line, as ``optimize`` prints it first; ``document["verdict"]`` contains its numbers.

        Raises:
            InputError: The objective is not an impact objective.
        """
        return str(self.document["verdict"]["line"])

    def __repr__(self) -> str:
        objective = self.problem.problem.objective
        values = " → ".join(f"{objective.value(q):.4g}" for q in (self.initial, self.q))
        kept = "certified" if self.certificate.holds() else "not certified"
        return f"PostureResult({objective.robot.name}, {objective.name} {values} ({-self.reduction:+.1%}), {kept})"

    def _repr_html_(self) -> str | None:
        """Return the postures, the verdict and the table of values for notebooks."""
        if self.problem.prepared is None:
            return None
        from impact_posture.output.report.result_report import result_summary

        view = result_view(self._prepared, self._postures, self.motion)
        return result_summary(self._prepared, view, self.document)

    @cached_property
    def document(self) -> dict[str, Any]:
        """The content of ``result.json``.

        Raises:
            InputError: The objective is not an impact objective.
        """
        path = None if self.motion is None else self.motion.to_dict()
        extras = self.robustness, self.tradeoff, path, self.global_search
        return result_document(self._prepared, self.solution, *extras)

    @cached_property
    def _postures(self) -> SolvedPostures:
        solution, mapped = self.solution, None if self.global_search is None else self.global_search.map
        path = null_space_path(solution.problem, solution.initial, self.answer)
        return SolvedPostures(solution.initial, self.answer, path, self.document, mapped)

    @property
    def _prepared(self) -> Prepared:
        if self.problem.prepared is None:
            fault = f"is '{self.problem.problem.objective.name}', which is not an impact objective"
            raise InputError(fault, where="objective", hint="give an ImpactObjective")
        return self.problem.prepared

    @checked
    def trade_off(
        self,
        points: OneOrMore = TRADEOFF_POINTS,
        against: Against = "distance",
        *,
        compile: CompileMode = "auto",
        progress: Progress | None = None,
    ) -> PostureResult:
        """Return this result with the best objective under each of ``points`` bounds on ``against`` added.

        Args:
            points: Number of bounds.
            against: Bounded quantity: the ``distance`` from the start, or the peak ``force`` of the impact.
            compile: When to compile the program: ``auto`` (if it saves time), ``always`` or ``never``.
            progress: Function that is called with the numbers of finished and planned solves.

        Raises:
            InputError: ``against`` is ``force``, but the elasticity of the contact is not known.
        """
        force = None
        if against == "force":
            impact = self._prepared.impact
            if impact.contact_stiffness is None:
                fault = "force needs the elasticity of the contact"
                raise InputError(fault, where="tradeoff_against", hint=GIVE_ELASTICITY)
            force = impact.contact_stiffness, impact.speed
        curve = pareto_front(self.solution, points, force=force, compile=compile, progress=progress)
        return replace(self, tradeoff=curve)

    @checked
    def path(self, *, seed: ZeroOrMore = 0, strike: bool = False, jobs: OneOrMore = JOBS) -> PostureResult:
        """Return this result with a timed path from the initial posture to the optimum added.

        The timing respects the robot's limits (:func:`~impact_posture.path.posture_path.posture_path`).  If no path
        leads to the best optimum, the method tries paths to the other optima, and :attr:`answer` is the posture where
        the path ends.  A search without ``finish_all`` may not find all optima.

        Args:
            seed: Seed of the sampling planner.
            strike: Whether the path ends with an impact instead of at rest (:mod:`~impact_posture.path.strike`).  The
                contact point then arrives with the approach speed of the problem, after a run-up along the normal.
            jobs: Number of processes that time the path, and compute the stops after the considered impacts.

        Raises:
            InputError: The package TOPP-RA (``impact-posture[path]``) is not installed, or the contact cannot strike.
        """
        from impact_posture.path.posture_path import posture_path

        if not strike:
            return replace(self, motion=posture_path(self.solution, seed=seed, jobs=jobs))
        impact = self._prepared.impact
        motion = posture_path(
            self.solution, seed=seed, strike=impact.speed, restitution=impact.restitution, jobs=jobs
        )
        return replace(self, motion=motion)

    @checked
    def save(
        self,
        out: str | Path,
        *,
        force: bool = False,
        codegen: bool = True,
        formats: Sequence[str] = DEFAULT_FORMATS,
        report: bool = True,
        meshes: bool = False,
        jobs: OneOrMore = JOBS,
        progress: Progress | None = None,
    ) -> Written:
        """Write a folder with result.json, problem.toml, posture.json, pictures and C code, or write nothing.

        Args:
            out: The folder.
            force: Whether to replace an earlier result in the folder.
            codegen: Whether to export, build and check the C code as well.
            formats: File formats of the pictures: ``png``, ``svg``, ``pdf``.
            report: Whether to write ``report.html``, a page with the result and the robot in 3-D.
            meshes: Whether to embed the meshes of the user's own URDF in ``report.html``.  Everyone who opens the
                page then receives the meshes.
            jobs: Number of parallel processes that draw and compile.
            progress: Function that is called after each file, with the number of finished files and the number of all
                files.

        Returns:
            The folder, the C export in the folder, and the reason if the C code could not be built.

        Raises:
            OutputError: The folder exists and ``force`` is false, or the folder cannot be written.
        """
        prepared, postures = self._prepared, self._postures
        with whole_folder(Path(out), force=force, kind="result") as folder:
            write_json(folder / "result.json", self.document)
            arrays = result_arrays(self.solution, postures.path, self.tradeoff, postures.mapped)
            np.savez_compressed(folder / "result.npz", **arrays)  # type: ignore[arg-type]
            write_json(folder / "posture.json", write_posture(prepared.impact.robot, postures.answer))
            (folder / "problem.toml").write_text(dump_settings(resolved_settings(prepared)), encoding="utf-8")
            if self.motion is not None:
                from impact_posture.path.path_files import write_path

                write_path(folder, prepared.impact.robot, self.motion)
            written = finish_result(
                folder, prepared, postures, codegen=codegen, formats=formats, report=report, meshes=meshes, jobs=jobs,
                progress=progress,
            )  # fmt: skip
        return replace(written, out=Path(out))

    @checked
    def plot(
        self, out: str | Path, formats: Sequence[str] = DEFAULT_FORMATS, only: Sequence[str] | None = None, *,
        force: bool = False,
    ) -> list[Path]:  # fmt: skip
        """Draw the figures into a folder, and return their paths; ``force`` also replaces files of the user.

        Raises:
            OutputError: A file of the user has the name of a figure, or the folder cannot be written.
        """
        from impact_posture.output.plot import draw_into

        view = result_view(self._prepared, self._postures, self.motion)
        return draw_into(view, Path(out), formats, only, force=force)

    @checked
    def export(self, out: str | Path, *, build: bool = True, **options: Any) -> Export:
        """Write C code as :meth:`ImpactObjective.export` does; the code contains the posture :attr:`answer`."""
        from impact_posture.codegen.export import write_export

        objective = self.problem.problem.impact
        return write_export([objective], Path(out), posture=self.answer, build=build, **options)


@checked
def optimize(
    problem: PostureProblem,
    *,
    starts: OneOrMore | None = None,
    seed: ZeroOrMore = 0,
    jobs: OneOrMore = JOBS,
    compile: CompileMode = "auto",
    search: Search = "adaptive",
    progress: Progress | None = None,
    finish_all: bool = False,
) -> PostureResult:
    """Search from many postures for the posture with the smallest objective, and check its optimality.

    Args:
        problem: The problem.
        starts: Largest number of random postures that the search screens, by default 6144.  If the search is
            ``multistart``, or the problem cannot be screened, ``starts`` is the number of starts, by default 16.  In
            these two cases, the first start is the given posture, and all other starts are random feasible postures.
        seed: Seed of the random starts.
        jobs: Number of parallel processes.
        compile: When to compile the program: ``auto`` (if it saves time), ``always`` or ``never``.
        search: ``adaptive`` (:mod:`~impact_posture.posture.search.screening`), ``multistart``, or ``global``, which
            continues after ``adaptive`` (:func:`~impact_posture.posture.search.global_search.search_globally`).
        progress: Function that is called after each start, with the number of finished starts and the number of all
            starts.
        finish_all: Also finish starts that can no longer become the best.  The search ``global`` always finishes all
            starts.

    Raises:
        InputError: An argument is not valid, or the search ``global`` cannot solve the problem.
        Infeasible: No posture satisfies the constraints; the error names the conflicting constraints.
        SolverFailed: No run ended at a posture whose optimality is certified.
    """
    if search == "global":
        check_searchable(problem.problem)
    try:
        solved = solve_robustly(
            problem.problem, starts=starts or STARTS, seed=seed, jobs=jobs, compile=compile, progress=progress,
            finish_all=finish_all or search == "global",
            screened=0 if search == "multistart" else starts or SCREENED,
        )  # fmt: skip
    except Infeasible as error:
        if problem.prepared is not None:
            explain_force_bound(error, problem.prepared, starts=STARTS, seed=seed, jobs=jobs, compile=compile)
        raise
    if search != "global":
        return PostureResult(problem, solved.solution, solved.robustness)
    best = search_globally(solved.solution, seed=seed, jobs=jobs, compile=compile)
    robustness = solved.robustness and compare_variants(
        best.solution, [variant.own_q for variant in solved.robustness.model_variants], seed
    )
    return PostureResult(problem, best.solution, robustness, global_search=best.search)
