"""Damaged result folders give a one-line error that names the file, and other files stay intact.

``--hostile-full`` tries forty times as many folders.
"""

from __future__ import annotations

import json
import os
import random
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from impact_posture.output import plot
from impact_posture.system.scratch_folder import RECORD
from tests.hostile.arena import attack, strike
from tests.hostile.values import spoiled

STOP = ("--out", "precious", "--force")
COUNT = 4


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
        ("q", [10**400, 0], "too large for a number"),
    ],
    ids=["schema", "list", "nan", "huge"],
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


@pytest.mark.parametrize("file", ["problem.toml", "result.json", "result.npz"])
def test_pipes_in_a_result(file: str, result: Path, arena: Path) -> None:
    shutil.copytree(result, arena / "out")
    (arena / "out" / file).unlink()
    os.mkfifo(arena / "out" / file)
    for command in (("plot", "out"), ("report", "out"), ("codegen", "out", *STOP), ("verify", "out")):
        outcome = strike(arena, *command)
        assert (outcome.code, outcome.complaints) == (1, []), (command, outcome.err)
        # A folder without result.json is not a result.
        assert (file in outcome.err or file == "result.json") and "Errno" not in outcome.err


MAP = {
    "q": np.zeros((5, 2)), "component": np.zeros(5, int), "s": np.arange(5.0), "objective": np.arange(1.0, 6.0),
    "feasible": np.ones(5, bool), "start": np.array([0]), "optimum": np.array([4]), "ends": np.array([1, 4]),
}  # fmt: skip
WRONG = {
    "longer": ("s", np.arange(6.0)), "empty": ("q", np.zeros((0, 2))), "another robot": ("q", np.zeros((5, 3))),
    "text": ("objective", np.array(["a"] * 5)), "numbers": ("feasible", np.ones(5)), "nan": ("s", np.full(5, np.nan)),
    "no index": ("optimum", np.array([5])), "negative": ("ends", np.array([-1])), "two": ("start", np.array([0, 1])),
    "huge": ("component", np.full(5, 10**9)), "scalar": ("ends", np.array(1)), "missing": ("feasible", None),
}  # fmt: skip


@pytest.mark.parametrize("fault", [*WRONG, ""])
def test_arrays_of_a_map_fit_each_other(fault: str, result: Path, arena: Path) -> None:
    shutil.copytree(result, arena / "out")
    name, array = WRONG.get(fault, ("s", MAP["s"]))
    with np.load(result / "result.npz") as file:
        arrays = dict(file) | {f"self_motion_{key}": value for key, value in {**MAP, name: array}.items()}
    np.savez(arena / "out" / "result.npz", **{key: value for key, value in arrays.items() if value is not None})
    outcome = strike(arena, "plot", "out", "--figure", "self_motion", "--format", "svg", "--out", "figures")
    assert (outcome.code, outcome.complaints) == (1 if fault else 0, []), outcome.err
    assert not fault or f"the array 'self_motion_{name}'" in outcome.err


def spoil_problem(folder: Path, rng: random.Random) -> None:
    path = folder / "problem.toml"
    path.write_bytes(spoiled(path.read_text(), rng))


def spoil_record(folder: Path, rng: random.Random) -> None:
    path = folder / RECORD
    path.write_bytes(rng.choice((b"", b"[]", b"{}", b'{"schema": 1}', b"\xff", path.read_bytes()[:-9])))
    if rng.random() < 0.5:
        (folder / "thesis.txt").write_text("ten years")


FAULTS = (spoil_document, spoil_arrays, spoil_bytes, spoil_entries)
# Command, its options, and the faults of the folder out/ that the command reads or replaces.
READERS = {
    "plot": (("plot", "out", "--figure", "jump", "--format", "svg"), FAULTS),
    "codegen": (("codegen", "out", *STOP), FAULTS),
    "report": (("report", "out"), FAULTS),
    "verify": (("verify", "out", "--samples", "1"), (spoil_problem, spoil_problem, spoil_bytes, spoil_entries)),
    "optimize": (
        ("optimize", "out/problem.toml", "--starts", "1", "--no-codegen", "--out", "out", "--force", "--quiet"),
        (spoil_problem, spoil_problem, spoil_record, *FAULTS),
    ),
}


@pytest.mark.parametrize("command", READERS)
def test_spoiled_results(
    command: str, result: Path, arena: Path, hostile_full: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = random.Random(command)
    argv, faults = READERS[command]
    if command == "optimize":
        monkeypatch.setattr(plot, "draw_all", lambda *_, **__: [])

    def arrange(k: int) -> None:
        shutil.rmtree(arena / "out", ignore_errors=True)
        shutil.copytree(result, arena / "out")
        if k:
            rng.choice(faults)(arena / "out", rng)

    outcomes = attack([argv] * (COUNT * (40 if hostile_full else 1)), arena, arrange)
    assert outcomes[0].code == 0 or "holds thesis.txt" in outcomes[0].err, outcomes[0].err
    assert any(outcome.code == 1 and re.search(r"out[:/]", outcome.err) for outcome in outcomes[1:])
