"""``impact-posture bench``: what it prints, what it refuses, what it leaves out and says so.  Never how fast."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any, get_args

import pytest

from impact_posture.benchmark import dense, measure, pinocchio
from impact_posture.benchmark.case import Case
from impact_posture.benchmark.count import Operations
from impact_posture.benchmark.measure import DEFAULT_ROBOTS, PEERS
from impact_posture.benchmark.report import BenchReport
from impact_posture.benchmark.timing import Disagreement, Harness
from impact_posture.benchmark.workbench import Absent, Workbench
from impact_posture.errors import CompilerError, InputError
from impact_posture.robot.robot_loader import known_robots, load_robot
from impact_posture_cli.commands.bench import PeerName
from tests.command import run
from tests.helpers import robot
from tests.tools import need_compiler

ROOT = Path(__file__).parents[1]
LINK = (
    '<link name="{0}"><inertial><origin xyz="0.1 0.02 0.05"/><mass value="1.5"/>'
    '<inertia ixx="0.02" ixy="0.001" ixz="0" iyy="0.03" iyz="0" izz="0.025"/></inertial></link>'
)
JOINT = (
    '<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/><origin xyz="0.3 0 0.1" rpy="0.4 0 0"/>'
    '<axis xyz="{4}"/><limit lower="-1" upper="1" effort="9" velocity="3"/></joint>'
)
ROW = {
    "name", "group", "what", "eval_us", "value_us", "batch_us", "ratio", "operations", "source_kb", "eval_kb",
    "compile_s", "flags", "difference",
}  # fmt: skip


def arm(folder: Path, first: str) -> Path:
    """A turning, a sliding and another turning joint, in a folder with a robot.toml of its own."""
    parts = [LINK.format(name) for name in ("base", "upper", "rail", "tip")]
    parts += [
        JOINT.format("shoulder", first, "base", "upper", "0 1 0"),
        JOINT.format("slide", "prismatic", "upper", "rail", "1 0 0"),
        JOINT.format("wrist", "revolute", "rail", "tip", "0 0 1"),
    ]
    path = folder / first / "arm.urdf"
    path.parent.mkdir()
    path.with_name("robot.toml").write_text(f'name = "{first}"\n[contact]\nframe = "tip"\n')
    path.write_text(f'<robot name="{first}">{"".join(parts)}</robot>')
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two arms; what is built for them is built once."""
    made = tmp_path_factory.mktemp("bench")
    arm(made, "revolute")
    arm(made, "continuous")
    return made


@pytest.fixture(autouse=True)
def own_cache(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(folder / "cache"))


def bench(folder: Path, *arguments: str, **more: str) -> subprocess.CompletedProcess[str]:
    return run("bench", *arguments, cwd=folder, env=more)


def measured(path: Path, *peers: str, said: list[str] | None = None) -> BenchReport:
    loaded = load_robot(str(path))
    say = (lambda _: None) if said is None else said.append
    return measure.measure(loaded, "tip", peers, 1, say=say)  # type: ignore[arg-type]


# ---- what it prints ---------------------------------------------------------------------------------------------


def test_json_document(folder: Path) -> None:
    need_compiler()
    asked = ("revolute/arm.urdf", "continuous/arm.urdf", "--peers", "differences,casadi", "--rounds", "2", "--json")
    done = bench(folder, *asked)
    assert (done.returncode, done.stderr) == (0, "")
    document: dict[str, Any] = json.loads(done.stdout)
    assert document["schema"] == "impact-posture/bench/1"
    about = document["machine"]
    assert {"processor", "architecture", "cores", "load", "compiler", "python", "casadi", "pinocchio"} == set(about)
    assert [r["robot"] for r in document["robots"]] == ["revolute", "continuous"]
    for found, nq in zip(document["robots"], (3, 4), strict=True):
        assert (found["frame"], found["nq"], found["nv"], found["rounds"]) == ("tip", nq, 3, 2)
        assert (found["skipped"], found["notes"]) == ([], [])
        rows = {row["name"]: row for row in found["rows"]}
        assert {"ours -O2", "ours -O3 native", "differences", "CasADi -O2", "CasADi -O3 native"} <= set(rows)
        assert all(set(row) == ROW for row in rows.values())
        for row in rows.values():
            mine = row["group"] == "ours"
            assert row["eval_us"] > 0 and row["compile_s"] > 0
            assert row["difference"] < (1e-5 if row["group"] == "differences" else 1e-6)
            assert (row["value_us"] is not None) == (row["batch_us"] is not None) == mine
            assert "-ffp-contract=fast" in row["flags"]
        own = [row for row in rows.values() if row["group"] == "ours"]
        assert min(row["ratio"] for row in own) == 1.0
        best = min(row["eval_us"] for row in own)
        assert rows["CasADi -O2"]["ratio"] == pytest.approx(rows["CasADi -O2"]["eval_us"] / best)
        assert [c["against"] for c in found["comparisons"]] == ["casadi", "differences"]
        assert all(row["eval_kb"] < row["source_kb"] for row in own)
    assert document["robots"][0]["floor"]["total"] > 0
    assert document["robots"][1]["floor"] is None


def test_table_fits_and_the_second_run_compiles_nothing(folder: Path) -> None:
    need_compiler()
    asked = ("revolute/arm.urdf", "--frame", "rail", "--armature", "none", "--peers", "none", "--rounds", "1")
    first, second = bench(folder, *asked), bench(folder, *asked)
    assert (first.returncode, second.returncode) == (0, 0)
    assert "compiling ours -O2" in first.stderr and "revolute: timing" in first.stderr
    assert "compiling" not in second.stderr and "revolute: timing" in second.stderr
    assert all(len(line) <= 80 for line in first.stdout.splitlines())
    for word in ("revolute at rail", "H, ∇H µs", "ours -O2", "floor", "-std=c99 -O2"):
        assert word in first.stdout
    quiet = bench(folder, *asked, "--quiet")
    assert (quiet.returncode, quiet.stderr) == (0, "") and "ours -O2" in quiet.stdout


def test_numbers_of_wide_tables_fit(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The longest names with numbers of a humanoid."""
    from impact_posture.benchmark.report import BenchRow
    from impact_posture_cli.commands.bench import _flags, _show
    from impact_posture_cli.output import Page

    names = [*pinocchio.FORMULATIONS, "CasADi -O3 native", "ADAM -O3 native"]
    count = Operations(30000, 30000, 900, 76)
    rows = [BenchRow("ours -O2", "ours", "", 9.999, 9.999, 9.999, 1.0, count, 9999.0, 999.0, 99.9, "cc", 0.0)]
    flags = "c++ -std=c++17 -DBOOST_MPL_LIMIT_LIST_SIZE=30"
    rows += [
        BenchRow(name, "pinocchio", "", 999.999, 99.999, None, 999.99, count, 9999.0, 999.0, 999.9, flags, 0.0)
        for name in names
    ]
    report = BenchReport("talos", "gripper_right_base_link", 39, 38, 256, 101, 1, tuple(rows), (), (), count)
    page = Page()
    page.console.width = 80
    _show(page, report)
    _flags(page, [report])
    printed = capsys.readouterr().out
    lines = [line for line in printed.splitlines() if line.startswith(tuple(names)) and "999" in line]
    assert len(lines) == len(names), printed
    assert all(len(line.rstrip()) <= 80 and line.rstrip().endswith("999.9") for line in lines), printed
    assert flags in " ".join(printed.split()) and all(len(line) <= 80 for line in printed.splitlines())


# ---- what it refuses --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (("ur5", "--peers", "rbdl"), 2, "no peer 'rbdl'"),
        (("ur5", "--peers", ""), 2, "no peer ''"),
        (("ur5", "--rounds", "0"), 2, "--rounds"),
        (("ur5", "--patience", "0"), 2, "--patience"),
        (("ur5", "--patience", "nan"), 2, "--patience"),
        (("--frame", "tool0"), 2, "Name one ROBOT"),
        (("ur5", "z1", "--root", "fixed"), 2, "Name one ROBOT"),
        (("ur6",), 1, "ur5"),
        (("ur5", "--frame", "tool1"), 1, "tool0"),
        (("revolute/arm.urdf", "--frame", "base"), 1, "base"),
    ],
)
def test_refusals(folder: Path, arguments: tuple[str, ...], code: int, words: str) -> None:
    done = bench(folder, *arguments, "--json")
    assert done.returncode == code
    assert words in done.stderr and "Traceback" not in done.stderr
    assert json.loads(done.stdout)["error"]["code"] == code
    if code == 1:
        assert len(done.stderr.splitlines()) == 1


def test_without_a_compiler(folder: Path) -> None:
    done = bench(folder, "revolute/arm.urdf", "--peers", "none", PATH="", CC="")
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith("error: bench: no C compiler found")
    assert "Traceback" not in done.stderr


def test_the_library_refuses_too(folder: Path) -> None:
    loaded = load_robot(str(folder / "revolute/arm.urdf"))
    with pytest.raises(InputError, match="no peer 'rbdl'"):
        measure.measure(loaded, "tip", ("rbdl",))  # type: ignore[arg-type]
    with pytest.raises(InputError, match="--rounds"):
        measure.measure(loaded, "tip", (), 0)
    with pytest.raises(InputError, match="--patience"):
        measure.measure(loaded, "tip", (), 1, float("nan"))


# ---- what it leaves out -----------------------------------------------------------------------------------------


def test_peers_that_are_not_installed_are_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    need_compiler()

    def nowhere() -> Path:
        raise Absent("no Eigen headers (pip install cmeel-eigen, or set EIGEN3_INCLUDE_DIR)")

    monkeypatch.setattr(pinocchio, "eigen_headers", nowhere)
    monkeypatch.setitem(sys.modules, "adam", None)
    report = measured(folder / "revolute/arm.urdf", "pinocchio", "adam")
    reasons = {left.name: left.reason for left in report.skipped}
    assert set(reasons) == {"pinocchio", "adam"}
    assert "cmeel-eigen" in reasons["pinocchio"] and "pip install adam-robotics" in reasons["adam"]
    assert {row.group for row in report.rows} == {"ours"} and report.comparisons == ()


def test_joints_that_peers_do_not_do(folder: Path) -> None:
    need_compiler()
    case = Case.of(load_robot(str(folder / "continuous/arm.urdf")), "tip")
    with pytest.raises(Absent, match="joints of type"):
        pinocchio._model_arrays(case)
    assert not case.plain
    assert Case.of(load_robot(str(folder / "revolute/arm.urdf")), "tip").plain
    assert Case.of(robot("solo8"), "base_link").plain


def test_another_mass_matrix_is_left_out(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    need_compiler()
    right = dense.solved
    monkeypatch.setattr(dense, "solved", lambda M, force: 1.001 * right(M, force))
    report = measured(folder / "revolute/arm.urdf", "casadi")
    assert {row.group for row in report.rows} == {"ours"}
    assert [left.name for left in report.skipped] == ["CasADi -O2", "CasADi -O3 native"]
    assert all("differ from Pinocchio's by 1.0e-03" in left.reason for left in report.skipped)


def test_no_build_of_ours_is_right(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    need_compiler()

    def wrong(self: Harness, peer: object) -> float:
        raise Disagreement("its numbers differ")

    monkeypatch.setattr(Harness, "check", wrong)
    with pytest.raises(CompilerError, match="impact-posture verify"):
        measured(folder / "revolute/arm.urdf")


def fake_compiler(path: Path, does: str) -> list[str]:
    path.write_text(f"import sys\nif '--version' in sys.argv:\n    print('fake 1')\nelse:\n    {does}\n")
    return [sys.executable, str(path)]


def test_patience(tmp_path: Path) -> None:
    """A compiler that does not end is stopped, and not tried again by somebody as impatient."""
    compiler = fake_compiler(tmp_path / "slow.py", "while True: pass")
    for patience, tried in ((1.0, 1), (1.0, 0), (1.5, 1)):
        said: list[str] = []
        with pytest.raises(Absent, match=r"stopped after \d s; see --patience"):
            Workbench(patience, said.append).build("it", {"a.c": ""}, compiler, ["-O2"])
        assert len(said) == tried


def test_a_failure_is_tried_again(tmp_path: Path) -> None:
    compiler = fake_compiler(tmp_path / "broken.py", "sys.exit('error: no header')")
    for _ in range(2):
        said: list[str] = []
        with pytest.raises(Absent, match="error: no header"):
            Workbench(5.0, said.append).build("it", {"a.c": ""}, compiler, ["-O2"])
        assert len(said) == 1


# ---- in step ----------------------------------------------------------------------------------------------------


def test_lists_in_step() -> None:
    assert set(get_args(PeerName)) == set(PEERS) == {"differences", *measure._MODULES}
    assert set(DEFAULT_ROBOTS) <= set(known_robots())
    page = (ROOT / "docs" / "reference" / "bench.md").read_text(encoding="utf-8")
    for name in PEERS:
        assert f"| `{name}` |" in page
    for key in ROW:
        assert f"`{key}`" in page
    for name in pinocchio.FORMULATIONS:
        assert f"| {name} |" in page
