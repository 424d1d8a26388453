"""Machine code for the program's functions where it pays, kept in a cache by content.

CasADi interprets its expressions at a few nanoseconds an operation; a compiler makes that a few tenths, after a wait
of some 100 µs an operation.  So one optimization of a small robot is interpreted, and a study of thousands compiles
once.
"""

from __future__ import annotations

import hashlib
import os
import platform
import tempfile
from pathlib import Path
from typing import Any, Literal

import casadi as ca

from impact_posture import __version__
from impact_posture.errors import CompilerError
from impact_posture.posture.problem import PostureProblem
from impact_posture.toolchain import find_compiler, run_compiler

CompileMode = Literal["auto", "always", "never"]

# From what tests/benchmarks/solve_times.py prints for talos: 170,000 operations take about 20 s to compile, and each
# start of some 25 iterations is about 30 ms faster for it.  Orders of magnitude are enough to decide.
_COMPILE_S_PER_OPERATION = 1.2e-4
_SAVED_S_PER_OPERATION = 6e-9
_ITERATIONS = 35


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
    """Hash of everything that shapes the program's functions; targets, normals and limits are parameters."""
    objective = problem.objective
    content = [
        __version__,
        _own_source(),
        ca.CasadiMeta.version(),
        f"{platform.system()} {platform.machine()}",
        problem.robot.model_sha256,
        repr((objective.kind, objective.metric, objective.supports, objective.compliance)),
        repr(objective.normal_cone_deg),
        repr((objective.contact.frame, objective.contact.offset, objective.contact.normal_frame)),
        repr(objective.scale),
        *[f"{c.structure}:{problem.carried(i)}" for i, c in enumerate(problem.constraints)],
    ]
    return hashlib.sha256("\n".join(content).encode()).hexdigest()[:32]


def _own_source() -> str:
    """Hash of the code that writes the expressions: a changed formula never meets an old library."""
    root = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for folder in ("dynamics", "impact", "posture"):
        for path in sorted((root / folder).glob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _compile(solver: ca.Function, compiler: list[str], library: Path) -> None:
    library.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=library.parent) as folder:
        source, built = Path(folder) / "program.c", Path(folder) / "program.so"
        generator = ca.CodeGenerator(source.name)
        generator.add(solver.oracle())
        for name in solver.get_function():
            generator.add(solver.get_function(name))
        generator.generate(f"{folder}{os.sep}")
        run_compiler([*compiler, "-O1", "-fPIC", "-shared", source.name, "-o", built.name, "-lm"], Path(folder))
        os.replace(built, library)
