"""Settings of a problem as tests write them."""

from __future__ import annotations

from impact_posture.settings import ProblemSettings
from impact_posture.tables import validate


def make_settings(values: dict[str, object]) -> ProblemSettings:
    """Check values as those of options are checked; nothing keeps the robot from collisions unless they ask for it.

    What is tested with these settings is the impact and the program. Shapes would only make some of its normals
    impossible (a wall through the robot).  ``tests/test_clearance.py`` and the commands have them.
    """
    return validate(ProblemSettings, {"collision": False, **values}, "options")
