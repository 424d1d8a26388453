"""Benchmarks and studies; docs/reference/bench.md lists them."""
