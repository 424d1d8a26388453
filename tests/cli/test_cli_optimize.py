"""``optimize`` and ``plot`` as a user runs them: output files, printed lines and figures."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

import impact_posture as ip
from cli.optimize_summary import _active
from impact_posture.output import plot
from impact_posture.output.plot.result_view import header_lines
from impact_posture.output.result_reader import load_view
from tests.support.command import ALL_PICTURES, on_terminal, read_terminal, refused, run, start, succeed

COMMAND = Path(sys.executable).parent / "impact-posture"
FAST = ("--starts", "2", "--jobs", "1", "--no-codegen", "--format", "png")


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a result folder of `optimize`, with figures and C code."""
    folder = tmp_path_factory.mktemp("main-job")
    succeed("optimize", "tilthex_arm", "--frame", "ee", "--normal", 0, 0, 1, cwd=folder, pictures=ALL_PICTURES)
    return folder / "tilthex_arm-ee"


def test_main_job_leaves_everything(result: Path) -> None:
    names = {p.name for p in result.iterdir()}
    assert {"result.json", "result.npz", "posture.json", "problem.toml", "c"} <= names
    for figure in ("ellipsoid", "postures", "jump", "nullspace"):
        assert (result / f"{figure}.png").stat().st_size > 3000
    assert not [name for name in names if name.endswith((".svg", ".pdf"))]
    # Without `--tradeoff`, the result contains no trade-off.
    assert not (result / "tradeoff.png").exists()
    assert "tradeoff" not in json.loads((result / "result.json").read_text())
    assert any((result / "c").glob("*.c")) and any((result / "c").glob("*.h"))
    assert not [p for p in result.parent.iterdir() if p.name.startswith(".")]


def test_result_json_has_the_contract_keys(result: Path) -> None:
    document = json.loads((result / "result.json").read_text())
    assert document["schema"] == "impact-posture/result/1"
    top = "robot contacts supports support_compliance metric initial optimal reduction redundancy certificate active"
    assert set(f"{top} solver versions".split()) <= set(document)
    robot = "name source model_sha256 nq nv joint_names root convention armature locked"
    assert set(robot.split()) <= set(document["robot"])
    posture = "q objective H G V S E effective_mass gradient objective_gradient worst_normal ellipsoid pose"
    assert set(posture.split()) <= set(document["optimal"])
    assert {"given_q", "moved", *posture.split()} <= set(document["initial"])
    certificate = "stationarity primal complementarity pose_error_m pose_error_rad limits recomputed_with"
    assert set(certificate.split()) <= set(document["certificate"])
    assert set("status iterations solve_time_s starts feasible_starts optima".split()) <= set(document["solver"])
    assert {"axes", "radii"} <= set(document["optimal"]["ellipsoid"])
    assert {"position", "quaternion_xyzw"} == set(document["optimal"]["pose"])
    before, after = document["initial"]["objective"], document["optimal"]["objective"]
    assert document["reduction"] == pytest.approx(1 - after / before)
    assert len(document["optimal"]["gradient"]) == document["robot"]["nv"]
    radii = document["optimal"]["ellipsoid"]["radii"]
    assert radii == sorted(radii, reverse=True)


def test_result_arrays_match_the_document(result: Path) -> None:
    document = json.loads((result / "result.json").read_text())
    with np.load(result / "result.npz") as arrays:
        assert arrays["optimal_q"] == pytest.approx(document["optimal"]["q"], abs=0)
        jump, n = arrays["optimal_jump"], np.array(document["contacts"][0]["normal"])
        assert jump @ jump == pytest.approx(document["optimal"]["H"], rel=1e-12)
        assert n @ arrays["optimal_ellipsoid"] @ n == pytest.approx(document["optimal"]["H"], rel=1e-9)


def test_solved_again_from_its_own_problem(result: Path, tmp_path: Path) -> None:
    done = succeed("optimize", result / "problem.toml", "--out", "again", "--json", *FAST[4:], cwd=tmp_path)
    first = json.loads((result / "result.json").read_text())
    again = json.loads(done.stdout)
    for key in ("reduction", "redundancy", "contacts", "metric", "robot"):
        assert again[key] == first[key]
    assert again["optimal"]["q"] == first["optimal"]["q"]


def test_plot_draws_again(result: Path, tmp_path: Path) -> None:
    draw = ("plot", result, "--out", tmp_path / "pictures", "--format", "svg", "--figure", "ellipsoid")
    succeed(*draw, cwd=tmp_path, pictures=("ellipsoid",))
    assert (tmp_path / "pictures" / "ellipsoid.svg").is_file()
    refused = run("plot", tmp_path, cwd=tmp_path)
    assert refused.returncode == 1 and "result.json" in refused.stderr


def test_verify_takes_the_problem_of_a_result(result: Path, tmp_path: Path) -> None:
    done = succeed("verify", result, "--samples", 1, "--json", cwd=tmp_path)
    document, known = json.loads(done.stdout), json.loads((result / "result.json").read_text())
    assert document["passed"] and document["robot"]["model_sha256"] == known["robot"]["model_sha256"]
    assert document["contacts"] == known["contacts"] and document["supports"] == known["supports"]
    refused = run("verify", result, "--frame", "ee", cwd=tmp_path)
    assert refused.returncode == 2 and "--frame contradicts RESULT_DIR" in " ".join(refused.stderr.split())


def test_broken_result_is_refused(result: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken"
    shutil.copytree(result, broken)
    (broken / "result.npz").write_bytes(b"")
    refused(run("plot", broken, cwd=tmp_path), 1, "broken", "not a whole result")


def test_energy_has_one_unit_in_pictures_and_tables(result: Path, tmp_path: Path) -> None:
    (line,) = [line for line in header_lines(load_view(result))[1] if " E " in line]
    assert re.search(r"\bE [\d.]+ → [\d.]+ kg", line), line
    done = run("evaluate", "tilthex_arm", "--normal", 0, 0, 1, cwd=tmp_path)
    assert re.search(r"^ *E +[\d.]+ +kg ", done.stdout, re.MULTILINE), done.stdout


def test_posture_file_starts_the_next_optimization(result: Path, tmp_path: Path) -> None:
    start_again = ("--posture", result / "posture.json", "--json", *FAST)
    done = succeed("optimize", "tilthex_arm", "--normal", 0, 0, 1, *start_again, cwd=tmp_path)
    document = json.loads(done.stdout)
    assert document["reduction"] == pytest.approx(0.0, abs=1e-6)
    assert any("no better posture" in note for note in document["notes"])


def test_nothing_gained_is_said_where_a_mirrored_posture_is_shown() -> None:
    result = ip.optimize(
        ip.PostureProblem(ip.ImpactObjective(ip.load_robot("xarm7"), ip.ImpactContact("link_eef", (0, 0, 1)))), jobs=1
    )
    assert 0 <= result.reduction < 1e-3
    assert np.linalg.norm(result.q - result.initial) > 1
    (note,) = [note for note in result.solution.notes if "no better posture" in note]
    assert note.endswith("another posture with equal objective")


def test_joints_that_robot_toml_holds_and_the_option_releases_are_named() -> None:
    objective = ip.ImpactObjective(ip.load_robot("panda"), ip.ImpactContact("panda_hand_tcp", (0, 0, 1)))
    both = ("panda_finger_joint1", "panda_finger_joint2")
    # The fingers are coupled, so holding one of them holds both.
    for hold, released in (((), ", ".join(both)), (both[:1], None), (both, None), (None, None)):
        notes = [n for n in ip.PostureProblem(objective, hold=hold).problem.notes if "robot.toml also holds" in n]
        assert len(notes) == (released is not None)
        assert not notes or f"holds {released}; your `hold` replaces its list" in notes[0]


def test_human_output_fits_80_columns(tmp_path: Path) -> None:
    done = succeed("optimize", "solo8", "--normal", 1, 0, 0, *FAST, cwd=tmp_path)
    assert max(len(line.rstrip()) for line in done.stdout.splitlines()) <= 80
    for word in ("constraints", "reduction", "certificate", "base roll", "before", "after"):
        assert word in done.stdout


def test_active_constraints_are_named_in_words() -> None:
    said = [_active({"constraint": name, "side": "lower"}) for name in ("arm / wall", "joint 'elbow'", "com")]
    assert said == [
        "arm / wall at their least distance",
        "joint 'elbow' at its lower limit",
        "com at its lower bound",
    ]


def test_no_redundancy_is_said(tmp_path: Path) -> None:
    done = succeed("optimize", "ur5", "--normal", 0, 0, 1, "--contact-pose", "full", *FAST, cwd=tmp_path)
    assert "no redundancy left" in done.stdout


@pytest.mark.usefixtures("few_tries")
def test_aerial_robot_that_cannot_hover_is_warned_about(tmp_path: Path) -> None:
    """Rotors limited to half of their speed cannot carry the weight; the result contains a warning about this."""
    from impact_posture_robots import DATA

    spec = (DATA / "tilthex_arm" / "robot.toml").read_text().replace("speed_max = 100.0", "speed_max = 50.0")
    assert "speed_max = 50.0" in spec
    for name in ("tilthex_arm.urdf", "tilthex_arm.srdf"):
        shutil.copy(DATA / "tilthex_arm" / name, tmp_path)
    (tmp_path / "robot.toml").write_text(spec)
    asked = ("optimize", "tilthex_arm.urdf", "--normal", 0, 0, 1)
    refused(run(*asked, *FAST, cwd=tmp_path), 3, "thrust of rotor_1 at rest")
    done = succeed(*asked, "--no-holdable", "--json", *FAST, cwd=tmp_path)
    assert any("cannot hover" in warning for warning in json.loads(done.stdout)["warnings"])


@pytest.mark.usefixtures("few_tries")
def test_surface_and_locking_are_warned_about(tmp_path: Path) -> None:
    """If the normal points into the surface, the whole robot is behind the surface."""
    wrong = ("optimize", "tilthex_arm", "--normal", 0, 0, -1, "--json", *FAST)
    done = run(*wrong, "--no-collision", cwd=tmp_path)
    assert any("check its sign" in w for w in json.loads(done.stdout)["warnings"])
    done = run(*wrong, "--out", "wrong", cwd=tmp_path)
    assert done.returncode == 3
    assert "surface at ee" in done.stderr and "check the sign" in done.stderr
    done = run("optimize", "tilthex_arm", "--normal", 0, 0, 1, "--out", "right", "--json", *FAST, cwd=tmp_path)
    assert not any("surface" in w for w in json.loads(done.stdout)["warnings"])


def test_knees_below_the_ground_and_a_growing_jump_are_said(tmp_path: Path) -> None:
    """In the best posture, this quadruped folds two knees below its feet, and V increases while H decreases."""
    command = ("optimize", "anymal_c", "--normal", 0, 1, 0, "--json", "--no-codegen", "--no-report")
    done = run(*command, "--starts", 6, "--out", "clear", cwd=tmp_path)
    clear = json.loads(done.stdout)
    assert not any("below the lowest foot" in warning for warning in clear["warnings"])
    assert clear["collision"]["optimal"]["distance"] > 0.0009
    done = run(*command, "--no-collision", cwd=tmp_path)
    document = json.loads(done.stdout)
    assert document["optimal"]["objective"] < clear["optimal"]["objective"]
    assert document["optimal"]["V"] > document["initial"]["V"]
    told = document["verdict"]
    assert told["outcome"] == "worse" or any("without friction the jump grows" in line for line in told["advice"])
    assert any("below the lowest foot" in warning for warning in document["warnings"])


@pytest.mark.parametrize("scale", ["1e-6", "1e300"])
def test_normal_of_any_length(scale: str, tmp_path: Path) -> None:
    done = succeed("evaluate", "panda", "--normal", scale, scale, 0, "--json", cwd=tmp_path)
    assert json.loads(done.stdout)["contacts"][0]["normal"] == pytest.approx([0.5**0.5, 0.5**0.5, 0])


def test_failing_compiler_does_not_cost_the_posture(tmp_path: Path) -> None:
    arguments = ("optimize", "tilthex_arm", "--normal", 0, 0, 1, "--starts", 2, "--format", "png")
    done = succeed(*arguments, cwd=tmp_path, env={"CC": "false"})
    assert "could not be built" in done.stderr
    assert (tmp_path / "tilthex_arm-ee" / "posture.json").is_file()
    assert list((tmp_path / "tilthex_arm-ee" / "c").glob("*.c"))


# ---- order of the output ------------------------------------------------------------------------------------------

SMALL = ("ur5", "--frame", "tool0", "--normal", 0, 0, 1, "--starts", 2, "--jobs", 1)


def test_progress_is_shown_on_a_terminal_only(tmp_path: Path) -> None:
    said = on_terminal("optimize", *SMALL, "--no-codegen", cwd=tmp_path)
    assert [word in said for word in ("building the expressions …", "solving", "starts", "drawing")] == [True] * 4
    quiet = run("optimize", *SMALL, "--no-codegen", "--force", cwd=tmp_path)
    assert quiet.returncode == 0 and "solving" not in quiet.stderr and "drawing" not in quiet.stderr
    draw = ("plot", "ur5-tool0", "--figure", "jump")
    for other in ("--quiet", "--json"):
        assert on_terminal(*draw, other, cwd=tmp_path) == ""
    # The installed program passes the same check in a separate process.
    ours, theirs = os.openpty()
    with subprocess.Popen([COMMAND, *draw], cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=theirs) as process:
        os.close(theirs)
        assert "drawing" in read_terminal(ours)
    assert process.returncode == 0


def test_the_answer_stands_before_pictures_and_c_code(tmp_path: Path) -> None:
    """While the compiler waits for a file, the result is printed; the compiler's error is printed at the end."""
    compiler = tmp_path / "cc"
    compiler.write_text(
        '#!/bin/sh\nwhile [ ! -e go ] && [ ! -e "$GO" ]; do sleep 0.05; done\necho "error: no" >&2\nexit 1\n'
    )
    compiler.chmod(0o755)
    environment = {"CC": str(compiler), "GO": str(tmp_path / "go")}
    ours, theirs = os.pipe()
    with tempfile.TemporaryFile("w+") as errors, open(ours) as out:
        arguments = ("optimize", *SMALL, "--compile", "never")
        child = start(arguments, theirs, errors.fileno(), tmp_path, environment)
        os.close(theirs)
        first = ""
        for line in out:
            first += line
            if line.startswith("optima") or "solves by IPOPT certified" in line:
                break
        # The output folder does not exist yet, and the compiler still waits.
        assert "reduction" in first and "certificate" in first and not (tmp_path / "ur5-tool0").exists()
        (tmp_path / "go").touch()
        rest = out.read()
        child.join()
        errors.seek(0)
        said = errors.read()
    assert child.exitcode == 0
    assert "written to ur5-tool0" in rest and "(not compiled)" in " ".join(rest.split())
    assert "could not be built" in said
    assert (tmp_path / "ur5-tool0" / "jump.png").is_file()


def test_pictures_that_fail_after_the_answer_end_in_one_line(tmp_path: Path) -> None:
    def fail(*arguments: object) -> None:
        raise OSError(28, "No space left on device")

    done = run("optimize", *SMALL, cwd=tmp_path, prepare=lambda: setattr(plot, "draw_all", fail))
    assert done.returncode == 1 and "reduction" in done.stdout and "written to" not in done.stdout
    assert done.stderr.count("error:") == 1 and "Traceback" not in done.stderr
    assert not (tmp_path / "ur5-tool0").exists()
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


def test_what_holds_the_posture_is_told(tmp_path: Path) -> None:
    """The output lists the three most loaded actuators under each load, on the terminal and in the JSON document."""
    asked = ("optimize", "tilthex_arm", "--normal", 0, 0, 1, "--hold-force", 3, *FAST)
    done = succeed(*asked, cwd=tmp_path)
    table = done.stdout[done.stdout.index("share of the limits") :]
    assert table.count("at rest") == table.count("while it pushes with 3 N") == 3
    document = json.loads((tmp_path / "tilthex_arm-ee" / "result.json").read_text())
    for block in (document["initial"]["holding"], document["optimal"]["holding"]):
        (pushing,) = block["other_loads"]
        assert block["feasible"] and pushing["feasible"] and block["unbalanced"] == 0
        for load in (block, pushing):
            shares = [one["share"] for one in load["actuators"].values()]
            assert max(shares) == load["largest_share"] <= 1
            assert all(one["low"] <= one["value"] <= one["high"] for one in load["actuators"].values())
        thrusts = [sum(v["value"] for k, v in one["actuators"].items() if "rotor" in k) for one in (block, pushing)]
        # The surface pushes back against the tool, so the rotors need less thrust.
        assert thrusts[1] < thrusts[0]
    again = run("optimize", tmp_path / "tilthex_arm-ee" / "problem.toml", "--out", "again", "--json", cwd=tmp_path)
    assert json.loads(again.stdout)["optimal"]["holding"]["other_loads"][0]["load"] == "while it pushes with 3 N"


@pytest.mark.usefixtures("few_tries")
def test_a_force_that_cannot_be_held_is_named(tmp_path: Path) -> None:
    asked = ("optimize", "panda", "--normal", 0, 0, 1, "--no-collision", *FAST, "--hold-force", 300)
    refused(run(*asked, cwd=tmp_path), 3, "torque of panda_joint6 while it pushes with 300 N")
