"""Solvers: poses, rigs, depths and lenses from image points."""
