"""Benchmarks: numbers are checked before timing, operations are counted, and each study has its page."""

from __future__ import annotations

import re
import shutil
import sys
from collections import Counter
from importlib import import_module
from pathlib import Path

import casadi as ca
import pytest

from docs.studies import build as building
from docs.studies import strikes
from docs.studies.__main__ import main
from docs.studies.build import build
from docs.studies.cases import CASES
from docs.studies.core import ROOT, STUDIES, Request, page_of, renewed
from docs.studies.exported import _FEET, _LOADED
from docs.studies.kernel import peers, pinocchio
from docs.studies.kernel.counts import of_export, of_function, total
from docs.studies.kernel.floor import floor
from docs.studies.kernel.harness import Absent, Disagreement, Harness, Samples
from docs.studies.kernel.times import PEERS, ROBOTS, Report, lines, measure
from docs.studies.solve import TARGETS_MS
from docs.studies.tsid import GOALS
from impact_posture.codegen.export import export
from impact_posture.errors import CompilerError, InputError
from impact_posture.robot.robot_loader import known_robots, load_robot
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
    """Load an arm with a revolute, a prismatic and another revolute joint."""
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
    """Return a cache folder, so that code is compiled only once."""
    return tmp_path_factory.mktemp("benchmarks")


@pytest.fixture(autouse=True)
def own_cache(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(folder / "cache"))


def groups(report: Report) -> set[str]:
    return {kernel.group for kernel, _, _ in report.rows}


# ---- numerical checks before timing -----------------------------------------------------------------------------


def test_implementations_are_checked_before_they_are_timed(folder: Path) -> None:
    need_compiler()
    report = measure(arm(folder, "revolute"), 1, ("same graph", "casadi"))
    assert report.skipped == []
    assert groups(report) == {"ours", "differences", "same graph", "casadi"}
    for kernel, times, error in report.rows:
        assert 0 < error < (1e-5 if kernel.group == "differences" else 1e-6), kernel.name
        assert all(time > 0 for time in times.values())
        assert set(times) == set(kernel.functions)
        assert "-ffp-contract=fast" in kernel.built.flags
    ours, same = ([k.built.flags for k, _, _ in report.rows if k.group == group] for group in ("ours", "same graph"))
    # Only the printer of the C code differs; compiler and options are the same.
    assert ours == same
    assert re.fullmatch(r"\d+\.\d \(\d+\.\d\)", report.compared("CasADi", ""))
    assert report.compared("ADAM", "") == "–"


def test_wrong_numbers_are_left_out(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    need_compiler()
    right = peers.solved
    monkeypatch.setattr(peers, "solved", lambda M, force: 1.001 * right(M, force))
    report = measure(arm(folder, "revolute"), 1, ("casadi",))
    assert groups(report) == {"ours", "differences"}
    assert len(report.skipped) == 2
    assert all("differ from Pinocchio's by 1.0e-03" in words for words in report.skipped)


def test_wrong_numbers_of_the_export_are_an_error(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    need_compiler()

    def wrong(self: Harness, kernel: object) -> float:
        raise Disagreement("its numbers differ")

    monkeypatch.setattr(Harness, "difference", wrong)
    with pytest.raises(CompilerError, match="ours -O2: its numbers differ"):
        measure(arm(folder, "revolute"), 1, ())


def test_missing_peers_are_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    need_compiler()
    monkeypatch.setattr(pinocchio, "eigen_headers", lambda: None)
    monkeypatch.setitem(sys.modules, "adam", None)
    report = measure(arm(folder, "revolute"), 1, ("pinocchio", "adam"))
    assert "Eigen" in report.skipped[0]
    assert "pip install adam-robotics" in report.skipped[1]
    assert groups(report) == {"ours", "differences"}


def test_joints_that_peers_lack_are_refused(folder: Path) -> None:
    continuous = arm(folder, "continuous")
    assert not continuous.plain
    with pytest.raises(Absent, match="joints of type"):
        pinocchio.model_arrays(continuous.robot.model)
    parents, kinds, *_ = pinocchio.model_arrays(robot("solo8").model)
    assert list(kinds[:3]) == [8, 1, 1] and list(parents[:3]) == [0, 1, 2]
    assert Samples(robot("solo8"), "base_link").plain


def test_the_page_of_a_gpu_is_not_written_without_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda tool: None)
    with pytest.raises(InputError, match=r"no nvidia-smi, nvcc, gcc; .* copy .* to a machine with a GPU"):
        next(STUDIES["gpu"].lines(Request(write=True)))


def test_compiled_code_is_cached(monkeypatch: pytest.MonkeyPatch) -> None:
    compiler = need_compiler()
    sources = {"one.c": "int one(void) { return 1; }"}
    first = build(sources, compiler, ["-O1"])
    monkeypatch.setattr(building, "run_compiler", lambda *arguments: pytest.fail("compiled again"))
    again = build(sources, compiler, ["-O1"])
    assert again.library.one() == 1
    assert (again.flags, again.compile_s) == (first.flags, first.compile_s)


# ---- operations -------------------------------------------------------------------------------------------------


def test_operations_of_a_function() -> None:
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    function = ca.Function("f", [x, y], [ca.sin(x) * y - x / y + x**2, -(x + y)])
    assert of_function(function) == Counter(add=3, mul=2, div=1, trig=1, neg=1)
    assert total(of_function(function)) == 7


def written(text: str, name: str) -> Counter[str]:
    """Count the operators in the text of a C function and of the blocks that the function calls."""
    bodies = dict(re.findall(r"^\S.*?\b(\w+)\([^;]*?\)\n\{(.*?)^\}", text, re.M | re.S))
    called = [word for word in re.findall(r"\w+", bodies[name]) if word.startswith("k_block")]
    plain = re.sub(r"\[[^]]*\]|for \([^)]*\)", "", "".join(bodies[part] for part in [name, *called]))
    plain = re.sub(r"(\d)e[+-](\d)", r"\1\2", plain)
    operators = Counter(re.findall(r"(?<=[\w)])\s*([-+*/])(?!=)", plain))
    return Counter(add=operators["+"] + operators["-"], mul=operators["*"], div=operators["/"])


@pytest.mark.parametrize(("name", "frame"), [("ur5", "tool0"), ("solo8", "base_link")])
def test_counted_operations_agree_with_the_source(tmp_path: Path, name: str, frame: str) -> None:
    """The portable C code has the same operations on scalars, but may add in another order."""
    samples = Samples(robot(name), frame)
    export(samples.objective, tmp_path, prefix="k", check=False, portable=True)
    text, (counted, packed) = written((tmp_path / "k.c").read_text(), "k_eval"), of_export(samples.objective)
    for kind in ("add", "mul", "div"):
        assert counted[kind] == pytest.approx(text[kind], rel=0.02), kind
    # The C code computes all sines and cosines in one loop.
    assert counted["trig"] == 2 * (samples.robot.nv - samples.robot.first_joint)
    assert (packed is None) == (name == "ur5")
    assert packed is None or 0.2 * total(counted) < packed < 0.6 * total(counted)


@pytest.mark.parametrize("name", ["solo8", "tilthex_arm", "panda"])
def test_the_export_needs_about_the_operations_of_the_floor(name: str) -> None:
    samples = Samples(robot(name), robot(name).spec.contact.frame or "")
    assert 0.5 < total(of_export(samples.objective)[0]) / floor(samples.robot, samples.point.joint) < 1.3


# ---- cases, studies, pages --------------------------------------------------------------------------------------


def test_lists_and_page_name_the_same_cases() -> None:
    assert set(ROBOTS) <= set(known_robots())
    assert set(TARGETS_MS) | set(GOALS) | set(_FEET) | set(_LOADED) <= set(CASES)
    shown = (ROOT / "docs" / "reference" / "bench.md").read_text(encoding="utf-8")
    for name in [*STUDIES, *PEERS, *pinocchio.FORMULATIONS]:
        assert re.search(rf"^\|.*\b{name}\b", shown, re.M), name


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
    for wrong in ("kernel --only panda --write", "loader --write", "kernel --count 0", "no"):
        monkeypatch.setattr("sys.argv", ["benchmarks", *wrong.split()])
        with pytest.raises(SystemExit) as stopped:
            main()
        assert stopped.value.code == 2


def test_a_page_keeps_the_sections_that_a_study_does_not_renew() -> None:
    page, part = "intro\n\n### a\n\n1\n\n### b\n\n2\n", "intro\n\n### c, 1 m/s\n\n4\n\n### a\n\n3\n"
    assert renewed(page, part) == "intro\n\n### a\n\n3\n\n### b\n\n2\n\n### c, 1 m/s\n\n4\n"
    assert renewed(page, page) == page
    with pytest.raises(ValueError, match="renew all"):
        renewed(page, "another" + part)
    shown = page_of("strikes").read_text(encoding="utf-8")
    assert renewed(shown, shown) == shown


def test_the_page_of_the_kernel_has_its_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    need_compiler()
    monkeypatch.setattr(measure, "__defaults__", ((),))
    text = "\n".join(lines(Request(only="tilthex", count=1)))
    assert "**tilthex_arm** at `ee`: nq 10, nv 9" in text and "| the same graph, printed by CasADi | – |" in text
    assert re.search(r"^\| floor \|.* 1159 \|", text, re.M)


def test_a_strike_beyond_a_bar_is_named_in_its_row() -> None:
    def row(**changed: float) -> list[str]:
        contact = {"speed": 0.01, "instant": -0.002, "saturated": 0.0, "ratio": 1.1, "jump": 3.0}
        runs = [
            {"status": "completed", "why": "", "plan": None, "contact": part} for part in (contact, contact | changed)
        ]
        return strikes._row("strike", runs, [6.0])

    assert row()[-3:] == ["0.50", "2 of 2", "none"] and row()[1] == "+1.0 (+1.0)"
    for changed in ({"speed": -0.06}, {"instant": 0.011}, {"saturated": 0.001}, {"ratio": 0.84}):
        assert row(**changed)[-1] == next(iter(changed))
    assert strikes._row("strike", [{"status": "fell", "contact": None}], [6.0])[-1].endswith("completed")
