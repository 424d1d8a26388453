"""Export of ``H``, its gradient and the objective as C code, and a loader for the compiled code."""
