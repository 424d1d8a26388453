"""A pipe, device or folder in the place of a file is an error in one line, and no command waits for it."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import pytest

from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.errors import InputError
from impact_posture_cli.app import build
from tests.hostile.arena import SMALL, judging, strike
from tests.hostile.test_command_lines import SOUND
from tests.hostile.test_robot_files import ARM

# Longest permitted time of a command, s.  A pipe that only the C++ libraries notice takes several times less.
PATIENCE = 15
PUSH = ("--frame", "tip", "--normal", "1", "0", "0")
# File name extensions that select the format in which a command reads a file.
ENDINGS = ("toml", "json", "yaml", "urdf", "xml", "xacro", "srdf")


def names_a_file(parameter: Any) -> bool:
    words = f"{parameter.metavar or ''} {parameter.name}".upper()
    return parameter.nargs == 1 and any(
        word in words for word in ("FILE", "DIR", "TOML", "ROBOT", "SCENARIO", "SRDF")
    )


def lines_of(command: str) -> list[tuple[str, ...]]:
    """Return a command line for each argument or option of a command that can name a file."""
    lines = []
    for parameter in build(command).params:
        for ending in ENDINGS if names_a_file(parameter) else ():
            if parameter.param_type_name == "argument":
                lines.append((command, f"pipe.{ending}", *SOUND.get(command, ())[1:]))
            elif not parameter.is_flag:
                lines.append((command, *SOUND.get(command, ()), parameter.opts[0], f"pipe.{ending}"))
    return lines


@pytest.mark.parametrize("command", sorted({*SOUND, "report", "view", "verify", "sweep"} - {"robots"}))
def test_options_that_name_a_pipe(command: str, arena: Path, hostile_full: bool) -> None:
    for ending in ENDINGS:
        os.mkfifo(arena / f"pipe.{ending}")
    lines = lines_of(command)
    assert lines
    with judging() as judge:
        for line in lines if hostile_full else lines[:: len(ENDINGS) - 1]:
            start = time.monotonic()
            outcome = strike(arena, *line)
            slow = ["takes too long"] if time.monotonic() > start + PATIENCE else []
            judge(f"{line}: {outcome.err}", outcome.complaints + slow, 0)


@pytest.mark.parametrize("device", ["/dev/zero", "/dev/full", "/dev/tty", "/etc"])
@pytest.mark.parametrize("option", ["", "--config", "--srdf", "--armature"])
def test_devices(option: str, device: str, arena: Path) -> None:
    outcome = strike(arena, "inspect", *(("small.urdf", option) if option else ()), device)
    assert (outcome.code, outcome.complaints) == (1, []), outcome.err
    assert device in outcome.err and len(outcome.err) < 500


REFERENCES = {
    "mesh of a URDF": ("a.urdf", SMALL.replace("</inertial>", "</inertial><collision><geometry>"
                       '<mesh filename="pipe"/></geometry></collision>'), "no mesh 'pipe'"),
    "include of an MJCF": ("a.xml", ARM.replace("<worldbody>", '<include file="pipe"/><worldbody>'),
                           "pipe or a device"),
    "mesh of an MJCF": ("a.xml", ARM.replace("<worldbody>", '<asset><mesh file="pipe.obj"/></asset><worldbody>'),
                        "is not a file"),
    "skin of an MJCF": ("a.xml", ARM.replace("<worldbody>", '<asset><skin file="pipe.skn"/></asset><worldbody>'),
                        "pipe or a device"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFERENCES)
def test_references_to_a_pipe(name: str, arena: Path) -> None:
    file, text, words = REFERENCES[name]
    for pipe in ("pipe", "pipe.obj", "pipe.skn"):
        os.mkfifo(arena / pipe)
    (arena / file).write_text(text)
    start = time.monotonic()
    outcome = strike(arena, "inspect", file)
    assert (outcome.code, outcome.complaints) == (0 if "URDF" in name else 1, []), outcome.err
    assert words in outcome.err and time.monotonic() < start + PATIENCE


def test_a_pipe_beside_a_robot(arena: Path) -> None:
    os.mkfifo(arena / "small.srdf")
    outcome = strike(arena, "inspect", "small.urdf", "--write-robot-toml", "draft.toml")
    assert (outcome.code, outcome.complaints) == (1, []), outcome.err
    assert "small.srdf" in outcome.err


def test_an_include_of_a_xacro_file(arena: Path) -> None:
    pytest.importorskip("xacro")
    os.mkfifo(arena / "pipe")
    include = '<robot name="a" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="pipe"/></robot>'
    (arena / "a.xacro").write_text(include)
    outcome = strike(arena, "inspect", "a.xacro")
    assert (outcome.code, outcome.complaints) == (1, []), outcome.err
    assert "a.xacro" in outcome.err and "pipe or a device" in outcome.err


def test_a_text_of_a_xacro_file_that_fills_the_memory(arena: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("xacro")
    monkeypatch.setattr("impact_posture.system.isolated_calls.MOST_MEMORY", 1 << 29)
    grows = """<robot name="a" xmlns:xacro="http://www.ros.org/wiki/xacro"><link name="${'a' * 10**9}"/></robot>"""
    (arena / "a.xacro").write_text(grows)
    outcome = strike(arena, "inspect", "a.xacro")
    assert (outcome.code, outcome.complaints) == (1, []), outcome.err
    assert "a.xacro" in outcome.err and "memory" in outcome.err.lower()


@pytest.mark.parametrize("name", ["small.json", "small.h", "libsmall.so.sha256"])
def test_pipes_in_an_export(name: str, arena: Path) -> None:
    outcome = strike(arena, "codegen", "small.urdf", *PUSH, "--prefix", "small", "--compile", "--out", "c", "--quiet")
    assert (outcome.code, outcome.complaints) == (0, []), outcome.err
    (arena / "c" / name).unlink()
    os.mkfifo(arena / "c" / name)
    if name == "small.h":
        (arena / "c" / "libsmall.so").unlink()
    with pytest.raises(InputError, match="pipe or a device"):
        _ = ImpactGradient.load(arena / "c" / "small.json").objective
