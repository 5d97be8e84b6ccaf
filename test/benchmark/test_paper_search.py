"""The inverse problem: fits of the paper's tables 1 and 2."""

import numpy as np
import pytest
import yaml

from benchmark.studies.paper.search import recover
from benchmark.studies.paper.stopping import excess_of_published, stopped_early
from benchmark.studies.paper.writing import (
    best_of,
    family_document,
    layout_document,
    lens_document,
    whole_directions,
)
from fisheye_svp_ros.io import landmark_files
from fisheye_svp_ros.io.lens_files import lens_from_dict, load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.paper.lens_evaluation import localize_spreads
from fisheye_svp_ros.paper.studies import load_family, load_stopping, shift_curves
from fisheye_svp_ros.paper.tables import (
    CALIBRATION,
    LENSES,
    LOCALIZATION,
    agreeing,
)

# One process makes both fits.
pytestmark = pytest.mark.xdist_group('paper search')
LENS_PAIR = tuple(load_lens(lens_path(name)) for name in LENSES)


@pytest.fixture(scope='module')
def found():
    """Return one start after one iteration and after a few."""
    return [recover(LENS_PAIR, 9, iterations) for iterations in (1, 7)]


def test_a_fit_falls(found):
    first, later = found
    assert later.cost < 0.2 * first.cost
    assert later.misfit <= later.cost
    assert later.lens_numbers[0, 0] <= 320 + 1e-9
    assert later.lens_numbers[1, 0] <= 411 + 1e-9
    assert later.tables.shape == LOCALIZATION.shape


def test_a_fit_is_deterministic(found):
    again = recover(LENS_PAIR, 9, 1)
    np.testing.assert_array_equal(again.layout, found[0].layout)
    np.testing.assert_array_equal(again.lens_numbers, found[0].lens_numbers)


def test_what_is_written_is_what_was_found(found, tmp_path, monkeypatch):
    best = best_of(found)
    assert best is found[1]
    for lens, numbers in zip(LENS_PAIR, best.lens_numbers, strict=True):
        document = yaml.safe_load(yaml.safe_dump(lens_document(lens, best, 32)))
        read = lens_from_dict(document)
        assert 'benchmark.studies.paper search' in document['provenance']
        assert read.fx == pytest.approx(numbers[0], abs=0.006)
        np.testing.assert_allclose(read.viewpoint_shift.coefficients, numbers[1:], atol=1e-7)
        assert (read.name, read.width, read.max_incidence) == (
            lens.name,
            lens.width,
            lens.max_incidence,
        )
    layout = tmp_path / 'layout.yaml'
    layout.write_text(yaml.safe_dump(layout_document(best, 32)), encoding='utf-8')
    monkeypatch.setattr(landmark_files, 'config_path', lambda _: layout)
    written = landmark_files.environment('whole', 1.0).points
    np.testing.assert_allclose(written, whole_directions(best), atol=1e-12)


def test_the_family_comes_back(found, tmp_path):
    path = tmp_path / 'family.yaml'
    ranges = dict.fromkeys(LENSES, (CALIBRATION[0], CALIBRATION[0] + 1))
    path.write_text(yaml.safe_dump(family_document(found, ranges)), encoding='utf-8')
    family = load_family(path)
    np.testing.assert_allclose(family.low[1], CALIBRATION[0], atol=1e-5)
    np.testing.assert_allclose(family.high - family.low, 1, atol=1e-5)
    for member, one in zip(family.members, found, strict=True):
        assert member.within_10 == agreeing(one.tables, 0.10)
        np.testing.assert_allclose(member.layout, one.layout, atol=1e-4)
    curves = shift_curves(family.members, 'fish214', np.array([0.0, 1.0]))
    np.testing.assert_allclose(curves[:, 0], [one.lens_numbers[1, 1] for one in found], atol=1e-7)


def test_the_study_of_early_stops_is_that_of_the_lens_in_use():
    lens = LENS_PAIR[0]
    localized = localize_spreads(lens)
    kept = load_stopping()
    excess = excess_of_published(localized[0], lens)
    np.testing.assert_allclose(kept.offset_mm, excess.offset_mm, atol=1e-9)
    assert kept.relative_cost == pytest.approx(excess.relative_cost, rel=1e-6)
    np.testing.assert_allclose(kept.off[0], stopped_early(localized, lens), rtol=1e-6, atol=1e-9)


def test_agreeing_counts_z_and_residuals_only():
    tables = LOCALIZATION.copy()
    assert agreeing(tables, 0.0) == 36
    tables[..., [0, 1, 3]] = 0.0
    tables[1, 2, 1, 2] *= 1.07
    assert agreeing(tables, 0.05) == 35
    assert agreeing(tables, 0.10) == 36
