"""The comparisons of rigs and robots: what a trial draws, and a page of few trials."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmark.peers import hand_eye, rigs


def test_a_robot_states_its_flange_with_scale_and_noise() -> None:
    case = hand_eye.draw_case(3, hidden=False, bent=False)
    assert len(case.poses) == 20 and 1e-4 <= case.noise[0] <= 4e-4
    assert 0 < abs(case.truth.scale - 1) < 3e-3


def test_rigs_are_calibrated_within_stated_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cv2 = pytest.importorskip('cv2')
    if not hasattr(cv2, 'calibrateMultiview'):
        pytest.skip('this OpenCV has no calibrateMultiview; version 5 has')
    monkeypatch.setattr(rigs, '_PEERS', tmp_path / 'none')
    found = rigs.run_trial(1)
    assert np.abs(found.z).max() < 4 and found.errors['ours'][0] < 2e-3
    assert found.errors['OpenCV'][0] < 5e-3
    moving = rigs.run_moving(1)
    assert np.abs(moving).max() < 4
    rigs.write_results([found], [moving], tmp_path / 'rigs.md')
    page = (tmp_path / 'rigs.md').read_text()
    assert '1 trials' in page and 'multical, pycolmap: not installed' in page
