"""Machine code for the program's functions where it pays, kept in a cache by content.

CasADi interprets its expressions at a few nanoseconds an operation; a compiler makes that a few tenths, after a wait
of some 100 µs an operation.  So one optimization of a small robot is interpreted, and a study of thousands compiles
once.
"""

from __future__ import annotations

import hashlib
import platform
from pathlib import Path
from typing import Any, Literal, NamedTuple

import casadi as ca

from impact_posture.errors import CompilerError, OutputError
from impact_posture.libraries import building, cache_folder, cache_path, is_cached
from impact_posture.posture.problem import PostureProblem
from impact_posture.toolchain import find_compiler, run_compiler, run_compilers
from impact_posture.version import __version__

CompileMode = Literal["auto", "always", "never"]

# From what tests/benchmarks/solve.py prints for talos: 170,000 operations take about 20 s to compile, and each
# start of some 25 iterations is about 30 ms faster for it.  Orders of magnitude are enough to decide.
_COMPILE_S_PER_OPERATION = 1.2e-4
_SAVED_S_PER_OPERATION = 6e-9
_ITERATIONS = 35
# Above so many operations a function is not optimized: a compiler takes three times as long for code three times as
# fast, which then is no longer what a solve waits for.
_OPTIMIZED = 100_000


class BuiltSolver(NamedTuple):
    """``nlpsol``, whether it runs as machine code, and why it does not although it should; empty if it does."""

    solver: ca.Function
    compiled: bool
    fault: str = ""


def compiled_solver(
    problem: PostureProblem, symbols: dict[str, ca.SX], options: dict[str, Any], mode: CompileMode, starts: int
) -> BuiltSolver:
    """Build ``nlpsol`` on the expressions, compiled or interpreted.

    Raises:
        CompilerError: ``always``, and there is no compiler or it fails.
        OutputError: ``always``, and the cache cannot be written or is not the user's alone.
    """
    interpreted: ca.Function | None = None
    try:
        if mode != "never" and (found := _cached(problem, options)) is not None:
            return BuiltSolver(found, True)
        interpreted = ca.nlpsol("posture", "ipopt", symbols, options)
        compiler = find_compiler()
        if mode == "always" and compiler is None:
            raise CompilerError("no C compiler found", where="compile", hint="install gcc or clang, or set CC")
        if mode == "never" or compiler is None or (mode == "auto" and not _pays(interpreted, starts)):
            return BuiltSolver(interpreted, False)
        _compile(interpreted, compiler, f"{_key(problem)}.so")
        if (found := _cached(problem, options)) is None:
            raise CompilerError("what was built cannot be loaded", where="compile", hint="set CC to another compiler")
        return BuiltSolver(found, True)
    except (CompilerError, OutputError) as error:
        if mode == "always":
            raise
        if interpreted is None:
            interpreted = ca.nlpsol("posture", "ipopt", symbols, options)
        return BuiltSolver(interpreted, False, f"interpreted, not compiled: {error.line}")


def _cached(problem: PostureProblem, options: dict[str, Any]) -> ca.Function | None:
    library = cache_path() / f"{_key(problem)}.so"
    if not is_cached(library):
        return None
    try:
        return ca.nlpsol("posture", "ipopt", str(library), options)
    except RuntimeError:
        # Made by another machine that shares the folder.
        library.unlink(missing_ok=True)
        return None


def _pays(solver: ca.Function, starts: int) -> bool:
    operations = sum(solver.get_function(name).n_instructions() for name in ("nlp_hess_l", "nlp_jac_g"))
    return bool(operations * _ITERATIONS * starts * _SAVED_S_PER_OPERATION > operations * _COMPILE_S_PER_OPERATION)


def _key(problem: PostureProblem) -> str:
    """Hash of what shapes the program's functions; targets, limits and the leading normal are parameters."""
    content = [
        __version__,
        own_source("dynamics", "impact", "posture"),
        ca.CasadiMeta.version(),
        f"{platform.system()} {platform.machine()}",
        problem.robot.model_sha256,
        # Where frames sit on their links is no part of the dynamics, but of every expression of a point.
        *[f"{f.name} {f.parentJoint} {f.placement.homogeneous.tolist()}" for f in problem.robot.model.frames],
        problem.objective.structure,
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


def _compile(solver: ca.Function, compiler: list[str], name: str) -> None:
    """Compile into the cache: each function in a file of its own, as many compilers at once as there are cores."""
    library = cache_folder() / name
    with building(library) as folder:
        functions = [solver.oracle(), *[_shared(solver.get_function(name)) for name in solver.get_function()]]
        # The largest first: nothing waits for it in the end.
        functions.sort(key=lambda function: -int(function.n_instructions()))
        commands = [_command(function, compiler, folder) for function in functions]
        run_compilers(commands, folder)
        objects = [f"{function.name()}.o" for function in functions]
        run_compiler([*compiler, "-shared", *objects, "-o", library.name, "-lm"], folder)


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
    (folder / f"{name}.c").write_text(generator.dump(), encoding="utf-8")
    level = "-O1" if function.n_instructions() <= _OPTIMIZED else "-O0"
    return [*compiler, level, "-fPIC", "-c", f"{name}.c", "-o", f"{name}.o"]
