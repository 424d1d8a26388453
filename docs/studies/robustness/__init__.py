"""Study of random variations of the shipped experiments, which shows where each controller helps."""
