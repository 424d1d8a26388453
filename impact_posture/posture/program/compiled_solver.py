"""Compile the functions of the program to machine code if this saves time, and store the code in a cache.

The key of the cache is a hash of the content of the functions.  CasADi interprets an operation in a few nanoseconds.
Machine code needs a few tenths of a nanosecond, but compiling takes about 100 µs for each operation.  So a single
optimization of a small robot is interpreted.  For a study of thousands of optimizations, the functions are compiled
once.
"""

from __future__ import annotations

import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import casadi as ca

from impact_posture.errors import CompilerError, InputError, OutputError
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.system.libraries import building, cache_folder, cache_path, is_cached, source_key
from impact_posture.system.toolchain import find_compiler, require_compiler, run_compiler, run_compilers

CompileMode = Literal["auto", "always", "never"]

# The times are measured with docs/studies/solve.py for talos.  Compiling 170,000 operations takes about 20 s.  A run
# of about 25 iterations is then about 30 ms faster.  For the decision whether to compile, the orders of magnitude of
# these times suffice.
_COMPILE_S_PER_OPERATION = 1.2e-4
_SAVED_S_PER_OPERATION = 6e-9
_ITERATIONS = 35
# Functions with more operations are compiled with -O0.  With -O1, compiling takes three times as long, and the code
# is three times as fast.  For large functions, -O1 is not worthwhile, because evaluating them takes only a small part
# of the solve time even with -O0.
_OPTIMIZED = 100_000


class BuiltSolver(NamedTuple):
    """The solver ``nlpsol``, whether it runs as machine code, and why a compilation failed (otherwise empty)."""

    solver: ca.Function
    compiled: bool
    fault: str = ""


def compiled_solver(
    problem: ConstrainedProblem,
    symbols: dict[str, ca.SX],
    options: dict[str, Any],
    mode: CompileMode,
    starts: int,
    derivatives: Mapping[str, ca.Function],
) -> BuiltSolver:
    """Build ``nlpsol`` from the expressions ``x``, ``p``, ``f`` and ``g``, compiled or interpreted.

    ``options`` are options of IPOPT, ``starts`` is the number of runs that use the same compiled code, and
    ``derivatives`` are options of ``nlpsol`` that supply derivatives.

    Raises:
        InputError: The mode is not one of ``auto``, ``always`` and ``never``.
        CompilerError: The mode is ``always``, and there is no compiler, or the compiler fails.
        OutputError: The mode is ``always``, and the cache folder cannot be written, or other users can write to the
            folder.
    """
    if mode not in (modes := get_args(CompileMode)):
        raise InputError(f"no mode '{mode}'", where="compile", hint=f"choose from {', '.join(modes)}")
    interpreted: ca.Function | None = None
    try:
        if mode != "never" and (solver := _cached(problem, options)) is not None:
            return BuiltSolver(solver, True)
        interpreted = ca.nlpsol("posture", "ipopt", symbols, {**options, **derivatives})
        compiler = require_compiler("compile") if mode == "always" else find_compiler()
        if mode == "never" or compiler is None or (mode == "auto" and not _pays(interpreted, starts)):
            return BuiltSolver(interpreted, False)
        _compile(interpreted, compiler, f"{_key(problem)}.so")
        if (solver := _cached(problem, options)) is None:
            raise CompilerError(
                "the compiled library cannot be loaded", where="compile", hint="set CC to another compiler"
            )
        return BuiltSolver(solver, True)
    except (CompilerError, OutputError) as error:
        if mode == "always":
            raise
        if interpreted is None:
            interpreted = ca.nlpsol("posture", "ipopt", symbols, {**options, **derivatives})
        return BuiltSolver(interpreted, False, f"interpreted, not compiled: {error.line}")


def _cached(problem: ConstrainedProblem, options: dict[str, Any]) -> ca.Function | None:
    library = cache_path() / f"{_key(problem)}.so"
    if not is_cached(library):
        return None
    try:
        return ca.nlpsol("posture", "ipopt", str(library), options)
    except RuntimeError:
        # The library cannot be loaded, for example because another machine that shares the cache folder built it.
        library.unlink(missing_ok=True)
        return None


def _pays(solver: ca.Function, starts: int) -> bool:
    operations = sum(solver.get_function(name).n_instructions() for name in ("nlp_hess_l", "nlp_jac_g"))
    return bool(operations * _ITERATIONS * starts * _SAVED_S_PER_OPERATION > operations * _COMPILE_S_PER_OPERATION)


def _key(problem: ConstrainedProblem) -> str:
    """Return a hash of all numbers in the functions.

    The hash omits targets, limits and the normal of the first contact, because they are parameters.
    """
    content = [
        ca.CasadiMeta.version(),
        f"{platform.system()} {platform.machine()}",
        problem.robot.impact_sha256,
        # The hash of the dynamics does not contain the placements of frames on links, but every expression of a point
        # uses them.
        *[f"{f.name} {f.parentJoint} {f.placement.homogeneous.tolist()}" for f in problem.robot.model.frames],
        problem.objective.structure,
        problem.structure,
    ]
    return source_key(content, "dynamics", "impact", "posture")


def _compile(solver: ca.Function, compiler: list[str], name: str) -> None:
    """Compile each function into a separate object file, in parallel on all cores, and link them in the cache."""
    library = cache_folder() / name
    with building(library) as folder:
        functions = [solver.oracle(), *[_shared(solver.get_function(name)) for name in solver.get_function()]]
        # The compilation of the largest function starts first, because it takes longest.
        functions.sort(key=lambda function: -int(function.n_instructions()))
        commands = [_command(function, compiler, folder) for function in functions]
        run_compilers(commands, folder)
        objects = [f"{function.name()}.o" for function in functions]
        run_compiler([*compiler, "-shared", *objects, "-o", library.name, "-lm"], folder)


def _shared(function: ca.Function) -> ca.Function:
    """Return a function that computes equal subexpressions, which differentiation creates, only once."""
    inputs = function.sx_in()
    names = (function.name_in(), function.name_out())
    return ca.Function(function.name(), inputs, function.call(inputs), *names, {"cse": True})


def _command(function: ca.Function, compiler: list[str], folder: Path) -> list[str]:
    """Write the C code of a function, and return the command that compiles it."""
    name = function.name()
    generator = ca.CodeGenerator(f"{name}.c")
    generator.add(function)
    (folder / f"{name}.c").write_text(generator.dump(), encoding="utf-8")
    level = "-O1" if function.n_instructions() <= _OPTIMIZED else "-O0"
    return [*compiler, level, "-fPIC", "-c", f"{name}.c", "-o", f"{name}.o"]
