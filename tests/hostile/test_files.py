"""Damaged input files give a one-line error that names the file, and other files stay intact.

``--hostile-full`` tries forty times as many files.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

import pytest

from impact_posture.simulation.scenario_file import scenario_path
from tests.hostile.arena import attack
from tests.hostile.values import TOML, spoiled

PUSH = ("small.urdf", "--frame", "tip", "--normal", "0", "0", "1")
STOP = ("--out", "precious", "--force")
COUNT = 4

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

    outcomes = attack([argv] * (COUNT * (40 if hostile_full else 1)), arena, arrange)
    assert outcomes[0].code == 0 or "holds thesis.txt" in outcomes[0].err, outcomes[0].err
    assert any(outcome.code == 1 and file in outcome.err for outcome in outcomes[1:])
    assert (arena / "precious" / "thesis.txt").read_text() == "ten years"
