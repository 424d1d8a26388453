"""Check the code tour of the developer notes: every stop, in order, from a normal on the command line to C code."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import FrameType

import typer

from impact_posture_cli.app import app

PAGE = Path(__file__).parents[2] / "docs" / "developer.md"


def test_the_walk_of_a_normal(tmp_path: Path) -> None:
    part = PAGE.read_text(encoding="utf-8").split("(walk)=")[1].split("## What you may touch")[0]
    stops = re.findall(r"^\| `([\w.]+)` \|", part, re.MULTILINE)
    assert 5 <= len(stops) <= 9
    words = [*re.findall(r"`impact-posture ([^`]+)`", part)[0].split(), "--out", str(tmp_path / "c")]
    names = {stop.rsplit(".", 1)[1] for stop in stops}
    passed: list[str] = []

    def look(frame: FrameType, event: str, argument: object) -> None:
        if event == "call" and frame.f_code.co_name in names:
            owner = frame.f_locals.get("self")
            module = str(frame.f_globals.get("__name__"))
            inner = f".{type(owner).__name__}" if owner is not None else ""
            stop = f"{module}{inner}.{frame.f_code.co_name}"
            if stop not in passed:
                passed.append(stop)

    command = typer.main.get_command(app)
    sys.setprofile(look)
    try:
        command.main(args=words, standalone_mode=False)
    finally:
        sys.setprofile(None)
    assert [stop for stop in passed if stop in stops] == stops
    header = (tmp_path / "c" / "tilthex_arm_ee.h").read_text(encoding="utf-8")
    assert "at the normal (0, 0.6, 0.8)" in header
