"""Output of ``--path``: consistent files, a block of ``result.json``, a figure, and an error without the extra."""

from __future__ import annotations

import csv
import json
import re
import sys
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import yaml

import impact_posture as ip
from impact_posture.output.result_reader import load_view
from impact_posture.path.path_files import positions, read_path, write_path
from impact_posture.path.posture_path import PosturePath, posture_path
from impact_posture.posture.formulation.problem_file import prepare
from impact_posture.posture.search.multistart import solve
from impact_posture.robot.robot import Robot
from tests.path.test_path import assembled
from tests.support.arms import Z, arm
from tests.support.command import refused, run, succeed
from tests.support.helpers import robot
from tests.support.settings import make_settings
from tests.support.urdfs import joint, link, write

FAST = ("--starts", "2", "--jobs", "1", "--no-codegen", "--format", "png")
BLOCK = set(
    "found reason method timing duration_s length points interpolation max_violation objective q limits".split()
)
LIMITS = {"velocity", "velocity_of", "torque", "torque_of", "thrust", "thrust_of", "active"}


def solved_path(**settings: object) -> tuple[Robot, PosturePath]:
    solution = solve(prepare(make_settings({"normal": (0, 0, 1), **settings})).problem, starts=2, jobs=1)
    return solution.problem.robot, posture_path(solution, effort=500)


@pytest.mark.long(but=("tilthex_arm",))
@pytest.mark.parametrize(
    "settings",
    [{"robot": "tilthex_arm"}, {"robot": "kinova", "contact_pose": "position", "objective": "sticking"}],
    ids=lambda s: str(s["robot"]),
)
def test_csv_npz_and_yaml_agree(settings: dict[str, object], tmp_path: Path) -> None:
    loaded, path = solved_path(**settings)
    write_path(tmp_path, loaded, path)
    with (tmp_path / "path.csv").open(newline="") as file:
        head, *rows = list(csv.reader(file))
    values = np.array(rows, dtype=float)
    arrays = np.load(tmp_path / "path.npz")
    nv, nx = loaded.nv, values.shape[1] - 1 - 2 * loaded.nv
    assert head[0] == "t" and len(head) == len(set(head)) == values.shape[1]
    assert head[1 + nx :] == [f"{kind}:{name}" for kind in "va" for name in loaded.tangent_names]
    assert np.array_equal(values[:, 0], arrays["t"]) and np.array_equal(values[:, 0], path.t)
    assert np.array_equal(values[:, 1 + nx : 1 + nx + nv], arrays["v"])
    assert np.array_equal(values[:, 1 + nx + nv :], arrays["a"])
    assert len(values) == len(arrays["q"]) and np.array_equal(arrays["q"], path.q)

    text = (tmp_path / "path.yaml").read_text()
    message = yaml.safe_load(text)
    assert set(message) == {"header", "joint_names", "points"}
    assert tuple(message["joint_names"]) == loaded.joint_names
    assert ("base" in text) == loaded.floating
    for k, point in enumerate(message["points"]):
        stamp = point["time_from_start"]
        assert stamp["sec"] + 1e-9 * stamp["nanosec"] == pytest.approx(path.t[k], abs=1e-9)
        for name, angle, speed, gain in zip(
            message["joint_names"], point["positions"], point["velocities"], point["accelerations"], strict=True
        ):
            column = head.index(f"q:{name}")
            assert angle == values[k, column]
            assert (speed, gain) == (values[k, head.index(f"v:{name}")], values[k, head.index(f"a:{name}")])
            # The written angle equals the angle in q, which may be stored as cosine and sine.
            index = loaded.model.getJointId(name)
            entries = path.q[k][loaded.model.idx_qs[index] :][: loaded.model.nqs[index]]
            of_q = entries[0] if len(entries) == 1 else np.arctan2(entries[1], entries[0])
            assert np.cos(angle - of_q) == pytest.approx(1)
    # The written angle of a continuous joint does not jump by 2π.
    assert np.abs(np.diff(values[:, 1 : 1 + nx], axis=0)).max() < 0.2

    block = json.loads(json.dumps(path.to_dict(), allow_nan=False))
    page = (Path(__file__).parents[2] / "docs" / "reference" / "result-json.md").read_text(encoding="utf-8")
    for key in (*(BLOCK - {"limits"}), *(f"limits.{key}" for key in LIMITS)):
        assert f"`path.{key}`" in page, key
    assert set(block) == BLOCK and set(block["limits"]) == LIMITS
    again = read_path(tmp_path, block, loaded)
    assert again.to_dict() == path.to_dict()
    assert np.array_equal(again.objectives, path.objectives)
    assert again.use is not None and path.use is not None and np.array_equal(again.use.velocity, path.use.velocity)


def test_a_joint_that_turns_more_than_once_is_one_angle() -> None:
    loaded = robot("kinova")
    turning = loaded.tangent_names.index(loaded.joint_names[0])
    steps = [np.eye(loaded.nv)[turning] * x for x in np.linspace(0, 9, 40)]
    q = np.array([pin.integrate(loaded.model, loaded.posture(), step) for step in steps])
    names, angles = positions(loaded, q)
    assert names == list(loaded.joint_names)
    assert np.ptp(angles[:, 0]) == pytest.approx(9.0)


def test_files_escape_strange_names(tmp_path: Path) -> None:
    loaded = arm([Z, Z, Z], [0.3, 0.5, 0.4], floating=False, rods=[(0.3, 0, 0)] * 3)
    strange = ['a,"b', "c: d\x1b[31m", "e\nf"]
    for index, name in enumerate(strange, start=1):
        loaded.model.names[index] = name
    objective = ip.ImpactObjective(loaded, ip.ImpactContact("tip", (0.6, 0.8, 0)))
    result = ip.optimize(ip.PostureProblem(objective, contact_pose="position"), starts=2, jobs=1).path()
    assert result.motion is not None
    write_path(tmp_path, loaded, result.motion)
    with (tmp_path / "path.csv").open(newline="") as file:
        head = next(csv.reader(file))
    assert head[1:4] == ['q:a,"b', r"q:c: d\x1b[31m", r"q:e\nf"]
    assert yaml.safe_load((tmp_path / "path.yaml").read_text())["joint_names"] == strange


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    here = tmp_path_factory.mktemp("path")
    command = ("optimize", "tilthex_arm", "--normal", 0, 0, 1, "--path", "--out", "with", *FAST)
    done = succeed(*command, cwd=here, pictures=["path"])
    assert "path to the optimum by continuation: " in " ".join(done.stdout.split())
    return here / "with"


def test_the_command_leaves_the_path_in_its_folder(folder: Path) -> None:
    document = json.loads((folder / "result.json").read_text())
    block = document["path"]
    assert set(block) == BLOCK and block["found"] and block["points"] > 20
    assert block["objective"] == pytest.approx(document["optimal"]["objective"])
    assert block["max_violation"] < 1e-8 and block["limits"]["active"] == "thrust"
    arrays = np.load(folder / "path.npz")
    assert arrays["q"][0] == pytest.approx(np.array(document["initial"]["q"]))
    left = pin.difference(robot("tilthex_arm").model, arrays["q"][-1], np.array(document["optimal"]["q"]))
    assert np.abs(left).max() < 1e-5
    assert {p.name for p in folder.iterdir()} > {"path.csv", "path.npz", "path.yaml", "path.png"}
    assert (folder / "path.png").stat().st_size > 30_000
    assert "path = true" in (folder / "problem.toml").read_text()


def test_the_same_problem_gives_the_same_path(folder: Path, tmp_path: Path) -> None:
    done = succeed("optimize", folder / "problem.toml", "--out", "again", "--json", *FAST[2:], cwd=tmp_path)
    assert json.loads(done.stdout)["path"] == json.loads((folder / "result.json").read_text())["path"]
    assert (tmp_path / "again" / "path.csv").read_bytes() == (folder / "path.csv").read_bytes()


TAMPERED = {
    "fewer postures": lambda arrays: {**arrays, "q": arrays["q"][1:]},
    "not finite": lambda arrays: {**arrays, "v": np.full_like(arrays["v"], np.nan)},
    "huge": lambda arrays: {**arrays, "q": arrays["q"] * 1e300},
    "times": lambda arrays: {**arrays, "t": 0 * arrays["t"]},
    "shares": lambda arrays: {**arrays, "share_at": np.array(1.0)},
}


@pytest.mark.parametrize("how", TAMPERED)
def test_a_damaged_path_is_refused(how: str, folder: Path, tmp_path: Path) -> None:
    loaded, block = robot("tilthex_arm"), json.loads((folder / "result.json").read_text())["path"]
    with np.load(folder / "path.npz") as file:
        np.savez(tmp_path / "path.npz", **TAMPERED[how](dict(file)))
    with pytest.raises(ValueError, match=r"path\.npz"):
        read_path(tmp_path, block, loaded)


def test_plot_draws_the_path_of_a_folder(folder: Path, tmp_path: Path) -> None:
    succeed("plot", folder, "--out", tmp_path / "again", cwd=tmp_path, pictures=["path"])
    assert (tmp_path / "again" / "path.png").stat().st_size > 30_000


def test_without_the_extra_the_command_stops_before_it_solves(tmp_path: Path) -> None:
    def hide() -> None:
        sys.modules["toppra"] = None  # type: ignore[assignment]

    command = ("optimize", "tilthex_arm", "--normal", 0, 0, 1, "--path", *FAST)
    done = run(*command, cwd=tmp_path, prepare=hide)
    refused(done, 1, "the extra 'path': toppra", "not installed; pip install 'impact-posture[path]'")
    assert not done.stdout and not list(tmp_path.iterdir())


def crank(folder: Path) -> Path:
    """Write a planar linkage with its tip at (0.5, 0), whose crank can turn fully (0.1 + 0.5 < 0.4 + 0.4).

    The elbow angles at the start and at the optimum have opposite signs.  No motion that holds the tip leads from
    the start to the optimum.
    """
    limit, ends = '<limit lower="-3.1" upper="3.1" effort="5" velocity="9"/>', (0.0, 0.1, 0.4, 0.4)
    parts = [link("link_0"), link("tip"), joint("tool", "link_3 tip", None, f"{ends[3]} 0 0", "fixed", "")]
    for k in range(3):
        place = f"link_{k} link_{k + 1}", "0 0 1", f"{ends[k]} 0 0"
        parts += [link(f"link_{k + 1}", 0.2, f"{ends[k + 1] / 2} 0 0"), joint(f"joint_{k}", *place, more=limit)]
    joints = ", ".join(f"joint_{k} = {value}" for k, value in enumerate(assembled(0.3, 1.0)))
    postures = f'default_posture = "up"\n[postures.up]\njoints = {{ {joints} }}\n'
    return write(folder, *parts, toml=f'{postures}[contact]\nframe = "tip"\n')


def test_without_a_path_to_the_optimum_the_answer_is_the_posture_where_the_path_ends(tmp_path: Path) -> None:
    options = "--armature none --normal 0.6 0.8 0 --contact-pose position --path --no-collision --jobs 1 --out out"
    done = succeed("optimize", crank(tmp_path), *options.split(), cwd=tmp_path)
    text = " ".join(done.stdout.split())
    document = json.loads((tmp_path / "out" / "result.json").read_text())
    posture = json.loads((tmp_path / "out" / "posture.json").read_text())["q"]
    path, reachable, optimal = document["path"], document["reachable"], document["optimal"]
    assert not path["found"] and posture == path["q"] == reachable["q"] != optimal["q"]
    assert optimal["objective"] == document["solver"]["optima"][0]["objective"] < 0.9 * reachable["objective"]
    assert reachable["objective"] == pytest.approx(path["objective"]) and "attainable_speed" in reachable
    # The verdict begins with this fact, and the numbers of the verdict belong to the reachable posture.
    first = "posture.json is not the optimum but the posture where the path ends: no path to the optimum exists"
    verdict = document["verdict"]
    assert verdict["line"].startswith(f"verdict: {first}") and verdict["conditions"][0]["key"] == "path"
    assert f"verdict: {first}" in text and text.index(first) < text.index("m/s with friction")
    assert verdict["after"]["impulse"] == reachable["jump"]["coulomb"]["normal_impulse"]
    assert verdict["after"]["impulse"] != pytest.approx(optimal["jump"]["coulomb"]["normal_impulse"], rel=1e-3)
    share = 1 - reachable["objective"] / document["initial"]["objective"]
    assert f"reduction {100 * share:.1f}% where the path ends; the next lines are about the optimum" in text
    # The C code has the posture of posture.json, also if another command writes the code again.
    succeed("codegen", "out", "--out", "again", cwd=tmp_path)
    for source in (tmp_path / "out" / "c", tmp_path / "again"):
        (code,) = (file.read_text() for file in source.glob("*.c") if "_posture[" in file.read_text())
        (numbers,) = re.findall(r"_posture\[\d+\] = \{([^}]*)\}", code)
        assert [float(number) for number in numbers.split(",") if number.strip()] == pytest.approx(posture, rel=1e-15)
    # A later command reads the same posture from the folder.
    assert load_view(tmp_path / "out").q_optimal.tolist() == posture
