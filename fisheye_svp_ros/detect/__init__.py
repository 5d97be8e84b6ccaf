"""Photographs to observations: sources, detectors, the order of corners, their uncertainty."""
