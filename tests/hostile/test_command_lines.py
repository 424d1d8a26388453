"""For invalid values of any option, every command prints an error in one line and leaves files intact.

``--hostile-full`` tries twenty times as many values.
"""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import pytest

from impact_posture_cli.app import build
from tests.hostile.arena import attack
from tests.hostile.values import value

PUSH = ("small.urdf", "--frame", "tip", "--normal", "0", "0", "1")
# Commands that would run for long stop early, because their output folder exists and must not be replaced.
STOP = ("--out", "precious", "--force")
SOUND: dict[str, tuple[str, ...]] = {
    "inspect": ("small.urdf",),
    "evaluate": PUSH,
    "optimize": (*PUSH, *STOP),
    "codegen": (*PUSH, *STOP),
    "simulate": ("aerial-vertical", *STOP),
    "compare": ("aerial-vertical", *STOP),
    "reproduce": STOP,
    "plot": ("precious",),
    "robots": (),
}
COUNT = 8


def parameters(command: str) -> list[Any]:
    return list(build(command).params)


def spoil(command: str, rng: random.Random) -> tuple[str, ...]:
    """Return a valid command line with one or two additional options, or with another argument."""
    words = [command, *SOUND[command]]
    for _ in range(rng.choice((1, 1, 2))):
        parameter = rng.choice(parameters(command))
        if parameter.param_type_name == "argument":
            words[1:2] = [value(rng)]
            continue
        name = rng.choice([*parameter.opts, *parameter.secondary_opts])
        count = 0 if parameter.is_flag else parameter.nargs
        words += [name, *(value(rng) if rng.random() < 0.8 else "1" for _ in range(count))]
    if rng.random() < 0.15:
        words.insert(rng.randrange(1, len(words) + 1), value(rng))
    if rng.random() < 0.1:
        del words[rng.randrange(len(words))]
    return tuple(words)


@pytest.mark.parametrize("command", SOUND)
def test_values_that_make_no_sense(command: str, arena: Path, hostile_full: bool) -> None:
    rng = random.Random(command)
    stops = SOUND[command][-3:] == STOP
    cases = [(command, *SOUND[command]), *(spoil(command, rng) for _ in range(COUNT * (20 if hostile_full else 1)))]
    # If the option `--out` is given twice, the last value applies.
    outcomes = attack([(*case, *STOP) if stops else case for case in cases], arena)
    assert len({outcome.code for outcome in outcomes}) > 1
    assert (arena / "precious" / "thesis.txt").read_text() == "ten years"


def test_no_command_and_wrong_commands(arena: Path) -> None:
    rng = random.Random(0)
    outcomes = attack([*[(value(rng), value(rng)) for _ in range(8)], ("--json",), ("evaluate", "--json")], arena)
    assert {outcome.code for outcome in outcomes} == {2}
