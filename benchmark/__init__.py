"""Benchmarks of the package; not installed with it."""
