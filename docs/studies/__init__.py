"""Benchmarks and studies, which docs/reference/bench.md lists."""
