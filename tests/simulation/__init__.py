"""Controllers, runs and metrics of the experiments."""
