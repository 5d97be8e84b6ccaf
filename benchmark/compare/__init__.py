"""Held-out corners of real cameras through other calibrations, beside ours."""
