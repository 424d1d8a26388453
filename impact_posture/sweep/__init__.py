"""Many posture problems at once, on whatever runs them; their results as one table in Parquet files."""

from impact_posture.sweep.atlas import open_atlas as open

__all__ = ["open"]
