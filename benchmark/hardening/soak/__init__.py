"""Hostile messages by the million over DDS against running nodes: `make hardening NAME=soak`."""
