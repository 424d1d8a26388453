"""The library's own rules: floors import downward, nothing prints, everything public explains itself."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
LIBRARY = ROOT / "impact_posture"
FILES = sorted(LIBRARY.rglob("*.py"))
APPS = sorted((ROOT / "cli").rglob("*.py"))
NAMES = [p.relative_to(ROOT).as_posix() for p in FILES]

# From the ground up; packages of one row do not import each other.
FLOORS = [
    {"errors", "processes"}, {"folder", "toolchain"}, {"robot"}, {"dynamics"}, {"impact"}, {"posture", "codegen"},
    {"tsid"}, {"simulation", "sweep", "plot", "verification", "benchmark"}, {"job", "experiment"},
]  # fmt: skip
LEVEL = {package: level for level, row in enumerate(FLOORS) for package in row}
# The online part runs where no CasADi is, and stands on these.
WITHOUT_CASADI = ("errors", "processes", "folder", "toolchain", "robot", "tsid")


def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def imports(path: Path) -> Iterator[tuple[int, str]]:
    """Every module that a file imports, wherever in it, relative imports resolved."""
    package = path.relative_to(ROOT).with_suffix("").parts[:-1]
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            module = ".".join(part for part in (base, node.module or "") if part)
            if module == "impact_posture":
                yield from ((node.lineno, f"{module}.{alias.name}") for alias in node.names)
            else:
                yield node.lineno, module


def package_of(path: Path) -> str:
    return path.relative_to(LIBRARY).parts[0].removesuffix(".py")


def test_every_package_has_its_floor() -> None:
    found = {package_of(path) for path in FILES} - {"__init__"}
    assert found <= set(LEVEL), f"give these a floor in this test and in the design: {found - set(LEVEL)}"
    assert found >= {"errors", "robot", "dynamics", "impact", "posture", "codegen", "tsid", "plot"}


@pytest.mark.parametrize("name", NAMES)
def test_imports_go_down(name: str) -> None:
    own = package_of(ROOT / name)
    for line, module in imports(ROOT / name):
        parts = module.split(".")
        assert parts[0] not in ("impact_posture_cli", "cli"), f"{name}:{line} imports the command line"
        if parts[0] != "impact_posture" or len(parts) == 1 or parts[1] not in LEVEL or own == "__init__":
            continue
        lower = LEVEL[parts[1]] < LEVEL[own]
        assert lower or parts[1] == own, f"{name}:{line}: {own} imports {module}, which is not below it"


@pytest.mark.parametrize("name", NAMES)
def test_casadi_only_where_there_are_expressions(name: str) -> None:
    if package_of(ROOT / name) in WITHOUT_CASADI:
        used = {module.partition(".")[0] for _, module in imports(ROOT / name)}
        assert not used & {"casadi"}, name


@pytest.mark.parametrize("name", NAMES)
def test_the_library_is_silent_and_shows_nothing(name: str) -> None:
    for node in ast.walk(tree(ROOT / name)):
        if not isinstance(node, ast.Call):
            continue
        called = ast.unparse(node.func)
        assert called not in ("print", "pprint", "exit", "quit", "sys.exit"), f"{name}:{node.lineno} {called}"
        assert not called.endswith((".show", "stdout.write", "stderr.write")), f"{name}:{node.lineno} {called}"
        assert called not in ("os.chdir", "np.set_printoptions", "logging.basicConfig"), f"{name}:{node.lineno}"


@pytest.mark.parametrize("name", NAMES)
def test_no_assert_for_users(name: str) -> None:
    """``python -O`` drops asserts: they may narrow a type, but what a user can do wrong is an exception."""
    for node in ast.walk(tree(ROOT / name)):
        if isinstance(node, ast.Assert):
            parts = node.test.values if isinstance(node.test, ast.BoolOp) else [node.test]
            narrowing = all(ast.unparse(part).endswith("is not None") for part in parts)
            assert narrowing, f"{name}:{node.lineno}: {ast.unparse(node)}"


def public(body: list[ast.stmt], prefix: str = "") -> Iterator[tuple[str, ast.AST]]:
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            yield prefix + node.name, node
            if isinstance(node, ast.ClassDef):
                yield from public(node.body, f"{prefix}{node.name}.")


@pytest.mark.parametrize("path", [*FILES, *APPS], ids=lambda p: p.relative_to(ROOT).as_posix())
def test_everything_public_has_a_docstring(path: Path) -> None:
    module = tree(path)
    if module.body:
        assert ast.get_docstring(module), f"{path.name} has no docstring"
    silent = [
        name
        for name, node in public(module.body)
        if not ast.get_docstring(node)  # type: ignore[arg-type]
        and not any(ast.unparse(d).endswith((".setter", "overload")) for d in getattr(node, "decorator_list", []))
    ]
    assert not silent, f"{path.name}: no docstring on {silent}"


@pytest.mark.parametrize("path", [*FILES, *APPS], ids=lambda p: p.relative_to(ROOT).as_posix())
def test_files_are_short(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) < 500


MACHINE = re.compile(r"(?<![\w.:/$~}])/(?:home|root|work|tmp|Users|opt|mnt|usr/(?!bin/env))(?=/[\w.])|[A-Z]:\\\\")
TEXTS = sorted(
    path
    for pattern in ("*", "impact_posture/**/*", "cli/**/*", "robots/**/*", "docs/**/*", "tests/**/*")
    for path in ROOT.glob(pattern)
    if path.suffix in {".py", ".toml", ".md", ".urdf", ".srdf", ".json", ".yaml", ".txt", ".c", ".h", ".in"}
    and path.resolve() != Path(__file__).resolve()
    and not {"_build", "__pycache__"} & set(path.parts)
)


@pytest.mark.parametrize("path", TEXTS, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_no_path_of_one_machine(path: Path) -> None:
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        assert not MACHINE.search(line), f"{path.name}:{number}: {line.strip()}"


@pytest.mark.parametrize("bad", ["x = '/home/someone/a.urdf'", "see /tmp/scratch/a", r"C:\\Users", "'/root/.ssh/k'"])
def test_the_machine_path_pattern_finds_them(bad: str) -> None:
    assert MACHINE.search(bad)


@pytest.mark.parametrize("good", ["https://a.b/home/x", "m/s, N·m/work", "robots/tmp/x", "$ROOT/opt/x"])
def test_the_machine_path_pattern_spares_others(good: str) -> None:
    assert not MACHINE.search(good)
