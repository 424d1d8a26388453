"""Study that varies the shipped experiments, to measure in which situations each controller helps."""
