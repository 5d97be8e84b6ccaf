"""`make bench`: speed beside what a user would pick instead, written to docs/benchmarks.md."""
