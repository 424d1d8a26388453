"""Random variations of the shipped experiments, which show where each controller helps."""
