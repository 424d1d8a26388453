"""Damaged input files and result folders give a one-line error that names the file, and other files stay intact.

``--hostile-full`` tries twenty times as many files.
"""

from __future__ import annotations

import json
import random
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from impact_posture.api.posture_problem import PostureProblem
from impact_posture.api.posture_result import PostureResult
from impact_posture.output import plot
from impact_posture.posture.formulation.problem_file import prepare
from impact_posture.posture.search.multistart import solve
from impact_posture.simulation.scenario_file import scenario_path
from tests.hostile.arena import attack, strike
from tests.hostile.values import TOML, spoiled
from tests.support.settings import make_settings

PUSH = ("small.urdf", "--frame", "tip", "--normal", "0", "0", "1")
STOP = ("--out", "precious", "--force")
COUNT = 8

PROBLEM = """robot = "small.urdf"
frame = "tip"
normal = [0, 0, 1]
offset = [0.0, 0.0, 0.01]
impulse = 2.0
speed = 0.5
restitution = 0.1
metric = "kinetic"
objective = "impulse"
normal_cone = 5.0
contact_pose = "position"
hold = ["elbow"]
support = []
starts = 3
seed = 1
limit_margin = 0.05
regularization = 1e-3
payload = [["lower", 0.5]]
"""
ROBOT = """schema = "impact-posture/robot/1"
name = "small"
kind = "arm"
description = "two joints"
default_posture = "home"
[model]
urdf = "small.urdf"
root = "fixed"
lock = []
[contact]
frame = "tip"
offset = [0.0, 0.0, 0.0]
pose = "position"
[contact.frames]
lower = "free"
[constraints]
hold = ["elbow"]
limit_margin = 0.05
[armature]
default = 0.01
joints = { shoulder = 0.02 }
source = "a guess"
[limits.position]
shoulder = [-1.0, 1.0]
[limits.effort]
elbow = 5.0
[postures.home]
joints = { shoulder = 0.3, elbow = 0.4 }
"""
POSTURE = """{
 "schema": "impact-posture/posture/1",
 "robot": "small",
 "joints": {
  "shoulder": 0.1,
  "elbow": 0.2
 }
}
"""
BY_JOINT = "shoulder = 0.1\nelbow = 0.2\n"
YAML = "name: [shoulder, elbow]\nposition: [0.1, 0.2]\n"
JSON_VALUES = (
    "NaN", "Infinity", "-1e999", "[]", "{}", "null", "true", '"a"', '[["a"]]', "[1, 2, 3]", "1e308", '"\\u0000"'
)  # fmt: skip

# Name of a file, its valid content, and the command that reads the file.
FILES: dict[str, tuple[str, Callable[[], str], tuple[str, ...]]] = {
    "problem": ("problem.toml", lambda: PROBLEM, ("optimize", "problem.toml", *STOP)),
    "robot": ("robot.toml", lambda: ROBOT, ("inspect", "small.urdf", "--config", "robot.toml")),
    "robot beside": ("robot.toml", lambda: ROBOT, ("evaluate", *PUSH)),
    "scenario": (
        "scenario.toml", lambda: scenario_path("solo8-push").read_text(encoding="utf-8"),
        ("simulate", "scenario.toml", *STOP),
    ),
    "posture": ("p.json", lambda: POSTURE, ("evaluate", *PUSH, "--posture", "p.json")),
    "joint state": ("p.yaml", lambda: YAML, ("evaluate", *PUSH, "--posture", "p.yaml")),
    "weights": ("w.toml", lambda: BY_JOINT, ("evaluate", *PUSH, "--metric", "weighted", "--weights", "w.toml")),
    "armature": ("a.toml", lambda: BY_JOINT, ("inspect", "small.urdf", "--armature", "a.toml")),
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_spoiled_files(name: str, arena: Path, hostile_full: bool) -> None:
    file, text, argv = FILES[name]
    rng = random.Random(name)
    values = JSON_VALUES if file.endswith((".json", ".yaml")) else TOML

    def arrange(k: int) -> None:
        (arena / file).write_bytes(spoiled(text(), rng, values) if k else text().encode())

    outcomes = attack([argv] * (COUNT * (20 if hostile_full else 1)), arena, arrange)
    assert outcomes[0].code == 0 or "holds thesis.txt" in outcomes[0].err, outcomes[0].err
    assert any(outcome.code == 1 and file in outcome.err for outcome in outcomes[1:])
    assert (arena / "precious" / "thesis.txt").read_text() == "ten years"


# ---- result folders ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result folder without figures."""
    from tests.hostile.arena import SMALL

    place = tmp_path_factory.mktemp("result")
    (place / "small.urdf").write_text(SMALL)
    prepared = prepare(make_settings({
        "robot": str(place / "small.urdf"), "frame": "tip", "normal": (1.0, 0.0, 0.0), "contact_pose": "free",
    }))  # fmt: skip
    solution = solve(prepared.problem, starts=1, compile="never")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plot, "draw_all", lambda *_: [])
        result = PostureResult(PostureProblem.of(prepared), solution)
        result.save(place / "out", codegen=False, report=False, jobs=1)
    return place / "out"


def spoil_document(folder: Path, rng: random.Random) -> None:
    document = json.loads((folder / "result.json").read_text())
    at = document
    while isinstance(at, dict) and at:
        key = rng.choice(sorted(at))
        if not isinstance(at[key], dict) or rng.random() < 0.4:
            at[key] = rng.choice((None, [], {}, "a", -1, 1e308, [1.0], [[1.0]] * 3, True, "\0", [None] * 2))
            if rng.random() < 0.3:
                del at[key]
            break
        at = at[key]
    (folder / "result.json").write_text(json.dumps(document))


def spoil_arrays(folder: Path, rng: random.Random) -> None:
    with np.load(folder / "result.npz") as file:
        arrays = dict(file)
    name = rng.choice(sorted(arrays))
    with np.errstate(over="ignore"):
        huge = arrays[name] * 1e308
    wrong = (np.zeros(0), np.full_like(arrays[name], np.nan), arrays[name][..., :1], np.array(["a"]),
             np.ones((2, 2, 2)), np.array(1j), np.array([{}], dtype=object), huge)  # fmt: skip
    arrays[name] = wrong[rng.randrange(len(wrong))]
    np.savez(folder / "result.npz", **arrays)


def spoil_bytes(folder: Path, rng: random.Random) -> None:
    path = folder / rng.choice(("result.json", "result.npz", "problem.toml"))
    data = path.read_bytes()
    at = rng.randrange(len(data))
    path.write_bytes(rng.choice((data[:at], b"", data[:at] + b"\x00\xff" + data[at:], data * 2, b"[" * 100_000)))


def spoil_entries(folder: Path, rng: random.Random) -> None:
    path = folder / rng.choice(("result.json", "result.npz", "problem.toml"))
    path.unlink()
    kind = rng.randrange(3)
    if kind == 0:
        path.mkdir()
    elif kind == 1:
        path.symlink_to("/dev/null")


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("schema", "impact-posture/result/2", "result/2"),
        ("schema", ["a"] * 10_000, "schema"),
        ("H", float("nan"), "NaN"),
    ],
    ids=["schema", "list", "nan"],
)
def test_results_of_another_version(key: str, value: object, words: str, result: Path, arena: Path) -> None:
    shutil.copytree(result, arena / "out")
    document = json.loads((result / "result.json").read_text())
    (document if key == "schema" else document["optimal"])[key] = value
    (arena / "out" / "result.json").write_text(json.dumps(document))
    for command in (("plot", "out", "--figure", "jump"), ("report", "out")):
        outcome = strike(arena, *command)
        assert (outcome.code, outcome.complaints) == (1, []), outcome.err
        assert words in outcome.err and len(outcome.err) < 500


FAULTS = (spoil_document, spoil_arrays, spoil_bytes, spoil_entries)


@pytest.mark.parametrize("command", ["plot", "codegen", "report"])
def test_spoiled_results(command: str, result: Path, arena: Path, hostile_full: bool) -> None:
    rng = random.Random(command)
    more = {"plot": ("--figure", "jump", "--format", "svg"), "codegen": STOP, "report": ()}[command]

    def arrange(k: int) -> None:
        shutil.rmtree(arena / "out", ignore_errors=True)
        shutil.copytree(result, arena / "out")
        if k:
            rng.choice(FAULTS)(arena / "out", rng)

    outcomes = attack([(command, "out", *more)] * (COUNT * (20 if hostile_full else 1)), arena, arrange)
    assert outcomes[0].code == 0 or "holds thesis.txt" in outcomes[0].err, outcomes[0].err
    assert any(outcome.code == 1 and "out: " in outcome.err for outcome in outcomes[1:])
