"""Hostile input, killed commands, small faults, frozen answers."""
