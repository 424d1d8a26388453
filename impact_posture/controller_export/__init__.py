"""Export of a whole controller as C code (``codegen --controller``)."""
