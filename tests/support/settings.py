"""Settings of a problem as tests write them."""

from __future__ import annotations

from impact_posture.config.problem_settings import ProblemSettings
from impact_posture.config.table_validation import validate


def make_settings(values: dict[str, object]) -> ProblemSettings:
    """Check values like options.  Collisions and loads count only if the values ask for them.

    Tests with these settings are about the impact and the program.  Shapes and motors would make some normals
    impossible (a wall through the robot).  ``test_clearance.py``, ``test_holdable.py`` and the commands test them.
    """
    return validate(ProblemSettings, {"collision": False, "holdable": False, **values}, "options")
