"""The sources of DAQP for tests, which use no network."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from impact_posture.controller_export.daqp_sources import VERSION, daqp_sources
from impact_posture.libraries import cache_path


def sources_or_skip() -> dict[str, bytes]:
    """Return the sources of the folder ``$DAQP_SOURCES`` or of the cache; skip the test where there are none."""
    folder = os.environ.get("DAQP_SOURCES")
    if folder:
        return daqp_sources(Path(folder))
    if (cache_path() / f"daqp-{VERSION}.tar.gz").is_file():
        return daqp_sources()
    return pytest.skip(f"no sources of DAQP {VERSION} in the cache; DAQP_SOURCES names a folder that has them")
