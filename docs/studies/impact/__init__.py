"""Study of single impacts: measurement in MuJoCo, and prediction by the objectives."""
