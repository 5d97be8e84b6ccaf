"""Optional checks: each a function of a stage, asked where the data allow it."""
