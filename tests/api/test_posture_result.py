"""Optimize a posture with ``import impact_posture as ip``; the defaults equal the defaults of the command line."""

from __future__ import annotations

import base64
import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import impact_posture as ip
from impact_posture.errors import InputError, OutputError, PostureError, SpecError
from impact_posture.output import plot
from impact_posture.posture.formulation.problem_file import dump_settings, prepare, read_settings, resolved_settings
from impact_posture.system.toolchain import find_compiler
from tests.api.test_extension import JointDistance
from tests.support.command import ALL_PICTURES, blank, run, succeed
from tests.support.settings import make_settings

UP = (0.0, 0.0, 1.0)
WEIGHTED = {"metric": "weighted", "weights": "velocity-limits"}


def arm(**more: Any) -> ip.ImpactObjective:
    return ip.ImpactObjective(ip.load_robot("tilthex_arm"), ip.ImpactContact("ee", normal=(0, 0, 2)), **more)


@pytest.fixture(scope="module")
def result() -> ip.PostureResult:
    return ip.optimize(ip.PostureProblem(arm(), base="level"), starts=2, jobs=1)


def test_every_name_is_there() -> None:
    # A star import would hide the packages of these names.
    assert {*dir(ip)} - {*ip.__all__} == {"jax", "torch"}
    assert {"load_robot", "optimize", "PostureProblem", "tsid"} < {*ip.__all__}
    for package in (ip, ip.tsid):
        assert all(getattr(package, name) is not None for name in dir(package))
        with pytest.raises(AttributeError, match="nothing"):
            package.nothing  # noqa: B018


def test_the_online_part_loads_no_casadi() -> None:
    code = (
        "import sys, impact_posture as ip; ip.load_robot('ur5'); ip.ImpactGradient; "
        "[getattr(ip.tsid, name) for name in ip.tsid.__all__]; sys.exit('casadi' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_contacts_problems_and_robots_check_their_arguments() -> None:
    assert ip.ImpactContact("ee", (0, 0, 2)).normal == UP
    contact = ip.ImpactContact("ee", (0.3, -0.2, 0.7))
    assert replace(contact, impulse=2.0).normal == contact.normal
    with pytest.raises(SpecError, match="unknown key 'roots'; did you mean root"):
        ip.load_robot("ur5", roots="fixed")
    with pytest.raises(SpecError, match="unknown key 'basis'"):
        ip.PostureProblem(arm(), basis="level")
    with pytest.raises(PostureError):
        ip.PostureProblem(arm(), posture=[0.0, 1.0])
    with pytest.raises(InputError, match="no contact"):
        ip.ImpactObjective(ip.load_robot("ur5"), [])


@pytest.mark.parametrize(
    ("robot", "frame", "settings", "objective"),
    [
        ("tilthex_arm", "ee", {}, {}),
        ("talos", "torso_2_link", {}, {}),
        ("talos", "torso_2_link", {"support": ()}, {"supports": ()}),
        ("solo8", "base_link", {"support": ("FL_FOOT",)}, {"supports": ("FL_FOOT",)}),
        (
            "panda", "panda_hand_tcp",
            {"objective": "sticking", "normal_cone": 5.0}, {"kind": "sticking", "normal_cone_deg": 5.0},
        ),
        ("ur5", "tool0", WEIGHTED, WEIGHTED),
        (
            "tilthex_arm", "ee",
            {"armature_range": (0.5, 2.0), "payload": (("ee", 0.3),)},
            {"armature_range": (0.5, 2.0), "payloads": [("ee", 0.3)]},
        ),
    ],
)  # fmt: skip
def test_defaults_agree_with_the_command_line(
    robot: str, frame: str, settings: dict[str, object], objective: dict[str, Any]
) -> None:
    keys = {"robot": robot, "frame": frame, "normal": (0.1, 0.2, 1.0), "collision": True, "holdable": True}
    theirs = prepare(make_settings(keys | settings))
    contact = ip.ImpactContact(frame, (0.1, 0.2, 1.0))
    ours = ip.PostureProblem(ip.ImpactObjective(ip.load_robot(robot), contact, **objective))
    assert ours.prepared is not None
    assert ours.prepared.impact.to_dict() == theirs.impact.to_dict()
    assert ours.problem.requirements == theirs.problem.requirements
    assert ours.describe() == theirs.problem.describe()
    assert np.array_equal(ours.problem.given, theirs.problem.given)


@pytest.mark.parametrize(
    ("stated", "kind"),
    [
        ({}, "impulse"),
        ({"speed": 1.0}, "coulomb"),
        ({"speed": 0.0}, "impulse"),
        ({"friction": 0.7}, "coulomb"),
        ({"friction": 0.0}, "speed"),
        ({"contact_stiffness": "wood"}, "coulomb"),
        ({"contact_duration": 0.01, "friction": 0.0}, "speed"),
        ({"speed": 2.0, "normal_cone": 5.0}, "sticking"),
        ({"speed": 2.0, "objective": "impulse"}, "impulse"),
        ({"friction": 0.3, "objective": "energy"}, "energy"),
    ],
)
def test_a_stated_speed_friction_or_elasticity_selects_the_objective(
    stated: dict[str, Any], kind: str, tmp_path: Path
) -> None:
    """A stated number selects the objective even if it equals the default: in options, in Python, and in a file."""
    prepared = prepare(make_settings({"robot": "ur5", "frame": "tool0", "normal": (0.1, 0.2, 1.0)} | stated))
    theirs, path = prepared.impact, tmp_path / "problem.toml"
    assert ("(auto, because of `" in theirs.choice) == (bool(stated) and "objective" not in stated)
    path.write_text(dump_settings(resolved_settings(prepared)))
    again = prepare(read_settings(path))
    assert again.impact.objective.kind == kind and not again.impact.choice
    assert again.problem.describe() == prepared.problem.describe()
    task = {key: value for key, value in stated.items() if key in ("speed", "contact_stiffness", "contact_duration")}
    friction = {key: stated[key] for key in ("friction",) if key in stated}
    contact = ip.ImpactContact("tool0", (0.1, 0.2, 1.0), **friction)
    cone = stated.get("normal_cone", 0.0)
    objective = ip.ImpactObjective(ip.load_robot("ur5"), contact, kind=stated.get("objective"), normal_cone_deg=cone)
    problem = ip.PostureProblem(objective, **task)
    assert problem.prepared is not None
    ours = problem.prepared.impact
    assert problem.problem.objective.name == ours.objective.kind == theirs.objective.kind == kind
    assert (ours.choice, ours.to_dict()) == (theirs.choice, theirs.to_dict())
    assert problem.problem.requirements == prepare(problem.prepared.settings, theirs).problem.requirements


def test_a_robot_that_floats_without_anything_to_hold_it_is_refused() -> None:
    robot = ip.load_robot("example-robot-data:b1_description/urdf/b1-z1.urdf", root="free-flyer")
    contact = ip.ImpactContact("link06", (0, 0, 1))
    with pytest.raises(InputError, match=r"nothing says what holds.*`support` FL_foot"):
        ip.PostureProblem(ip.ImpactObjective(robot, contact))
    assert ip.PostureProblem(ip.ImpactObjective(robot, contact, supports=())).problem.objective.supports == ()


def test_evaluation_has_its_numbers() -> None:
    objective = arm()
    evaluation = objective.evaluate(objective.robot.posture(), speed=2.0)
    assert pytest.approx(objective.value(objective.robot.posture())) == evaluation.H
    assert evaluation.E is not None and pytest.approx(0.5 / evaluation.G) == evaluation.E
    assert evaluation.V is not None and evaluation.S is not None and evaluation.speed == 2.0


def test_a_result_saves_what_the_command_line_writes(
    result: ip.PostureResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Replace all figures by blank figures to save time.
    for name in ALL_PICTURES:
        monkeypatch.setitem(plot.FIGURES, name, blank)
    written = result.save(tmp_path / "python", codegen=False, report=False, jobs=1)
    options = ("--normal", 0, 0, 2, "--base", "level", "--starts", 2, "--jobs", 1, "--no-codegen", "--out", "cli")
    succeed("optimize", "tilthex_arm", "--frame", "ee", *options, cwd=tmp_path)
    theirs = tmp_path / "cli"
    assert {p.name for p in written.out.iterdir()} == {p.name for p in theirs.iterdir()}
    python, cli = (json.loads((folder / "result.json").read_text()) for folder in (written.out, theirs))
    for document in (python, cli):
        for key in ("solve_time_s", "build_time_s"):
            document["solver"].pop(key)
    assert python == cli
    toml = [(folder / "problem.toml").read_text().splitlines() for folder in (written.out, theirs)]
    # The settings in Python do not include the number of starts, unlike the command line.
    assert toml[0] == [line for line in toml[1] if line != "starts = 2"] != toml[1]
    assert run("optimize", written.out / "problem.toml", "--out", "again", "--starts", 2, "--no-codegen",
               cwd=tmp_path).returncode == 0  # fmt: skip


def test_a_result_draws_and_exports_itself(result: ip.PostureResult, tmp_path: Path) -> None:
    assert 0.5 < result.reduction < 1 and result.certificate.stationarity < 1e-6
    assert result.initial.shape == result.q.shape == (10,)
    (path,) = result.plot(tmp_path, only=["jump"])
    assert path.read_bytes().startswith(b"\x89PNG")
    if find_compiler() is None:
        pytest.skip("no C compiler")
    gradient = result.export(tmp_path / "c").load()
    value, slope = gradient.objective(result.q)
    assert value == pytest.approx(result.problem.problem.objective.value(result.q), rel=1e-9)
    for q, n in ((0.1, UP), ([0.1], UP), (result.q, 1.0), (result.q, [1.0]), (result.q[None], UP), (result.q, None)):
        # Scalar input must raise an error, instead of being broadcast over all joints.
        with pytest.raises((TypeError, ValueError)):
            gradient.value_and_gradient(q, n)
    robot = result.problem.problem.robot
    posture = ip.tsid.ImpactRobustPosture(robot, gradient)
    controller = ip.tsid.Controller(robot, ip.tsid.aerial_formulation(robot, posture))
    q, v = robot.posture(), np.zeros(robot.nv)
    controller.reset(q, v)
    assert controller.tick(0.0, q, v).status is ip.tsid.Status.SOLVED and slope.shape == (robot.nv,)


def test_the_code_of_a_result_is_the_code_of_its_objective(
    result: ip.PostureResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plot, "drawable", lambda *_: [])
    result.save(tmp_path / "out", formats=("png",), report=False, jobs=1)
    folder = tmp_path / "out" / "c"
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    objective = arm()
    written = objective.export(folder)
    apart = objective.export(tmp_path / "apart", build=False)
    assert sorted(path.name for path in written.files) == sorted(path.name for path in apart.files)
    assert {path: path.read_bytes() for path in written.files} == {
        folder / p.name: before[p.name] for p in written.files
    }
    assert written.compiled == (find_compiler() is not None) and written.manifest["posture"] == result.q.tolist()
    if written.compiled:
        assert written.library is not None and written.library.is_file()
        value, _ = written.load().objective(result.q)
        assert value == pytest.approx(objective.value(result.q), rel=1e-9)
    others = (
        ip.ImpactObjective(objective.robot, objective.contact, kind="speed"),
        ip.ImpactObjective(objective.robot, ip.ImpactContact("ee", (0, 1, 0))),
    )
    for other in others:
        with pytest.raises(OutputError, match="`force` to replace it"):
            other.export(folder)
    portable = objective.export(tmp_path / "portable", portable=True, build=False).out
    with pytest.raises(OutputError, match="`force` to replace it"):
        objective.export(portable)
    # An existing export with other options than the defaults is never reused.
    with pytest.raises(OutputError, match="choose another `out`"):
        objective.export(folder, prefix="arm")
    manifest = folder / "tilthex_arm_ee.json"
    for text in ("{}", "[]", "[" * 100_000):
        manifest.write_text(text)
        with pytest.raises(OutputError, match="exists"):
            objective.export(folder)
    manifest.write_bytes(before[manifest.name])
    assert objective.export(folder, build=False).manifest == written.manifest
    source = folder / "tilthex_arm_ee.c"
    source.write_bytes(before[source.name] + b"/* an edit */\n")
    with pytest.raises(OutputError, match=f"changes of yours in {source.name}"):
        objective.export(folder)
    source.unlink()
    with pytest.raises(OutputError, match="exists"):
        objective.export(folder)


def test_a_trade_off_is_added_to_a_result(result: ip.PostureResult) -> None:
    curve = result.trade_off(2).tradeoff
    assert curve is not None and result.tradeoff is None
    assert "tradeoff" in result.trade_off(2).document


def test_an_objective_from_outside_is_optimized_and_cannot_be_saved(tmp_path: Path) -> None:
    objective = JointDistance(ip.load_robot("ur5"), (0.3, -1.0, 1.0, 0.2, 0.1, 0.0))
    result = ip.optimize(ip.PostureProblem(objective), starts=2, jobs=1)
    assert result.reduction > 0
    with pytest.raises(InputError, match="not an impact objective"):
        result.save(tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("page", ["README.md", "docs/api/index.md"])
def test_the_shown_lines_run(page: str, tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / page).read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    # Draw only one figure, because other tests cover the remaining figures.
    code = "import impact_posture.output.plot as p; p.drawable = lambda view: ['jump']\n" + "\n".join(blocks)
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "result.json").is_file() and "Certificate" in done.stdout


def test_a_result_describes_itself(result: ip.PostureResult) -> None:
    before, after = (result.document[key]["objective"] for key in ("initial", "optimal"))
    assert repr(result) == f"PostureResult(tilthex_arm, impulse {before:.4g} → {after:.4g} (-65.9%), certified)"
    assert result.verdict == result.document["verdict"]["line"] and result.verdict.startswith("verdict: ")
    page = result._repr_html_()
    assert page is not None and page.count("<img") == 1 and "<script" not in page
    picture = base64.b64decode(re.findall(r'src="data:image/png;base64,([^"]+)"', page)[0])
    assert picture.startswith(b"\x89PNG") and result.verdict.split(".")[0] in page
    cells = re.findall(r'<th scope="row">H</th><td>([^<]+)</td><td>([^<]+)</td>', page)
    assert [float(cell) for cell in cells[0]] == pytest.approx([before, after], rel=5e-3)


def test_value_and_gradient_equal_differences_and_the_oracle() -> None:
    objective = arm(kind="effective-mass")
    model, q = objective.robot.model, objective.robot.posture()
    value, gradient = objective.value_and_gradient(list(q))
    assert value == objective.evaluate(q).contact_mass == objective.evaluate(q).objective
    steps = 1e-5 * np.eye(model.nv)
    slopes = [
        (objective.value(pin.integrate(model, q, d)) - objective.value(pin.integrate(model, q, -d))) / 2e-5
        for d in steps
    ]
    np.testing.assert_allclose(gradient, slopes, rtol=0, atol=1e-6 * np.abs(gradient).max())
    with pytest.raises(PostureError):
        objective.value_and_gradient([0.0])


def test_the_friction_of_the_contact_is_saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plot, "drawable", lambda *_: [])
    robot = ip.load_robot("tilthex_arm")
    objective = ip.ImpactObjective(robot, ip.ImpactContact("ee", (0, 0, 1), friction=0.3), kind="coulomb")
    problem = ip.PostureProblem(objective, base="level")
    ip.optimize(problem, starts=1).save(tmp_path / "out", codegen=False, formats=("png",), report=False)
    assert "friction = 0.3" in (tmp_path / "out" / "problem.toml").read_text()
    assert problem.problem.requirements.friction == 0.3


@pytest.mark.parametrize(
    ("arguments", "task", "words"),
    [
        ({"joint_model": "foo"}, {}, "joint_model.*reflected"),
        ({"kind": "auto"}, {}, "kind.*impulse"),
        ({}, {"friction": 0.1}, "friction.*ImpactContact"),
        ({}, {"joint_model": "link"}, "joint_model.*ImpactObjective"),
    ],
)
def test_what_the_objective_holds_is_said_there(arguments: dict[str, Any], task: dict[str, Any], words: str) -> None:
    robot = ip.load_robot("tilthex_arm")
    with pytest.raises(ip.ImpactPostureError, match=words):
        ip.PostureProblem(ip.ImpactObjective(robot, ip.ImpactContact("ee", (0, 0, 1)), **arguments), **task)
