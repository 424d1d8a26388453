"""The kinds of objective: impulse, speed, sticking, coulomb and energy."""
