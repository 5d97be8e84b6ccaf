"""`make bench`: speed beside other tools, written to docs/results/benchmarks.md."""
