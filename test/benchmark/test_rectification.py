"""The comparison of rectified pairs: rows and depths near the lens."""

from __future__ import annotations

from benchmark.peers.rectification import errors, opencv, ours, scene


def test_near_the_lens_our_rows_and_depths_are_the_better_ones() -> None:
    seen = scene(0.3)
    row, depth = errors(ours(0.3), *seen)
    other_row, other_depth = errors(opencv(0.3), *seen)
    assert row < 0.06 and depth < 1e-4
    assert other_row > 5 * row and other_depth > 5 * depth
