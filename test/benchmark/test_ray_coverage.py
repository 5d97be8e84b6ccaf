"""True ray errors against stated ones: one trial, and what the page counts."""

import numpy as np

from benchmark.studies.ray_coverage import Outcome, report, trial


def test_the_extended_lens_of_a_trial_is_nearer_to_the_truth() -> None:
    one = trial(0)
    assert not one.few and not one.warped and one.offered
    assert (one.true[1] < one.true[0]).all()
    assert not one.outside[1].any()
    assert (one.true[0] < one.plain).all() and one.ratios[2] < 0.9 < one.ratios[0]


def test_six_frames_have_no_focal_lengths_of_their_own() -> None:
    """Stated were 5 to 17 mrad of both lenses, 10 to 36 times the true errors of the second."""
    one = trial(3)
    assert one.few and one.warped and one.offered
    assert (one.value < 2 * one.true).all() and not one.outside[0].any()


def test_the_page_counts_what_is_outside_and_what_is_worse() -> None:
    size = np.full((2, 3), 0.2)
    better = Outcome(
        True,
        False,
        True,
        np.array([[0.4] * 3, [0.05] * 3]),
        size,
        0.5 * size,
        1.5 * size,
        np.full(3, 0.8),
        np.array([1.0, 0.5, 0.4]),
    )
    worse = better._replace(true=np.array([[0.2] * 3, [0.3] * 3]), offered=False)
    lines = report([better, worse], 'command').splitlines()
    row = next(line for line in lines if line.startswith('| 5 to 8 frames |'))
    assert row == (
        '| 5 to 8 frames | 2 | 0 % | 50 % | 50 % | 1.41 | 50 % | 50 % | 0 % | 0.61 | 0.35 | 0.15 |'
    )
    assert 'of all: 1 of 2.' in '\n'.join(lines)
    assert 'of those offered: 0 of 1.' in '\n'.join(lines)
    missed = better._replace(offered=False)
    page = report([better, missed, worse], 'command')
    assert 'Not offered, of those at least twice as good: 1 of 2.' in page
    assert '| landmarks off | 5 to 8 | 2 | 0.50 | 0.50 to 0.50 |' in lines
