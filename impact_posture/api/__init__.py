"""The objective, the problem and the result behind ``import impact_posture as ip``."""
