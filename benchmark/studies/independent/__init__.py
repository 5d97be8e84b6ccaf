"""Blind data for the diagnosis, made from the text of the design alone.

Nothing here imports the package: what it computes is checked against other formulations.
"""
