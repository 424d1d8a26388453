"""Sources of DAQP for tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from impact_posture.controller_export.daqp_sources import daqp_sources
from impact_posture.errors import InputError


def sources_or_skip() -> dict[str, bytes]:
    """Return the DAQP sources from ``$DAQP_SOURCES`` or from pip; skip the test if neither has them."""
    folder = os.environ.get("DAQP_SOURCES")
    if folder:
        return daqp_sources(Path(folder))
    try:
        return daqp_sources()
    except InputError as error:
        return pytest.skip(error.line)
