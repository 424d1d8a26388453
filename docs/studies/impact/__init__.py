"""One impact in MuJoCo, measured and predicted by the objectives."""
