"""The offline optimization: constraints, program, multi-start, certificate, result."""
