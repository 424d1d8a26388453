"""Run scenarios and write their results: single runs, comparisons, and the tables and figures of the paper."""
