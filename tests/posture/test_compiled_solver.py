"""Compiled programs: the same results as interpreted programs, the cache, and one thread for linear algebra."""

from __future__ import annotations

import errno
import time
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
import threadpoolctl

from impact_posture.config.problem_settings import ProblemSettings
from impact_posture.errors import CompilerError, InputError, OutputError
from impact_posture.posture.analysis.result_document import result_document
from impact_posture.posture.formulation.problem_file import Prepared, prepare
from impact_posture.posture.program import compiled_solver as compiled
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.program.ipopt import one_blas_thread
from impact_posture.posture.program.posture_nlp import build_nlp
from impact_posture.posture.search.multistart import solve
from impact_posture.system import libraries
from impact_posture.system.toolchain import run_compilers
from tests.output.views import PENDULUM
from tests.support.settings import make_settings
from tests.support.tools import need, need_compiler

OPTIMIZED = True


@pytest.fixture(scope="module")
def prepared() -> Prepared:
    return prepare(make_settings({"robot": "tilthex_arm", "frame": "ee", "normal": (0.0, 0.0, 1.0)}))


@pytest.fixture(scope="module")
def problem(prepared: Prepared) -> ConstrainedProblem:
    return prepared.problem


@pytest.mark.long(but=("0",))
@pytest.mark.parametrize("optimized", [compiled._OPTIMIZED, 0])
def test_the_same_answer_from_machine_code(
    problem: ConstrainedProblem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, optimized: int
) -> None:
    """Compiled programs need as many iterations as interpreted programs, and cached programs need no compiler."""
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(tmp_path))
    monkeypatch.setattr(compiled, "_OPTIMIZED", optimized)
    interpreted = build_nlp(problem, compile="never").solve(problem.given)
    built = build_nlp(problem, compile="always")
    assert built.compiled
    (library,) = tmp_path.glob("*.so")
    assert sorted(path.name for path in tmp_path.iterdir()) == [library.name, f"{library.name}.sha256"]
    monkeypatch.setattr(compiled, "find_compiler", lambda: None)
    cached = build_nlp(problem, compile="auto")
    assert cached.compiled
    for nlp in (built, cached):
        record = nlp.solve(problem.given)
        assert record.converged and record.iterations == interpreted.iterations
        np.testing.assert_allclose(record.q, interpreted.q, atol=1e-9)


def test_the_same_answer_from_machine_code_of_a_program_that_grows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Solve the default problem of the command line: it avoids collisions and assembles derivatives from parts."""
    need_compiler()
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(tmp_path))
    problem = prepare(ProblemSettings(robot="tilthex_arm", normal=(-1.0, 0.0, 0.0))).problem
    assert problem.grows
    interpreted = solve(problem, starts=2, jobs=1, compile="never")
    assert interpreted.problem is not problem
    compiled_run = solve(problem, starts=2, jobs=1, compile="always")
    assert compiled_run.compiled and compiled_run.iterations == interpreted.iterations
    np.testing.assert_allclose(compiled_run.q, interpreted.q, atol=1e-9)


def test_a_broken_library_is_not_used(
    problem: ConstrainedProblem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(tmp_path))
    broken = tmp_path / f"{compiled._key(problem)}.so"
    broken.write_text("no library")
    assert not build_nlp(problem, compile="auto").compiled
    assert not broken.exists()


@pytest.fixture(scope="module")
def small() -> ConstrainedProblem:
    asked = {"robot": PENDULUM, "frame": "link2", "offset": (0.0, 0.1, 0.3), "normal": (0.0, 1.0, 0.0)}
    return prepare(make_settings(asked | {"contact_pose": "free"})).problem


def test_a_damaged_library_is_built_again(
    small: ConstrainedProblem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    need_compiler()
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(tmp_path))
    assert build_nlp(small, compile="always").compiled
    (library,) = tmp_path.glob("*.so")
    whole = library.stat().st_size
    # Replace the library by a damaged copy.  The test process has mapped the original, so only rename the original.
    library.write_bytes(library.rename(library.with_suffix(".old")).read_bytes()[: whole // 2])
    assert build_nlp(small, compile="always").compiled
    assert library.stat().st_size == whole and libraries.is_cached(library)
    library.chmod(0o666)
    with pytest.raises(OutputError, match="can be written by others"):
        build_nlp(small, compile="always")
    built = build_nlp(small, compile="auto")
    assert not built.compiled and "can be written by others" in built.compiler_fault


def full_disk(*_: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize(
    ("how", "words", "error"),
    [
        ("compiler", "the C compiler failed", CompilerError),
        ("disk", "No space left on device", OutputError),
        ("cache", "cannot be written", OutputError),
        ("shared", "can be written by others", OutputError),
    ],
)
def test_auto_falls_back_with_one_warning(
    prepared: Prepared, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str, words: str, error: type[Exception]
) -> None:
    need_compiler()
    cache = tmp_path / "cache"
    if how == "compiler":
        monkeypatch.setenv("CC", need("false"))
    elif how == "disk":
        monkeypatch.setattr(libraries, "_replace", full_disk)
    elif how == "cache":
        cache.write_text("a file")
    else:
        cache.mkdir()
        cache.chmod(0o777)
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(cache))
    monkeypatch.setattr(compiled, "_pays", lambda *_: True)
    monkeypatch.setattr(compiled, "_OPTIMIZED", 0)
    solution = solve(prepared.problem, starts=1, jobs=1)
    assert not solution.compiled
    said = [line for line in result_document(prepared, solution)["warnings"] if "not compiled" in line]  # type: ignore[attr-defined]
    assert len(said) == 1 and words in said[0]
    # The hulls of links are cached too, but no part of a library remains.
    assert not (cache.is_dir() and [path for path in cache.iterdir() if path.name != "silhouettes"])
    with pytest.raises(error, match=words):
        build_nlp(prepared.problem, compile="always")


def test_no_word_where_compiling_would_not_pay(
    prepared: Prepared, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "cache").write_text("a file")
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(compiled, "_pays", lambda *_: False)
    assert build_nlp(prepared.problem, compile="auto").compiler_fault == ""


def test_compiling_needs_a_compiler(
    problem: ConstrainedProblem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(tmp_path))
    monkeypatch.setattr("impact_posture.system.toolchain.find_compiler", lambda: None)
    with pytest.raises(CompilerError, match="no C compiler"):
        build_nlp(problem, compile="always")


def test_a_mode_that_does_not_exist_is_refused(problem: ConstrainedProblem) -> None:
    with pytest.raises(InputError, match="compile: no mode 'off'; choose from auto, always, never"):
        build_nlp(problem, compile="off")  # type: ignore[arg-type]


def test_one_thread_within_and_as_before_after() -> None:
    """The limit of one thread applies to the BLAS libraries of NumPy, SciPy and IPOPT."""
    with one_blas_thread():
        pass  # all BLAS libraries are loaded now
    libraries = threadpoolctl.ThreadpoolController().lib_controllers
    assert libraries
    if list(Path(ca.__file__).parent.glob("libcasadi-tp-openblas*")):
        assert "casadi_openblas" in {library.internal_api for library in libraries}
    before = [library.num_threads for library in libraries]
    try:
        for library in libraries:
            library.set_num_threads(2)
        with pytest.raises(KeyboardInterrupt), one_blas_thread():
            assert [library.num_threads for library in libraries] == [1] * len(libraries)
            raise KeyboardInterrupt
        assert [library.num_threads for library in libraries] == [2] * len(libraries)
    finally:
        # Restore the numbers of threads, because waiting threads would slow down later tests.
        for library, count in zip(libraries, before, strict=True):
            library.set_num_threads(count)


def test_compilers_run_beside_each_other_and_none_stays(tmp_path: Path) -> None:
    """The first failure is reported; compilers that still run are killed, together with their child processes."""
    marks = [tmp_path / name for name in ("child", "never")]
    slow = ["sh", "-c", f"(sleep 3; touch {marks[0]}) & sleep 3; touch {marks[1]}", "-o", "slow.o"]
    began = time.perf_counter()
    with pytest.raises(CompilerError, match="error: what is wrong"):
        run_compilers([["sh", "-c", "echo 'error: what is wrong' >&2; exit 1", "-o", "first.o"], slow], tmp_path)
    assert time.perf_counter() - began < 2
    time.sleep(3.2)
    assert not any(mark.exists() for mark in marks)


def test_a_compiler_that_does_not_start_is_named(tmp_path: Path) -> None:
    with pytest.raises(CompilerError, match="no-such-compiler"):
        run_compilers([["no-such-compiler", "-o", "x.o"]], tmp_path)
