"""Scenarios and the observations that a camera would make of them."""
