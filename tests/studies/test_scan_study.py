"""Short run of the study that scans the redundancy: postures, caption and figure."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="mujoco is not installed (the extra 'sim')")

from matplotlib.image import imread

from docs.studies import scan
from docs.studies.core import page_of
from docs.studies.scan import ARM, HUMANOID, Place
from impact_posture.dynamics.numeric import Numeric
from impact_posture.impact.impact_contact import point_on
from impact_posture.simulation.scenario_file import read_scenario
from impact_posture.simulation.setup import set_up


def test_the_arm_looks_at_the_floor_along_the_whole_scan() -> None:
    shipped = set_up(read_scenario(ARM))
    setups = list(scan._setups(ARM, 4))
    assert [setup.q[-1] for setup in setups] == pytest.approx([0.0, 0.5, 0.9, 1.0, 1.5])
    np.testing.assert_allclose(setups[2].q[-3:], shipped.q[-3:], atol=1e-12)
    for setup in setups:
        placement = Numeric(setup.robot.model).at(setup.q).placement(point_on(setup.robot, "ee"))
        np.testing.assert_allclose(placement.rotation[:, 2], [0, 0, -1], atol=1e-9)
        assert setup.gap == pytest.approx(shipped.gap)
        assert setup.scenario.control == shipped.scenario.control


def places() -> list[Place]:
    """Return scan points: the motion doubles on the way to the lowest H, and halves at the highest H."""
    start = Place(0.9, 40.0, 9.0, 9.0, 1.0, 2.0, 300.0, "completed")
    return [
        replace(start, at=0.0, H=0.4, motion=0.1, jump=0.5, force=900.0),
        replace(start, at=0.45, H=10.0, V=16.0, S=None, motion=2.0),
        start,
        replace(start, at=1.2, H=60.0, motion=9.0, status="fell"),
        replace(start, at=1.5, H=80.0, motion=0.5, jump=1.0, force=150.0),
    ]


def test_the_caption_says_what_the_picture_shows() -> None:
    arm, humanoid = scan._caption({ARM: places(), HUMANOID: places()[2::-1]})
    assert (
        "H is lowest at 0 rad, where the motion changes by −90 %, the jump by −75 %, "
        "and the force becomes 3 times as large." in arm
    )
    assert "from the shipped 0.9 rad, the motion at first changes by +100 % (at 0.45 rad)" in arm
    assert "at 1.5 rad, H rises from 40 to 80, and the motion changes by −50 %, the jump by −50 %" in arm
    assert "√H falls to 0.10 and the motion to 0.10, while √V first rises to 1.33" in humanoid


def test_it_is_drawn_and_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scan, "PICTURE", tmp_path / "scan.png")
    scan.draw(places(), places()[2::-1])
    picture = imread(tmp_path / "scan.png")
    assert picture.shape[1] > 1000 and picture[..., :3].std() > 0.05
    lines = list(scan._told(ARM, places()))
    assert "| 0.45 | 10 | 16 | – | 2 | 2 | 300 | completed |" in lines
    assert "| 1.2 | 60 | 9 | 9 | 9 | 2 | 300 | fell |" in lines
    written = page_of("scan").read_text(encoding="utf-8")
    assert f"`{ARM}`" in written and f"`{HUMANOID}`" in written
