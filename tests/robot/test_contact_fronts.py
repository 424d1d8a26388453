"""The default contact points of the catalogue are at the ends of the tools, or a warning states the distance."""

from __future__ import annotations

import numpy as np
import pytest

from docs.studies.fronts import FORWARD, front
from impact_posture.config.problem_settings import ImpactSettings
from impact_posture.impact.contact_point import BEYOND
from impact_posture.impact.resolved_impact import resolve
from impact_posture.robot.robot_loader import known_robots
from tests.support.helpers import robot


@pytest.mark.parametrize("name", known_robots())
def test_a_tool_ends_at_its_contact_point_and_a_base_is_warned_about(name: str) -> None:
    loaded = robot(name)
    for frame, axis in FORWARD.get(name, {}).items():
        measured = front(loaded, frame, axis)
        assert abs(measured.reach) < BEYOND
        # The contact point has the height of the front, and is near the middle of the front.
        assert np.linalg.norm(np.subtract(measured.offset, loaded.spec.contact.offset_of(frame))) < BEYOND
    if name in FORWARD:
        assert loaded.spec.contact.frame in FORWARD[name]
        return
    for normal in ((1, 0, 0), (0, 1, 0), (-1, 0, 0)):
        impact = resolve(ImpactSettings(robot=name, normal=normal))
        (line,) = (line for line in impact.warnings if "a flat surface touches" in line)
        fronted = resolve(ImpactSettings(robot=name, normal=normal, contact_point="front"))
        assert not [line for line in fronted.warnings if "a flat surface touches" in line]
        reach = -np.dot(fronted.contact.offset, np.array(normal))
        assert f"{1e3 * reach:.0f} mm beyond" in line


def test_tools_are_frames_of_links_that_are_not_a_base() -> None:
    assert {name for name in known_robots() if robot(name).spec.contact.frame not in ("base", "base_link")} == set(
        FORWARD
    )
