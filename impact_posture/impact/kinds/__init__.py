"""The objective types: one class for each value of ``--objective``."""
