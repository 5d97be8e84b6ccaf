"""Metrics, sweeps and error budgets: numbers only."""
