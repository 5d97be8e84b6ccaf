"""Kita's evaluation of the SVP approximation, from its numbers to its report."""
