"""From settings and requirements to a constrained problem."""
