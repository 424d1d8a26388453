"""Export of a complete controller as C code (``codegen --controller``)."""
