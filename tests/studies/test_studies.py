"""The benchmarks: numbers are right before they are timed, operations counted, pages theirs.  Never how fast."""

from __future__ import annotations

import re
import sys
from collections import Counter
from importlib import import_module
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from docs.studies import build as building
from docs.studies.__main__ import main
from docs.studies.build import build
from docs.studies.cases import CASES
from docs.studies.core import ROOT, STUDIES, page_of
from docs.studies.exported import _FEET, _LOADED
from docs.studies.kernel import peers, pinocchio
from docs.studies.kernel.counts import of_export, of_function, total
from docs.studies.kernel.floor import floor
from docs.studies.kernel.harness import Absent, Disagreement, Harness, Samples
from docs.studies.kernel.times import PEERS, ROBOTS, Report, lines, measure
from docs.studies.solve import TARGETS_MS
from docs.studies.tsid import GOALS
from impact_posture.codegen.export import export
from impact_posture.errors import CompilerError
from impact_posture.robot.robot_loader import known_robots, load_robot
from tests.support import tools
from tests.support.helpers import robot
from tests.support.tools import need_compiler

OPTIMIZED = True

LINK = (
    '<link name="{0}"><inertial><origin xyz="0.1 0.02 0.05"/><mass value="1.5"/>'
    '<inertia ixx="0.02" ixy="0.001" ixz="0" iyy="0.03" iyz="0" izz="0.025"/></inertial></link>'
)
JOINT = (
    '<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/><origin xyz="0.3 0 0.1" rpy="0.4 0 0"/>'
    '<axis xyz="{4}"/><limit lower="-1" upper="1" effort="9" velocity="3"/></joint>'
)


def arm(folder: Path, first: str) -> Samples:
    """A turning, a sliding and another turning joint."""
    parts = [LINK.format(name) for name in ("base", "upper", "rail", "tip")]
    parts += [
        JOINT.format("shoulder", first, "base", "upper", "0 1 0"),
        JOINT.format("slide", "prismatic", "upper", "rail", "1 0 0"),
        JOINT.format("wrist", "revolute", "rail", "tip", "0 0 1"),
    ]
    path = folder / f"{first}.urdf"
    path.write_text(f'<robot name="{first}">{"".join(parts)}</robot>')
    return Samples(load_robot(str(path)), "tip")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What is built is built once."""
    return tmp_path_factory.mktemp("benchmarks")


@pytest.fixture(autouse=True)
def own_cache(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(folder / "cache"))


def groups(report: Report) -> set[str]:
    return {kernel.group for kernel, _, _ in report.rows}


# ---- numbers before times ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("first", ["revolute", "continuous"])
def test_all_ways_agree_before_they_are_timed(folder: Path, first: str) -> None:
    need_compiler()
    samples = arm(folder, first)
    report = measure(samples, 1, ("same graph", "casadi"))
    assert report.skipped == []
    assert groups(report) == {"ours", "differences", "same graph", "casadi"}
    for kernel, times, error in report.rows:
        assert 0 < error < (1e-5 if kernel.group == "differences" else 1e-6), kernel.name
        assert all(time > 0 for time in times.values())
        assert set(times) == set(kernel.functions)
        assert "-ffp-contract=fast" in kernel.built.flags
    ours, same = ([k.built.flags for k, _, _ in report.rows if k.group == group] for group in ("ours", "same graph"))
    # The same compiler and options: what differs is who printed the C.
    assert ours == same
    assert samples.plain == (first == "revolute")
    assert re.fullmatch(r"\d+\.\d \(\d+\.\d\)", report.compared("CasADi", ""))
    assert report.compared("ADAM", "") == "–"


def test_another_mass_matrix_is_left_out(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    need_compiler()
    right = peers.solved
    monkeypatch.setattr(peers, "solved", lambda M, force: 1.001 * right(M, force))
    report = measure(arm(folder, "revolute"), 1, ("casadi",))
    assert groups(report) == {"ours", "differences"}
    assert len(report.skipped) == 2
    assert all("differ from Pinocchio's by 1.0e-03" in words for words in report.skipped)


def test_no_time_for_a_wrong_build_of_ours(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    need_compiler()

    def wrong(self: Harness, kernel: object) -> float:
        raise Disagreement("its numbers differ")

    monkeypatch.setattr(Harness, "difference", wrong)
    with pytest.raises(CompilerError, match="ours -O2: its numbers differ"):
        measure(arm(folder, "revolute"), 1, ())


def test_peers_that_are_not_installed_are_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    need_compiler()
    monkeypatch.setattr(pinocchio, "eigen_headers", lambda: None)
    monkeypatch.setitem(sys.modules, "adam", None)
    report = measure(arm(folder, "revolute"), 1, ("pinocchio", "adam"))
    assert "Eigen" in report.skipped[0]
    assert "pip install adam-robotics" in report.skipped[1]
    assert groups(report) == {"ours", "differences"}


def test_joints_that_peers_do_not_do(folder: Path) -> None:
    with pytest.raises(Absent, match="joints of type"):
        pinocchio.model_arrays(arm(folder, "continuous").robot.model)
    parents, kinds, *_ = pinocchio.model_arrays(robot("solo8").model)
    assert list(kinds[:3]) == [8, 1, 1] and list(parents[:3]) == [0, 1, 2]
    assert Samples(robot("solo8"), "base_link").plain


def test_what_was_built_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    compiler = need_compiler()
    sources = {"one.c": "int one(void) { return 1; }"}
    first = build(sources, compiler, ["-O1"])
    monkeypatch.setattr(building, "run_compiler", lambda *arguments: pytest.fail("compiled again"))
    again = build(sources, compiler, ["-O1"])
    assert again.library.one() == 1
    assert (again.flags, again.compile_s) == (first.flags, first.compile_s)


def test_tools_are_where_they_are_said_to_be(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "Eigen").mkdir()
    (tmp_path / "Eigen" / "Cholesky").touch()
    monkeypatch.setenv("EIGEN3_INCLUDE_DIR", str(tmp_path))
    assert tools.eigen_headers() == tmp_path
    monkeypatch.setenv("CXX", f"{sys.executable} -O0")
    assert tools.cxx_compiler() == [sys.executable, "-O0"]


# ---- operations -------------------------------------------------------------------------------------------------


def test_operations_of_a_function() -> None:
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    function = ca.Function("f", [x, y], [ca.sin(x) * y - x / y + x**2, -(x + y)])
    assert of_function(function) == Counter(add=3, mul=2, div=1, trig=1, neg=1)
    assert total(of_function(function)) == 7


def written(text: str, name: str) -> Counter[str]:
    """Operators in the text of a C function and of the blocks that it calls."""
    bodies = dict(re.findall(r"^\S.*?\b(\w+)\([^;]*?\)\n\{(.*?)^\}", text, re.M | re.S))
    called = [word for word in re.findall(r"\w+", bodies[name]) if word.startswith("k_block")]
    plain = re.sub(r"\[[^]]*\]|for \([^)]*\)", "", "".join(bodies[part] for part in [name, *called]))
    plain = re.sub(r"(\d)e[+-](\d)", r"\1\2", plain)
    found = Counter(re.findall(r"(?<=[\w)])\s*([-+*/])(?!=)", plain))
    return Counter(add=found["+"] + found["-"], mul=found["*"], div=found["/"])


@pytest.mark.parametrize(("name", "frame"), [("ur5", "tool0"), ("solo8", "base_link")])
def test_own_operations_are_those_of_the_text(tmp_path: Path, name: str, frame: str) -> None:
    """The portable C has the same arithmetic on single numbers; sums may be in another order."""
    samples = Samples(robot(name), frame)
    export(samples.objective, tmp_path, prefix="k", check=False, portable=True)
    text, (found, packed) = written((tmp_path / "k.c").read_text(), "k_eval"), of_export(samples.objective)
    for kind in ("add", "mul", "div"):
        assert found[kind] == pytest.approx(text[kind], rel=0.02), kind
    # Sines and cosines are a loop there.
    assert found["trig"] == 2 * (samples.robot.nv - (6 if samples.robot.floating else 0))
    assert (packed is None) == (name == "ur5")
    assert packed is None or 0.2 * total(found) < packed < 0.6 * total(found)


@pytest.mark.parametrize("name", ["solo8", "tilthex_arm", "panda"])
def test_floor_is_near_what_is_done(name: str) -> None:
    """The yardstick is of the right size: the export is neither far above nor far below it."""
    samples = Samples(robot(name), robot(name).spec.contact.frame or "")
    assert 0.5 < total(of_export(samples.objective)[0]) / floor(samples.robot, samples.point.joint) < 1.3


# ---- cases, studies, pages --------------------------------------------------------------------------------------


def test_lists_in_step() -> None:
    assert set(ROBOTS) <= set(known_robots())
    assert set(TARGETS_MS) | set(GOALS) | set(_FEET) | set(_LOADED) <= set(CASES)
    shown = (ROOT / "docs" / "reference" / "bench.md").read_text(encoding="utf-8")
    for name in [*STUDIES, *PEERS, *pinocchio.FORMULATIONS]:
        assert re.search(rf"^\|.*\b{name}\b", shown, re.M), name


def test_a_case_is_what_optimize_poses() -> None:
    problem = CASES["solo8, four feet, cone 20°"].problem()
    assert (problem.robot.name, problem.objective.contact.frame) == ("solo8", "base_link")
    assert len(problem.objective.supports) == 4
    assert problem.objective.normal_cone_deg == 20.0
    np.testing.assert_allclose(problem.objective.contact.normal, [1, 0, 0])


@pytest.mark.parametrize("name", list(STUDIES))
def test_studies_write_their_pages(name: str) -> None:
    study = STUDIES[name]
    module, _, function = study.source.partition(":")
    assert callable(getattr(import_module(f"docs.studies.{module}"), function or "lines"))
    assert page_of(name).is_file() == study.page
    if study.page:
        assert page_of(name).read_text(encoding="utf-8").startswith(study.head + "\n\n")
    if study.target:
        assert f"docs.studies {name}" in (ROOT / "Makefile").read_text(encoding="utf-8")


def test_the_program_prints_and_refuses(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sys.argv", ["benchmarks", "loader", "--only", "panda", "--count", "1"])
    need_compiler()
    assert main() == 0
    assert re.search(r"^\| panda( \| \d+\.\d\d){3} \|$", capsys.readouterr().out, re.M)
    for wrong in (
        ["kernel", "--only", "panda", "--write"],
        ["loader", "--write"],
        ["kernel", "--count", "0"],
        ["no"],
    ):
        monkeypatch.setattr("sys.argv", ["benchmarks", *wrong])
        with pytest.raises(SystemExit) as stopped:
            main()
        assert stopped.value.code == 2


def test_a_page_of_the_kernel(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    need_compiler()
    from docs.studies.core import Request

    monkeypatch.setattr("docs.studies.kernel.times.PEERS", {})
    monkeypatch.setattr(measure, "__defaults__", ((),))
    text = "\n".join(lines(Request(only="tilthex", count=1)))
    assert "**tilthex_arm** at `ee`: nq 10, nv 9" in text
    assert re.search(r"^\| floor \|.* 1159 \|", text, re.M)
    assert "| the same graph, printed by CasADi | – |" in text
