"""Settings of a problem in the short form that tests use."""

from __future__ import annotations

from impact_posture.config.problem_settings import ProblemSettings
from impact_posture.config.table_validation import validate


def make_settings(values: dict[str, object]) -> ProblemSettings:
    """Return checked settings, without collisions and motor loads unless the values request them.

    Tests with these settings only examine the impact and the optimization program.  With shapes and motors, some
    normals would be infeasible, for example because of a wall through the robot.  ``test_clearance.py``,
    ``test_holdable.py`` and the tests of the commands cover shapes and motors.
    """
    return validate(ProblemSettings, {"collision": False, "holdable": False, **values}, "options")
