"""The image field that is written: found where there is a warp, none where there is none."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from helpers.water import AIR, photographs

from fisheye_svp_ros.diagnosis import Diagnosis, diagnose
from fisheye_svp_ros.diagnosis.written_lens import MIN_GAIN
from fisheye_svp_ros.effects.forward import back_project_corrected, project_corrected
from fisheye_svp_ros.io.lens_files import load_lens, save_lens
from fisheye_svp_ros.reporting.diagnosis_document import diagnosis_document
from fisheye_svp_ros.reporting.wording.diagnosis import verdict_sentences


def warp(uv: np.ndarray, size: float, length: float = 380.0) -> np.ndarray:
    """Return waves of so many px, no spline, of a length in px."""
    x, y = np.moveaxis(2 * np.pi * uv / length, -1, 0)
    return size * np.stack([np.sin(x + 0.4 * y), np.cos(y - 0.3 * x + 1)], axis=-1)


@cache
def diagnosed(size: float, seed: int, length: float = 380.0) -> Diagnosis:
    """Diagnose sixteen photographs with noise of .1 px and a warp."""
    seen = photographs(AIR, None, 16, 0.1, seed)
    moved = replace(seen, uv=seen.uv + warp(seen.uv, size, length))
    return diagnose(moved, AIR, free_intrinsics=True)


@pytest.mark.parametrize(('seed', 'length'), [(0, 380.0), (1, 900.0)])
def test_a_warp_is_written_and_brings_the_rays_nearer_to_the_truth(
    seed: int, length: float, tmp_path: Path
) -> None:
    found = diagnosed(0.3, seed, length)
    field = found.evaluation.written_field
    assert field is not None and field.after < (1 - MIN_GAIN) * field.before
    save_lens(found.lens, tmp_path / 'lens.yaml')
    written = load_lens(tmp_path / 'lens.yaml')
    assert written == found.lens
    assert written.image_field is not None and written.image_field.stderr is not None
    assert 0 < np.median(written.image_field.stderr) < 0.3
    views = found.evaluation.fixed_model.data.views
    uv = views.uv[views.used]
    far = true_directions(uv, length)
    off = [errors_px(lens, far, uv) for lens in (replace(written, image_field=None), written)]
    assert off[1] < 0.75 * off[0]
    entry = diagnosis_document(found)['lens']['image_field']
    assert entry['written']
    assert entry['refuted_by_frames'] == []
    assert entry['rms_px'] == pytest.approx(written.image_field.rms)
    # The field's own errors are among those of the rays, which are nearer than those of `given`.
    stated, given = (
        diagnosis_document(found)['lens']['ray_error_mrad'][which][-1]
        for which in ('extended', 'given')
    )
    truth = 1e3 * off[1] / AIR.fx
    assert 0.5 * stated['low'] < truth < 1.5 * stated['high']
    assert stated['value'] < given['value']
    assert 'image field' in verdict_sentences(found)[1]


@pytest.mark.parametrize(('seed', 'length'), [(0, 380.0), (1, 900.0)])
def test_a_field_that_is_written_counts_for_the_lens_that_has_it(seed: int, length: float) -> None:
    """The lens as given was lent the field: no gain, however large the warp."""
    found = diagnosed(0.3, seed, length)
    field = found.evaluation.written_field
    assert field is not None and field.fields
    assert found.file.low > 0 and found.offers_extended
    # The lens as given took up some of the warp.
    assert found.file.extended_px < 0.9 * found.file.given_px < field.before


def true_directions(uv: np.ndarray, length: float) -> np.ndarray:
    """Return directions that the true, warped lens sees at image points."""
    ideal = uv
    for _ in range(30):
        ideal = uv - warp(ideal, 0.3, length)
    return back_project_corrected(AIR, ideal).direction


def errors_px(lens: object, directions: np.ndarray, uv: np.ndarray) -> float:
    """Return the rms, px, of image points of far points, a turn of the camera taken out."""
    off = project_corrected(lens, 1e3 * directions).uv - uv
    turns = np.stack(
        [
            project_corrected(lens, 1e3 * (directions + 1e-6 * np.cross(axis, directions))).uv
            - project_corrected(lens, 1e3 * directions).uv
            for axis in np.eye(3)
        ],
        axis=-1,
    )
    columns = turns.reshape(-1, 3) / 1e-6
    rest = off.ravel() - columns @ np.linalg.lstsq(columns, off.ravel(), rcond=None)[0]
    return float(np.sqrt(2 * (rest**2).mean()))


@pytest.mark.parametrize('seed', [0, 1])
def test_none_is_written_for_a_clean_set(seed: int) -> None:
    found = diagnosed(0.0, seed)
    assert found.lens.image_field is None
    entry = diagnosis_document(found)['lens'].get('image_field')
    assert entry is None or not entry['written']
