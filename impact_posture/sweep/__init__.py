"""Sweeps of many posture problems on any executor, with one table of results in Parquet files."""

from impact_posture.sweep.atlas import open_atlas as open

__all__ = ["open"]
