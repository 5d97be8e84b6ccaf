"""What random parts may be mistaken for: each hides its named counterparts alone."""

from functools import cache

import numpy as np
import pytest
from helpers.sagging import FREE, photographs
from helpers.water import AIR

from fisheye_svp_ros.diagnosis import NullModel
from fisheye_svp_ros.diagnosis.random_effects import NAMES, make_random_effects
from fisheye_svp_ros.mixed_model import (
    LAMBDA_ABSENT,
    eliminate,
    factor_equations,
    initial_variances,
)
from fisheye_svp_ros.solve.bundle_adjustment import adjust
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.rig_state import group_by_frame

# Effects whose constant a part holds by itself: of a part as large as the noise, in every frame.
COUNTERPARTS = {
    'image_broad': {'skew'},
    'image_coarse': {'skew'},
    'image_fine': {'radial_profile'},
    'landmark_in_plane': {'landmark_scale'},
    'landmark_normal': {'target_shape'},
    'board_stretch': {'landmark_scale'},
    'frame_linear': {'skew', 'landmark_scale'},
    'frame_bend': {'target_shape'},
    'frame_motion': {'skew', 'landmark_scale'},  # turns shear and stretch the image
}
LEFT = 0.14  # of the information: less is another name for the same


@cache
def board_model():
    data = group_by_frame(photographs(3, 0.0))
    return NullModel.estimate(data, adjust(data, initial_state(data, AIR), FREE), FREE)


def information(parts, size):
    """Return what is known of all that could be added, beside parts of so many noise variances."""
    null = board_model()
    active = np.isin(NAMES, parts)
    known = initial_variances(null.full, size)
    lam = np.where(active, known.lam, LAMBDA_ABSENT)
    solved = factor_equations(null.full.select(active), lam, known.weight)
    return eliminate(solved.information, null.included_columns)


def kept_shares(part, size):
    """Return which share of the information of each effect is left, of its weakest direction."""
    null, shares = board_model(), {}
    alone, beside = information([], 1.0), information([part], size)
    for form, effect in enumerate(null.fixed.forms.effects):
        at = null.form_columns(form)
        sizes, vectors = np.linalg.eigh(alone[np.ix_(at, at)])
        known = sizes > max(1e-6 * sizes[-1], 1e-9)
        root = vectors[:, known] / np.sqrt(sizes[known])
        if known.any():
            left = np.linalg.eigvalsh(root.T @ beside[np.ix_(at, at)] @ root).min()
            shares[effect.name] = min(float(left), shares.get(effect.name, 1.0))
    return shares


def present():
    label = make_random_effects(board_model().linear).columns
    labels = label.group_label, label.unit_label.ravel(), label.shared_label
    return {NAMES[i] for i in np.unique(np.concatenate(labels)) if i >= 0}


@pytest.mark.parametrize('part', NAMES)
def test_a_random_part_hides_its_counterparts_alone(part):
    if part not in present():
        pytest.skip('one board, coarse points: the part is absent')
    hidden = {name for name, share in kept_shares(part, 1.0).items() if share < LEFT}
    assert hidden == COUNTERPARTS.get(part, set())


def test_a_sag_of_any_size_leaves_the_bend_that_stays():
    assert kept_shares('frame_sag', 1e6)['target_shape'] > 0.4
