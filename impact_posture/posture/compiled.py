"""Machine code for the program's functions where it pays, kept in a cache by content.

CasADi interprets its expressions at a few nanoseconds an operation; a compiler makes that a few tenths, after a wait
of some 100 µs an operation.  So one optimization of a small robot is interpreted, and a study of thousands compiles
once.
"""

from __future__ import annotations

import hashlib
import os
import platform
from pathlib import Path
from typing import Any, Literal

import casadi as ca

from impact_posture import __version__
from impact_posture.errors import CompilerError
from impact_posture.folder import scratch_folder
from impact_posture.posture.problem import PostureProblem
from impact_posture.toolchain import find_compiler, run_compiler, run_compilers

CompileMode = Literal["auto", "always", "never"]

# From what tests/benchmarks/solve_times.py prints for talos: 170,000 operations take about 20 s to compile, and each
# start of some 25 iterations is about 30 ms faster for it.  Orders of magnitude are enough to decide.
_COMPILE_S_PER_OPERATION = 1.2e-4
_SAVED_S_PER_OPERATION = 6e-9
_ITERATIONS = 35
# Above so many operations a function is not optimized: a compiler takes three times as long for code three times as
# fast, which then is no longer what a solve waits for.
_OPTIMIZED = 100_000


def cache_folder() -> Path:
    """Where compiled programs are kept: ``$IMPACT_POSTURE_CACHE``, else the user's cache folder."""
    own = os.environ.get("IMPACT_POSTURE_CACHE")
    if own:
        return Path(own)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "impact-posture"


def compiled_solver(
    problem: PostureProblem, symbols: dict[str, ca.SX], options: dict[str, Any], mode: CompileMode, starts: int
) -> tuple[ca.Function, bool]:
    """``nlpsol`` on the expressions, compiled or interpreted, and which of the two."""
    compiler = find_compiler()
    if mode == "always" and compiler is None:
        raise CompilerError("no C compiler found", where="compile", mend="install gcc or clang, or set CC")
    library = cache_folder() / f"{_key(problem)}.so"
    if mode != "never" and library.is_file():
        try:
            return ca.nlpsol("posture", "ipopt", str(library), options), True
        except RuntimeError:
            # Broken, or made by another machine that shares the folder.
            library.unlink(missing_ok=True)
    solver = ca.nlpsol("posture", "ipopt", symbols, options)
    if mode == "never" or compiler is None or (mode == "auto" and not _pays(solver, starts)):
        return solver, False
    _compile(solver, compiler, library)
    return ca.nlpsol("posture", "ipopt", str(library), options), True


def _pays(solver: ca.Function, starts: int) -> bool:
    operations = sum(solver.get_function(name).n_instructions() for name in ("nlp_hess_l", "nlp_jac_g"))
    return bool(operations * _ITERATIONS * starts * _SAVED_S_PER_OPERATION > operations * _COMPILE_S_PER_OPERATION)


def _key(problem: PostureProblem) -> str:
    """Hash of what shapes the program's functions; targets, limits and the leading normal are parameters."""
    objective = problem.objective
    content = [
        __version__,
        own_source("dynamics", "impact", "posture"),
        ca.CasadiMeta.version(),
        f"{platform.system()} {platform.machine()}",
        problem.robot.model_sha256,
        # Where frames sit on their links is no part of the dynamics, but of every expression of a point.
        *[f"{f.name} {f.parentJoint} {f.placement.homogeneous.tolist()}" for f in problem.robot.model.frames],
        repr((objective.kind, objective.metric, objective.supports, objective.compliance)),
        repr((objective.normal_cone_deg, objective.others, objective.bilateral)),
        repr([scenario.robot.model_sha256 for scenario in objective.scenarios]),
        repr((objective.contact.frame, objective.contact.offset, objective.contact.normal_frame)),
        repr(objective.scale),
        *[f"{c.structure}:{problem.carried(i)}" for i, c in enumerate(problem.constraints)],
    ]
    return hashlib.sha256("\n".join(content).encode()).hexdigest()[:32]


def own_source(*packages: str) -> str:
    """Hash of the code that writes the expressions: a changed formula never meets an old library."""
    root = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for folder in packages:
        for path in sorted((root / folder).glob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _compile(solver: ca.Function, compiler: list[str], library: Path) -> None:
    """Each function in a file of its own, as many compilers at once as there are cores."""
    library.parent.mkdir(parents=True, exist_ok=True)
    with scratch_folder(library.parent) as folder:
        functions = [solver.oracle(), *[_shared(solver.get_function(name)) for name in solver.get_function()]]
        # The largest first: nothing waits for it in the end.
        functions.sort(key=lambda function: -int(function.n_instructions()))
        commands = [_command(function, compiler, folder) for function in functions]
        run_compilers(commands, folder)
        objects = [f"{function.name()}.o" for function in functions]
        run_compiler([*compiler, "-shared", *objects, "-o", "program.so", "-lm"], folder)
        os.replace(folder / "program.so", library)


def _shared(function: ca.Function) -> ca.Function:
    """The same function with equal subexpressions computed once, which differentiation leaves many of."""
    inputs = function.sx_in()
    names = (function.name_in(), function.name_out())
    return ca.Function(function.name(), inputs, function.call(inputs), *names, {"cse": True})


def _command(function: ca.Function, compiler: list[str], folder: Path) -> list[str]:
    """Write the function's C, and say how it is compiled."""
    name = function.name()
    generator = ca.CodeGenerator(f"{name}.c")
    generator.add(function)
    generator.generate(f"{folder}{os.sep}")
    level = "-O1" if function.n_instructions() <= _OPTIMIZED else "-O0"
    return [*compiler, level, "-fPIC", "-c", f"{name}.c", "-o", f"{name}.o"]
