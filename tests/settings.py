"""Settings of a problem as tests write them."""

from __future__ import annotations

from impact_posture.settings import ProblemSettings
from impact_posture.tables import validate


def make_settings(values: dict[str, object]) -> ProblemSettings:
    """Check values as those of options are checked."""
    return validate(ProblemSettings, values, "options")
