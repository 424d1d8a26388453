"""Classes of objectives, problems and results, which ``import impact_posture as ip`` provides."""
