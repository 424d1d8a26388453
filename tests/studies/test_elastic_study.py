"""Short run of the study of elastic joints: MuJoCo's compression, the elastic response, and the page."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from docs.studies.core import Request, page_of
from docs.studies.elastic.figure import PICTURE, figure
from docs.studies.elastic.study import STUDIED, lines, rows_of
from docs.studies.elastic.world import ElasticWorld
from impact_posture.impact.elasticity.elastic_impact import ElasticImpact
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.robot.robot_spec import JointTransmissionSpec, TransmissionSpec
from tests.support.helpers import assert_close, rng, unit

pytest.importorskip("mujoco")


@pytest.mark.long(but=("10000.0-talos arm", "1000000.0-panda", "10000.0-own arm"))
@pytest.mark.parametrize("name", list(STUDIED))
@pytest.mark.parametrize("stiffness", [1e4, 1e6])
def test_mujoco_finds_the_same(name: str, stiffness: float) -> None:
    """Compare slow impacts, in which the arm hardly moves, with dampers, a rigid joint and a stiffer spring."""
    studied, generator = STUDIED[name], rng(name, "MuJoCo")
    plain = studied.robot()
    first, *others = studied.joints
    springs = {joint: JointTransmissionSpec("elastic", 200.0, 0.1) for joint in others}
    springs |= {first: JointTransmissionSpec("rigid"), others[1]: JointTransmissionSpec("elastic", 5e3)}
    arm = replace(plain, spec=replace(plain.spec, transmission=TransmissionSpec(joints=springs)))
    impact = ElasticImpact(ImpactCase(arm, ImpactContact(studied.frame, tuple(unit(generator)))))
    q, speed = arm.posture(), 0.02
    response = impact.response(q, stiffness, speed)
    measured = ElasticWorld(impact).compress(q, stiffness, speed, response.duration)
    assert measured.duration == pytest.approx(response.duration, rel=0.005)
    assert measured.force == pytest.approx(response.force, rel=0.005)
    assert measured.peak == pytest.approx(response.peak_jump_norm, rel=0.01)
    assert_close(measured.jump, response.jump, 0.01, "links")
    assert_close(measured.torque, response.peak_torque, 0.02, "torques")


def test_an_error_of_the_model_shows() -> None:
    """A wrong spring stiffness causes errors above the targets of the study."""
    studied = STUDIED["own arm"]
    arm = studied.robot()
    case = ImpactCase(arm, ImpactContact(studied.frame, (0.0, 0.0, 1.0)))
    impact, q = ElasticImpact(case), arm.posture()
    stiff = replace(arm, spec=replace(arm.spec, transmission=TransmissionSpec("elastic", 600.0)))
    other = ElasticImpact(replace(case, robot=stiff)).response(q, 2e3, 0.1)
    measured = ElasticWorld(impact).compress(q, 2e3, 0.1, other.duration)
    assert abs(other.peak_jump_norm / measured.peak - 1) > 0.1


def test_the_page_in_short(capsys: pytest.CaptureFixture[str]) -> None:
    request = Request(only="own arm", count=2, write=False)
    text = "\n".join(lines(request))
    assert request.missed == []
    assert re.search(r"`elastic` within 10% of the peak link velocity in every impact: \*\*met\*\*", text)
    assert text.count("| own arm |") == 1 and "panda" not in text
    assert "own arm" in capsys.readouterr().err


def test_the_figure_has_every_impact() -> None:
    rows = list(rows_of("own arm", 1, 0))
    drawing = figure(rows)
    assert len(drawing.axes) == 2
    for axes in drawing.axes:
        marks = [line for line in axes.lines if line.get_linestyle() == "None"]
        assert [len(line.get_xdata()) for line in marks] == [len(rows)] * 3
    assert all(0.05 <= row.x <= 2.0 for row in rows)
    assert np.isfinite([[*row.error.values(), *row.force_error.values()] for row in rows]).all()


def test_the_page_says_what_is_assumed_and_met() -> None:
    text = page_of("elastic").read_text(encoding="utf-8")
    assert all(f"`{name}`" in text for name in STUDIED)
    assert text.count("**assumed**") == 2 and "missed" not in text
    assert PICTURE.is_file()
