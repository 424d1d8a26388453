"""The study of the available robot models: answers, refusals with their reason, and faults."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from docs.studies import robots
from docs.studies.core import ROOT, Request
from docs.studies.robots import lines, natural_normal, sources, study
from impact_posture.robot.robot_loader import load_robot
from impact_posture.robot.urdf import example_models
from tests.support.urdfs import joint, link, load, write

EXAMPLES = ROOT / "docs" / "examples"


def test_every_urdf_is_a_model_at_hand() -> None:
    assert len(example_models()) > 60 and set(example_models()) <= set(sources())


def test_a_stretched_arm_starts_from_the_bent_posture(tmp_path: Path) -> None:
    shutil.copy(EXAMPLES / "rail_arm" / "rail_arm.urdf", tmp_path)
    row = study(str(tmp_path / "rail_arm.urdf"), 2, 0, tmp_path)
    assert (row["outcome"], row["why"]) == ("answer", "")
    assert row["contact"] == "tool" and row["start"] == "bent" and row["joints"] == "7"
    assert float(row["optimum"]) <= float(row["objective"])


def test_a_refusal_has_its_reason(tmp_path: Path) -> None:
    row = study(str(write(tmp_path, link("s", 1), link("u"), joint("a", "s u"))), 2, 0, tmp_path)
    assert row["outcome"] == "refusal" and "kinematics only" in row["why"]


def test_a_wall_is_ahead_of_the_last_link_and_the_ground_below_a_foot(tmp_path: Path) -> None:
    tree = (link("s", 1), link("u", 1, "0.1 0 0"), link("tip"), joint("a", "s u"))
    toml = "[contact]\nframe = 'tip'\n[postures.up.joints]\na = -0.6435011087932844"
    arm = load(tmp_path, *tree, joint("m", "u tip", at="0.5 0 0", kind="fixed", more=""), toml=toml)
    assert natural_normal(arm) == (-0.8, 0.0, -0.6)
    standing = load_robot("solo12")
    foot = replace(standing.spec, contact=replace(standing.spec.contact, frame="FL_FOOT"))
    assert natural_normal(replace(standing, spec=foot)) == (0.0, 0.0, 1.0)
    assert natural_normal(standing) == (-1.0, 0.0, 0.0)


def test_faults_are_counted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A traceback and a process that does not end are faults."""
    monkeypatch.setattr(robots, "sources", lambda: {"model": str(tmp_path / "model.urdf")})
    monkeypatch.setattr(robots, "LIMIT", 0.1)
    request = Request(count=1)
    printed = list(lines(request))
    assert printed[-1] == "1 models: 0 answers, 0 refusals, 1 faults."
    assert "| model | – |" in printed[-3] and "fault: more than 0.1 s" in printed[-3]
    assert request.missed == ["model: more than 0.1 s"]
    monkeypatch.setattr(robots, "LIMIT", 60)
    monkeypatch.setattr(robots.sys, "executable", "/bin/false")
    assert "fault: exit 1" in list(lines(Request(count=1)))[-3]
