"""Sweeps: grid, warm starts, tables, resumed folders, and invalid input."""

from __future__ import annotations

import contextlib
import json
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st

import impact_posture as ip
from impact_posture.config.problem_settings import ProblemSettings
from impact_posture.errors import ImpactPostureError, InputError, OutputError, SpecError
from impact_posture.posture.approach.attainable_speed import AttainableSpeed
from impact_posture.posture.formulation.build_problem import build_problem, retarget
from impact_posture.posture.formulation.problem_file import prepare
from impact_posture.posture.program.certificate import certify
from impact_posture.sweep import shard
from impact_posture.sweep.atlas import sweep_key
from impact_posture.sweep.case_solver import CaseSolver
from impact_posture.sweep.executors import dask_cluster
from impact_posture.sweep.maps import draw_maps
from impact_posture.sweep.point_search import PointResult, Start
from impact_posture.sweep.shard import solve_shard
from impact_posture.sweep.shard_table import read_shard
from impact_posture.sweep.slurm_jobs import SlurmJobs, parse_options
from impact_posture.sweep.sweep_file import Axis, Grid, read_sweep
from impact_posture.sweep.sweep_run import SweepRun, run_sweep
from impact_posture.system.processes import process_pool
from tests.support import urdfs
from tests.support.command import refused, run
from tests.support.urdfs import joint, link

# The tool of the aerial manipulator points down.
DOWN, TILTED = (1.0, 0.0, 0.0, 0.0), (float(np.cos(0.1)), 0.0, -float(np.sin(0.1)), 0.0)
AERIAL = f"""
shard = 3
[problem]
robot = "tilthex_arm"
starts = 3
[grid]
normal = [[0, 0, 1], [0, 0.6, 0.8]]
target_quaternion = [{list(DOWN)}, {list(TILTED)}]
speed = [0.5, 2]
"""
ARM = """
shard = 4
[problem]
robot = "panda"
normal = [0, 0, 1]
collision = false
starts = 4
[grid]
x = { from = 0, to = 0.04, count = 3 }
z = [0, 2]
"""
# At each pose, panda has optima whose objectives differ by a factor of four.
SWITCHING = """
shard = {shard}
[problem]
robot = "panda"
normal = [-1, 0, 0]
collision = false
starts = {starts}
[grid]
y = {{ from = -0.2, to = 0.2, count = 5 }}
z = {{ from = -0.2, to = 0.2, count = 5 }}
"""


def write(text: str, folder: Path) -> Path:
    path = folder / "sweep.toml"
    path.write_text(text)
    return path


def solve(text: str, folder: Path, executor: Any = None, name: str = "out", **options: Any) -> SweepRun:
    return run_sweep(read_sweep(write(text, folder)), folder / name, executor, **options)


def shards(folder: Path) -> dict[str, bytes]:
    """Return the shards of a sweep folder, with their paths as keys."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.glob("data/*/*.parquet"))}


@pytest.fixture(scope="module")
def aerial(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("aerial")
    assert solve(AERIAL, folder).shards == 3
    return folder / "out"


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("arm")
    solve(ARM, folder)
    return folder / "out"


# ---- the grid ------------------------------------------------------------------------------------------------------


@given(st.lists(st.integers(1, 5), max_size=4), st.data())
def test_points_and_neighbors_of_a_grid(shape: list[int], data: st.DataObject) -> None:
    grid = Grid(tuple(Axis(str(k), tuple(range(count))) for k, count in enumerate(shape)))
    point = data.draw(st.integers(0, grid.size - 1))
    first = data.draw(st.integers(0, point))
    assert grid.place(point) == tuple(np.unravel_index(point, shape))
    for other in grid.neighbors(point, first):
        assert first <= other < point
        steps = np.subtract(grid.place(point), grid.place(other))
        assert sorted(steps) == [0] * (len(shape) - 1) + [1]
    around = grid.around(point)
    assert len(around) == sum((k > 0) + (k + 1 < n) for k, n in zip(grid.place(point), shape, strict=True))
    assert set(grid.neighbors(point, first)) <= set(around)
    for other in around:
        assert np.abs(np.subtract(grid.place(point), grid.place(other))).sum() == 1


@pytest.mark.parametrize("robot", ["tilthex_arm", "talos"])
def test_retarget_equals_a_problem_built_for_the_target(robot: str) -> None:
    frame = {"talos": {"frame": "gripper_right_base_link"}}.get(robot, {})
    settings = ProblemSettings(robot=robot, normal=(0.0, 0.6, 0.8), collision=False, **frame)
    problem = prepare(settings).problem
    there = (0.3, 0.1, 0.5)
    moved = retarget(problem, there, TILTED)
    built = build_problem(problem.robot, problem.objective, problem.given, moved.requirements)
    assert moved.requirements.target_position == there and moved.requirements != problem.requirements
    assert [c.name for c in moved.constraints] == [c.name for c in built.constraints]
    for constraint, other in zip(moved.constraints, built.constraints, strict=True):
        assert constraint.structure == other.structure
        for key in ("parameters", "lower", "upper"):
            np.testing.assert_array_equal(getattr(constraint, key), getattr(other, key))


# ---- the table -----------------------------------------------------------------------------------------------------


def test_every_point_has_a_row_with_a_valid_certificate(aerial: Path) -> None:
    table = ip.sweep.open(aerial).to_table().sort_by("point")
    assert table["point"].to_pylist() == list(range(8))
    assert set(table["status"].to_pylist()) == {"certified"}
    assert table["normal"].to_pylist()[4] == [0.0, 0.6, 0.8]
    assert max(table["stationarity"].to_pylist()) < 1e-6 and max(table["violation"].to_pylist()) < 1e-8
    robot = ip.load_robot("tilthex_arm")
    data = robot.model.createData()
    frame = robot.model.getFrameId("ee")
    for row in table.to_pylist():
        pin.framesForwardKinematics(robot.model, data, np.array(row["q"]))
        turned = pin.Quaternion(np.array(row["target_quaternion"])).matrix()
        assert np.allclose(data.oMf[frame].rotation, turned, atol=1e-6)
        objective = ip.ImpactObjective(robot, ip.ImpactContact("ee", normal=row["normal"]))
        evaluation = objective.evaluate(row["q"])
        assert [row[key] for key in "HGVSE"] == pytest.approx([getattr(evaluation, key) for key in "HGVSE"])
        assert row["predicted_jump"] == pytest.approx(row["speed"] * evaluation.V**0.5)
        assert row["predicted_impulse"] == pytest.approx(row["speed"] / evaluation.G)


def test_each_posture_has_an_attainable_speed(aerial: Path, arm: Path) -> None:
    """The speed of a flying base is unbounded."""
    assert ip.sweep.open(aerial).to_table()["attainable_speed"].to_pylist() == [None] * 8
    prepared = prepare(ProblemSettings(robot="panda", normal=(0.0, 0.0, 1.0), collision=False))
    approach = AttainableSpeed(prepared.impact.robot, prepared.impact.objective, prepared.problem.requirements)
    rows = [row for row in ip.sweep.open(arm).to_table().to_pylist() if row["q"]]
    speeds = [row["attainable_speed"] for row in rows]
    assert rows and speeds == pytest.approx([approach.reached(np.array(row["q"])) for row in rows])


def test_a_point_agrees_with_optimize(aerial: Path) -> None:
    row = ip.sweep.open(aerial).to_table().sort_by("point").to_pylist()[6]
    robot = ip.load_robot("tilthex_arm")
    objective = ip.ImpactObjective(robot, ip.ImpactContact("ee", normal=(0, 0.6, 0.8)))
    solution = ip.optimize(ip.PostureProblem(objective, target_quaternion=TILTED), starts=3, jobs=1)
    assert row["value"] == pytest.approx(objective.value(solution.q), rel=1e-8)


def test_speeds_share_a_solution_unless_a_bound_depends_on_them(aerial: Path, tmp_path: Path) -> None:
    slow, fast = ip.sweep.open(aerial).to_table().sort_by("point").to_pylist()[:2]
    assert slow["q"] == fast["q"] and fast["predicted_jump"] == pytest.approx(4 * slow["predicted_jump"])
    bound = "normal = [0, 0, 1]\nstarts = 2\nmax_force = 200\ncontact_stiffness = 1e5\n[grid]\nspeed = [0.5, 1]"
    solve('[problem]\nrobot = "tilthex_arm"\n' + bound, tmp_path)
    slow, fast = ip.sweep.open(tmp_path / "out").to_table().sort_by("point").to_pylist()
    assert slow["q"] != fast["q"]


def test_an_infeasible_point_has_a_reason(arm: Path, tmp_path: Path) -> None:
    rows = ip.sweep.open(arm).to_table().sort_by("point").to_pylist()
    assert [row["status"] for row in rows] == ["certified", "infeasible"] * 3
    assert all("pose of panda_hand_tcp (off by" in row["reason"] for row in rows[1::2])
    assert all(row["q"] is None and row["value"] is None for row in rows[1::2])
    shown = draw_maps(arm, tmp_path)
    assert shown.counts == {"certified": 3, "infeasible": 3, "uncertified": 0, "undefined": 0}
    (best, *_) = shown.best
    # Maps show six digits.
    assert best["z"] == 0 and best["value"] == float(f"{rows[best['point']]['value']:.6g}")
    assert [path.name for path in shown.files] == ["map-0.png"]


def test_settings_make_cases(tmp_path: Path) -> None:
    text = '[problem]\nrobot = "tilthex_arm"\nnormal = [0, 0, 1]\nstarts = 2\n[grid]\n'
    solve(text + 'objective = ["impulse", "energy"]\narmature = ["none", { shoulder_pitch = 0.02 }]', tmp_path)
    rows = ip.sweep.open(tmp_path / "out").to_table().sort_by("point").to_pylist()
    assert [row["case"] for row in rows] == [0, 1, 2, 3]
    assert [row["objective"] for row in rows] == ["impulse", "impulse", "energy", "energy"]
    assert json.loads(rows[1]["armature"]) == {"shoulder_pitch": 0.02}
    assert len({row["H"] for row in rows}) == 4


# ---- executors and resumed folders ---------------------------------------------------------------------------------


def test_the_bytes_do_not_depend_on_the_executor(aerial: Path, tmp_path: Path) -> None:
    wanted = shards(aerial)
    with process_pool(1) as pool:
        solve(AERIAL, tmp_path, pool, "pool")
    with ThreadPoolExecutor(2) as threads:
        solve(AERIAL, tmp_path, threads, "threads", in_hand=2)
    assert shards(tmp_path / "pool") == shards(tmp_path / "threads") == wanted
    sweep = read_sweep(tmp_path / "sweep.toml")
    key = json.loads((aerial / "manifest.json").read_text())["key"]
    backwards = [solve_shard(sweep, key, shard).content for shard in (2, 1, 0)]
    assert backwards[::-1] == [solve_shard(sweep, key, shard).content for shard in range(3)]


def test_a_dask_cluster_gives_the_same_bytes(aerial: Path, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(n_workers=2, processes=False, dashboard_address=None) as cluster,
        dask_cluster(cluster.scheduler_address) as executor,
    ):
        solve(AERIAL, tmp_path, executor)
    assert shards(tmp_path / "out") == shards(aerial)


def test_a_sweep_repeats_missing_and_damaged_shards(aerial: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    solve(AERIAL, tmp_path)
    first, second, _ = sorted(folder.glob("data/*/*.parquet"))
    first.unlink()
    second.write_bytes(second.read_bytes()[:-9])
    (folder / "notes.txt").write_text("mine")
    left = folder / "data/case=0/.shard-000001.parquet.4711.part"
    left.write_bytes(b"part of a killed run")
    seen: list[tuple[int, int]] = []
    assert solve(AERIAL, tmp_path, progress=lambda done, all_of: seen.append((done, all_of))).shards == 2
    # The second pass of two shards requires the first pass of all three shards.
    assert seen == [(0, 14), (3, 14), (6, 14), (8, 14), (11, 14), (14, 14)]
    assert shards(folder) == shards(aerial)
    assert (folder / "notes.txt").read_text() == "mine" and not left.exists()
    assert not (folder / "first-pass").exists()
    assert solve(AERIAL, tmp_path).shards == 0


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Return the shards of a sweep that was not interrupted."""
    folder = tmp_path_factory.mktemp("whole")
    solve(SWITCHING.format(starts=1, shard=7), folder)
    return shards(folder / "out")


def test_an_interrupted_sweep_continues_in_either_pass(tmp_path: Path, whole: dict[str, bytes]) -> None:
    """Each run stops after two shards, whose points are in the table.  A foreign file is not deleted."""
    sweep, folder, stops = SWITCHING.format(starts=1, shard=7), tmp_path / "out", 0

    def stop(done: int, count: int) -> None:
        if 7 < done < count:
            raise KeyboardInterrupt

    while shards(folder) != whole:
        with contextlib.suppress(KeyboardInterrupt):
            solve(sweep, tmp_path, progress=stop)
        assert ip.sweep.open(folder).count_rows() == min(25, 14 * (stops := stops + 1))
        if (folder / "first-pass").exists():
            (folder / "first-pass/notes.txt").write_text("mine")
    assert stops == 4
    assert [path.name for path in folder.glob("first-pass/**/*")] == ["notes.txt"]


@pytest.mark.long
def test_neighboring_shards_share_their_optima(tmp_path: Path) -> None:
    """In the first pass, the points of the sweep end in different optima."""
    sweep = read_sweep(write(SWITCHING.format(starts=2, shard=1), tmp_path))
    run_sweep(sweep, tmp_path / "out")
    rows = ip.sweep.open(tmp_path / "out").to_table().sort_by("point").to_pylist()
    key = json.loads((tmp_path / "out/manifest.json").read_text())["key"]
    first = [read_shard(solve_shard(sweep, key, shard).content)[0].row for shard in range(sweep.shards)]
    before, after = (np.array([row["value"] for row in table]) for table in (first, rows))
    assert (after <= before).all() and (after < 0.7 * before).sum() >= 3
    assert {row["status"] for row in rows} == {"certified"}
    for point in np.flatnonzero(after < before):
        target = CaseSolver(sweep.cases[0]).target(sweep.grid.values(int(point)))[0]
        problem = prepare(replace(sweep.cases[0].settings, target_position=target)).problem
        q = np.array(rows[point]["q"])
        assert problem.objective.value(q) == pytest.approx(after[point], rel=1e-9)
        assert certify(problem, q, before[point]).holds()


def test_the_key_depends_on_files_of_the_robot_and_the_posture(tmp_path: Path) -> None:
    """Limits and posture files do not affect the dynamics, but they affect the key."""
    urdf = urdfs.write(tmp_path, link("base"), link("arm", 2, "0.5 0 0"), joint("swing", "base arm", "0 0 1"))
    posture = tmp_path / "posture.json"
    text = '[problem]\nrobot = "written.urdf"\nframe = "arm"\nnormal = [0, 1, 0]\nposture = "posture.json"\n'
    sweep, keys = write(text + '[grid]\nobjective = ["impulse"]\n', tmp_path), []
    for upper, angle in (("2.5", 0.1), ("2.5", 0.1), ("2", 0.1), ("2", 0.2)):
        urdf.write_text(urdf.read_text(encoding="utf-8").replace('upper="2.5"', f'upper="{upper}"'), encoding="utf-8")
        posture.write_text(json.dumps({"joints": {"swing": angle}}), encoding="utf-8")
        keys.append(sweep_key(read_sweep(sweep)))
    assert keys[0] == keys[1] and len(set(keys)) == 3


@pytest.mark.long(but=("beside optima",))
@pytest.mark.parametrize("y", [[0.1], [0.0, 0.1]], ids=["alone", "beside optima"])
def test_points_out_of_reach_are_infeasible_and_others_avoid_the_wall(tmp_path: Path, y: list[float]) -> None:
    """The first point is out of reach; for the other points, most starts end with a link in the wall."""
    problem = '[problem]\nrobot = "xarm7"\nnormal = [-1, 0, 0]\nholdable = false\nstarts = 4\n'
    solve(f"{problem}[grid]\nx = [2.0, 0.0]\ny = {y}", tmp_path)
    rows = ip.sweep.open(tmp_path / "out").to_table().sort_by("point").to_pylist()
    assert [row["status"] for row in rows] == ["infeasible"] * len(y) + ["certified"] * len(y)


def test_a_folder_of_another_sweep_is_refused(aerial: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = shards(aerial)
    for changed in (AERIAL.replace("0.5, 2", "0.5, 3"), AERIAL.replace("shard = 3", "shard = 2")):
        with pytest.raises(OutputError, match="another sweep"):
            solve(changed, tmp_path, name=os.path.relpath(aerial, tmp_path))
    with (aerial / "manifest.json").open() as held:
        import fcntl

        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(OutputError, match="in use"):
            solve(AERIAL, tmp_path, name=os.path.relpath(aerial, tmp_path))
    monkeypatch.setattr("impact_posture.system.libraries.__version__", "99")
    monkeypatch.setattr("impact_posture.sweep.sweep_manifest.__version__", "99")
    with pytest.raises(OutputError, match="another version"):
        solve(AERIAL, tmp_path, name=os.path.relpath(aerial, tmp_path))
    assert shards(aerial) == before
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("years of work")
    with pytest.raises(OutputError, match="exists"):
        solve(AERIAL, tmp_path, name="mine")
    assert os.listdir(tmp_path / "mine") == ["thesis.tex"]


def test_speeds_with_the_same_problem_have_the_same_result(monkeypatch: pytest.MonkeyPatch) -> None:
    """The better optimum is at the last point.  Along y, only points with the first speed are neighbors."""
    values = {(0, 0): 9.0, (0, 1): 9.0, (1, 0): 9.0, (1, 1): 1.0}
    template = SimpleNamespace(problem=object())
    solver: Any = SimpleNamespace(
        normal_and_speed=lambda values: (None, values["speed"]),
        template=lambda normal, speed: template,
        target=lambda values: (values["y"], values["x"]),
        walk=lambda problem: "walk",
    )

    def search(walk: str, place: Any, guesses: Any, beside: float) -> PointResult:
        return PointResult({"value": values[place]}, Start(np.array([values[place]])))

    def improve(walk: str, place: Any, known: PointResult, guess: Start) -> PointResult:
        return PointResult({"value": guess.q[0]}, guess) if guess.q[0] < known.row["value"] else known

    monkeypatch.setattr(shard, "search", search)
    monkeypatch.setattr(shard, "improve", improve)
    sweep: Any = SimpleNamespace(grid=Grid((Axis("y", (0, 1)), Axis("x", (0, 1)), Axis("speed", (1.0, 2.0)))))
    points = shard._Shard(sweep, solver, range(8), [])
    points.solve()
    assert [result.row["value"] for result in points.results] == [1.0] * 8


# ---- rejected input ------------------------------------------------------------------------------------------------

PROBLEM = '[problem]\nrobot = "tilthex_arm"\nnormal = [0, 0, 1]\n'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[grid]\nx = [0]", "key 'problem'"),
        ('problem = "none.toml"\n[grid]\nx = [0]', "none.toml: no such file"),
        (PROBLEM + "speeed = 1\n[grid]\nx = [0]", "did you mean speed"),
        (PROBLEM + "[grid]\nx = []", "grid.x: is not an axis"),
        (PROBLEM + "[grid]\nx = { from = 0, to = 1 }", "from, to and count"),
        (PROBLEM + "[grid]\nx = { from = 0, to = nan, count = 3 }", "from, to and count"),
        (PROBLEM + f"[grid]\nx = {{ from = 0, to = {'9' * 400}, count = 3 }}", "from, to and count"),
        (PROBLEM + f"[grid]\nspeed = [{'9' * 400}]", "key 'speed'"),
        (PROBLEM + "[grid]\nrestitution = { from = 0, to = 1, count = 200000 }",
         "200000 combinations of restitution"),
        (PROBLEM + "[grid]\n" + "".join(f"{name} = {{ from = 0, to = 1, count = 1000000 }}\n" for name in "xyz"),
         "1000000000000000000 points"),
        (PROBLEM + "[grid]\nx = [0, inf]", "grid.x[1]"),
        (PROBLEM + "[grid]\nx = [0, 0.0]", "has a value twice"),
        (PROBLEM + "[grid]\nspeeds = [1]", "did you mean speed"),
        (PROBLEM + "[grid]\nspeed = [1, -1]", "grid.speed[1]"),
        (PROBLEM + "approach = true\n[grid]\nspeed = [1, 0]", "needs an approach speed"),
        (PROBLEM + "[grid]\nnormal = [[0, 0, 0]]", "not all zero"),
        (PROBLEM + '[grid]\nobjective = ["impulse", "sped"]', "did you mean speed"),
        (PROBLEM + "[grid]\nseed = [1]", "'seed' cannot vary"),
        (PROBLEM + "[grid]\ntarget_quaternion = [[0, 0, 0, 2]]", "norm 2"),
        (PROBLEM + 'path = true\n[grid]\nx = [0]', "remove these keys"),
        ("shard = 0\n" + PROBLEM + "[grid]\nx = [0]", "1 to 1e+06 points"),
        (PROBLEM + '[grid]\n"\\u001b[31m\\n" = [0]', "unknown axis"),
        (PROBLEM.replace("tilthex_arm", "a\\u001bb") + "[grid]\nx = [0]", "no robot"),
        (PROBLEM + 'contact_pose = "free"\n[grid]\nx = [0.1]', "contact pose is free"),
    ],
)  # fmt: skip
def test_a_wrong_file_is_refused_in_one_line(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(ImpactPostureError) as caught:
        solve(text, tmp_path)
    assert words in caught.value.line, caught.value.line
    assert caught.value.line.isprintable() and caught.value.hint
    assert not (tmp_path / "out").exists()


def test_the_command_refuses_wrong_arguments_in_one_line(tmp_path: Path, arm: Path) -> None:
    (tmp_path / "a.toml").write_text(PROBLEM + "[grid]\ny = [0, 0]")
    refused(run("sweep", "a.toml", cwd=tmp_path), 1, "has a value twice")
    refused(run("sweep", "show", tmp_path), 1, "contains no manifest.json")
    refused(run("sweep", "show", arm, "--axes", "x,w"), 1, "no axis 'w'")
    for words in (("show",), ("a.toml", "b"), ("a.toml", "--mpi", "--scheduler", "tcp://a:1")):
        assert run("sweep", *words, cwd=tmp_path).returncode == 2


def test_refused_options_of_slurm_leave_no_files(tmp_path: Path) -> None:
    pytest.importorskip("submitit")
    for options, words in (({"frob": 3}, "frob"), ({"timeout_min": "x"}, "timeout_min")):
        with pytest.raises(InputError, match=words):
            SlurmJobs(tmp_path / "a" / "logs", options, "local")
    SlurmJobs(tmp_path / "logs", {"timeout_min": 3}, "local").shutdown()
    assert not os.listdir(tmp_path)


def test_another_folder_cannot_be_opened_as_a_sweep(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="contains no"):
        ip.sweep.open(tmp_path)
    (tmp_path / "manifest.json").write_text('{"schema": 3}')
    with pytest.raises(SpecError, match="key 'schema'"):
        ip.sweep.open(tmp_path)
    with pytest.raises(InputError, match="is not KEY=VALUE"):
        parse_options(["timeout"])
    assert parse_options(["timeout_min=60", "slurm_partition=a=b"]) == {"timeout_min": 60, "slurm_partition": "a=b"}
