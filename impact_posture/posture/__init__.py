"""The offline optimization: constraints, programme, multi-start, certificate, result."""
