"""One impact in MuJoCo, measured, beside what the objectives predict of it."""
