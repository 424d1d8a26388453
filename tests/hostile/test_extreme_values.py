"""Values that once caused internal errors: one sliding joint, distant origins, dates and few open files."""

from __future__ import annotations

import os
import resource
from pathlib import Path

import pytest

from impact_posture.output import plot
from tests.hostile import arena as attacker
from tests.hostile.arena import SMALL, Outcome, strike
from tests.simulation.factories import HIT
from tests.support.urdfs import joint, link, write

PUSH = ("--frame", "tip", "--normal", "1", "0", "0")


def clean(outcome: Outcome, code: int, *words: str) -> None:
    """Check the exit code, that no text of a library is printed, and the words of the error."""
    complaints = [c for c in outcome.complaints if code or c != "writes to standard error after success"]
    assert (outcome.code, complaints) == (code, []), outcome.err
    assert all(word in outcome.err for word in words), outcome.err


def test_one_sliding_joint(arena: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every command works for a robot with one prismatic joint, whose link has the contact shape."""
    pytest.importorskip("mujoco")
    monkeypatch.setattr(plot, "draw_all", lambda *_: [])
    box = "0.1 0.1 0.1"
    slide = joint("slide", "base tip", "1 0 0", kind="prismatic")
    write(arena, link("base", at="0.5 0 0", box=box), link("tip", 1, "0 0 0.3", box=box), slide)
    text = HIT.format(robot="written.urdf", frame="tip", more='posture = "neutral"')
    (arena / "slide.toml").write_text(text.replace("[0, 0, 1]", "[-1, 0, 0]"))
    (arena / "sweep.toml").write_text(
        '[problem]\nrobot = "written.urdf"\nframe = "tip"\nnormal = [1, 0, 0]\nstarts = 1\n[grid]\nspeed = [1, 2]\n'
    )
    for argv in (
        ("evaluate", "written.urdf", *PUSH),
        ("optimize", "written.urdf", *PUSH, "--starts", "1", "--no-codegen", "--out", "out"),
        ("codegen", "out", "--out", "c"),
        ("verify", "written.urdf", *PUSH, "--samples", "1"),
        ("codegen", "written.urdf", *PUSH, "--controller", "arm", "--out", "controller"),
        ("sweep", "sweep.toml", "--out", "sweep", "--workers", "1"),
        ("simulate", "slide.toml", "--out", "run", "--no-report", "--format", "svg"),
    ):
        clean(strike(arena, *argv), 0)


@pytest.mark.parametrize("owner", ["wrist", "lower", "base"])
def test_distant_origins(owner: str, arena: Path) -> None:
    """At 1e308 m, the distances of hulls overflow; at 1e100 m, their edges cannot be computed."""
    shape = '<collision><origin xyz="0 -1e100 0"/><geometry><sphere radius="0.1"/></geometry></collision>'
    text = {
        "wrist": SMALL.replace("0 0 0.3", "0 0 1e308"),
        "lower": SMALL.replace("0.01 0 0.15", "0.01 0 -1e308"),
        "base": SMALL.replace('<link name="world_link"/>', f'<link name="base">{shape}</link>').replace(
            '"world_link"', '"base"'
        ),
    }[owner]
    (arena / "small.urdf").write_text(text)
    outcome = strike(arena, "optimize", "small.urdf", *PUSH, "--starts", "1", "--out", "out")
    clean(outcome, 1, f"'{owner}' has an origin at", "up to 1e+10")


def test_distant_origins_of_an_mjcf(arena: Path) -> None:
    pytest.importorskip("mujoco")
    (arena / "far.xml").write_text(
        '<mujoco><worldbody><body><joint axis="0 1 0"/><geom size="0.1" pos="0 1e30 0"/></body></worldbody></mujoco>'
    )
    clean(strike(arena, "inspect", "far.xml"), 1, "far.xml", "coordinate of 1e+30 m")


@pytest.mark.parametrize("date", ["abc", "-5", "9" * 40, ""])
def test_dates_of_builds_do_not_matter(date: str, arena: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Matplotlib reads the date of a reproducible build for each PDF."""
    import matplotlib.pyplot as plt

    from impact_posture.output.plot.style import save

    monkeypatch.setenv("SOURCE_DATE_EPOCH", date)
    figure = plt.figure(figsize=(1, 1))
    written = [save(figure, arena, name, ["pdf"])[0].read_bytes() for name in "ab"]
    plt.close(figure)
    assert written[0] == written[1] and b"CreationDate" not in written[0]
    assert os.environ["SOURCE_DATE_EPOCH"] == date


def test_overflows_in_a_program_are_not_printed(arena: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plot, "drawable", lambda *_: [])
    more = ("--regularization", "1e308", "--contact-pose", "free", "--starts", "1", "--no-codegen", "--no-report")
    outcome = strike(arena, "optimize", "small.urdf", *PUSH, *more, "--out", "out", "--compile", "never", "--quiet")
    assert outcome.complaints == [] and "CasADi" not in outcome.err, outcome.err


@pytest.mark.parametrize("most", [4, 5])
@pytest.mark.parametrize("command", ["evaluate", "optimize"])
def test_few_open_files(command: str, most: int, arena: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a limit of four files, only one file can be open in addition to standard input, output and error."""

    def limited(*arguments: object) -> int:
        os.closerange(3, 1 << 10)
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
        return inner(*arguments)

    inner = attacker.run
    monkeypatch.setattr(attacker, "run", limited)
    more = ("--contact-pose", "free", "--starts", "1", "--out", "out") if command == "optimize" else ()
    outcome = strike(arena, command, "small.urdf", *PUSH, *more)
    if outcome.code:
        clean(outcome, 1, "Too many open files", "ulimit -n")
    assert outcome.code or (command, most) == ("evaluate", 5)
