"""The nonlinear program, its solver and its certificate."""
