"""What this project costs and what it is worth, measured: see docs/reference/bench.md."""
