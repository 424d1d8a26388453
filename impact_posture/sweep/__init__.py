"""Solve many posture problems on any executor, and store the results as one table of Parquet files."""

from impact_posture.sweep.atlas import open_atlas as open

__all__ = ["open"]
