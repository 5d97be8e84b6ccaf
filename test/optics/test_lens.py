"""Lens YAML: what is written is read back, what is broken is refused with its reason."""

import copy

import numpy as np
import pytest
import yaml

from fisheye_svp_ros.errors import LensError, OutputError
from fisheye_svp_ros.io.lens_files import lens_from_dict, lens_to_dict, load_lens, save_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.optics.curves import (
    IMAGE_HEIGHTS,
    VIEWPOINT_SHIFTS,
    FlatPort,
    Gennery,
    KannalaBrandt,
)

DOCUMENT = {
    'name': 'trial',
    'image': {'width': 1280, 'height': 800},
    'projection': {
        'model': 'kannala_brandt',
        'fx': 453.1,
        'fy': 452.9,
        'cx': 640.2,
        'cy': 399.7,
        'k': [0.01, -0.02, 0.003, -0.0004],
    },
    'max_incidence_deg': 95.0,
    'viewpoint_shift': {'model': 'gennery', 's0': -0.001, 'e': [0.01, -0.003, 1e-05]},
    'corrections': {'skew': {'parameters': {'shear': 0.001}}},
    'target': {
        'landmarks': [[3, 0, 0.1, 0.2, 0.0], [4, 1, 0.2, 0.2, 0.0]],
        'landmark_scale': {
            'axes': 1,
            'centre': [0.0, 0.0, 0.0],
            'parameters': {'relative': 0.002},
        },
    },
    'calibration': {'rms_px': 0.2, 'observations': 100, 'frames': 5, 'source': 'train.csv'},
}


def changed(path, value):
    """DOCUMENT with the field at a dotted path replaced, or left out for None."""
    document = copy.deepcopy(DOCUMENT)
    *outer, last = path.split('.')
    section = document
    for name in outer:
        section = section[name]
    section[last] = value
    if value is None:
        del section[last]
    return document


@pytest.mark.parametrize('name', ['fish180', 'fish214'])
def test_config_lenses_survive_a_round_trip(name, tmp_path):
    lens = load_lens(lens_path(name))
    save_lens(lens, tmp_path / 'lens.yaml')
    assert load_lens(tmp_path / 'lens.yaml') == lens


def test_every_field_survives_a_round_trip(tmp_path):
    lens = lens_from_dict(DOCUMENT)
    save_lens(lens, tmp_path / 'lens.yaml')
    again = load_lens(tmp_path / 'lens.yaml')
    assert again == lens
    assert lens_to_dict(again) == DOCUMENT


@pytest.mark.parametrize('height', IMAGE_HEIGHTS)
@pytest.mark.parametrize('shift', [None, *VIEWPOINT_SHIFTS])
def test_every_curve_survives_a_round_trip(height, shift):
    document = changed('projection', {'model': height, 'f': 400.0, 'cx': 640.0, 'cy': 400.0})
    document['max_incidence_deg'] = 80.0
    document['viewpoint_shift'] = {
        None: None,
        'gennery': {'model': 'gennery', 's0': 0.001, 'e': [0.01, 0.0, 0.0]},
        'flat_port': {'model': 'flat_port', 'thickness': 0.01, 'refractive_index': 1.5},
    }[shift]
    lens = lens_from_dict(document)
    assert IMAGE_HEIGHTS.name_of(type(lens.image_height)) == height
    assert VIEWPOINT_SHIFTS.name_of(type(lens.viewpoint_shift)) == shift
    assert lens_from_dict(lens_to_dict(lens)) == lens


def test_what_may_be_left_out(tmp_path):
    path = tmp_path / 'wide.yaml'
    path.write_text(
        'image: {width: 640, height: 480}\n'
        'projection: {model: kannala_brandt, f: 3e2, cx: 319.5, cy: 239.5, k: [1e-2, -2E-3]}\n'
        'max_incidence_deg: 80\n'
    )
    lens = load_lens(path)
    assert (lens.name, lens.fx, lens.fy) == ('wide', 300.0, 300.0)
    assert lens.image_height == KannalaBrandt(0.01, -0.002)
    assert lens.viewpoint_shift is None
    assert (lens.corrections, lens.target, lens.calibration) == ({}, {}, None)


def test_parameters_by_name():
    lens = lens_from_dict(DOCUMENT)
    names = ['f', 'cx', 'k2', 's0', 'e1']
    moved = lens.with_parameters(names, [1.0, 2.0, 3.0, 4.0, 5.0])
    assert (moved.fx, moved.fy, moved.cx, moved.cy) == (1.0, 1.0, 2.0, lens.cy)
    assert moved.parameters == {
        **lens.parameters,
        'fx': 1.0,
        'fy': 1.0,
        'cx': 2.0,
        'k2': 3.0,
        's0': 4.0,
        'e1': 5.0,
    }
    assert moved.svp().viewpoint_shift is None
    assert moved.svp().corrections == lens.corrections
    with pytest.raises(LensError, match=r"no parameter 'k5'; it has fx, fy, .* e2"):
        lens.with_parameters(['k5'], [0.0])
    with pytest.raises(LensError, match="no parameter 's0'"):
        lens.svp().with_parameters(['s0'], [0.0])


def test_a_shift_of_several_kinds_is_a_list():
    document = changed(
        'viewpoint_shift',
        [
            {'model': 'gennery', 's0': 0.0, 'e': [0.01, 0.0, 0.0]},
            {'model': 'flat_port', 'thickness': 0.01, 'refractive_index': 1.5},
        ],
    )
    document['max_incidence_deg'] = 80.0
    lens = lens_from_dict(document)
    assert lens_to_dict(lens) == document
    theta = np.linspace(0.1, 1.4, 8)
    value, slope = lens.viewpoint_shift.value_and_slope(theta, np.tan(theta / 2))
    parts = [
        p.value_and_slope(theta, np.tan(theta / 2))
        for p in (Gennery(0, 0.01), FlatPort(0.01, 1.5))
    ]
    np.testing.assert_allclose([value, slope], np.sum(parts, axis=0), rtol=1e-14)
    moved = lens.with_parameters(['e0', 'thickness'], [0.02, 0.03])
    assert moved.viewpoint_shift.coefficients == (0.0, 0.02, 0.0, 0.0, 0.03, 1.5)
    double = lens.viewpoint_shift.scale_by(2.0)
    assert double.coefficients == (0.0, 0.02, 0.0, 0.0, 0.02, 1.5)
    columns = lens.viewpoint_shift.columns(theta)
    np.testing.assert_array_equal(columns[:, 4:], FlatPort(0.01, 1.5).columns(theta))
    assert lens.viewpoint_shift.limit == np.pi / 2
    two = FlatPort(0.01, 1.5).plus(FlatPort(0.02, 1.3))
    assert two.coefficient_names == (
        'thickness',
        'refractive_index',
        'thickness_2',
        'refractive_index_2',
    )
    assert two.plus(FlatPort(0.01, 1.3)).coefficients == (0.01, 1.5, 0.03, 1.3)
    assert Gennery(0.1).plus(two).parts == (Gennery(0.1), *two.parts)
    assert two.plus(two).coefficients == (0.02, 1.5, 0.04, 1.3)
    assert 'above 1' in two.with_values(refractive_index_2=0.9).check()


@pytest.mark.parametrize(
    ('model', 'degrees'),
    [
        ('orthographic', 90.0),
        ('equidistant', np.degrees(np.hypot(240.5, 320.5) / 150.0)),
        ('stereographic', np.degrees(2 * np.arctan(np.hypot(240.5, 320.5) / 300.0))),
    ],
)
def test_a_field_that_is_left_out_ends_at_the_curve_or_the_farthest_corner(model, degrees):
    lens = lens_from_dict(
        {
            'image': {'width': 640, 'height': 480},
            'projection': {'model': model, 'f': 150.0, 'cx': 319.0, 'cy': 239.0},
        }
    )
    assert np.degrees(lens.max_incidence) == pytest.approx(degrees, rel=1e-5)


@pytest.mark.parametrize(
    ('path', 'value', 'reason'),
    [
        ('image', None, 'image is missing; a mapping is needed'),
        ('image', 640, 'image is missing; a mapping is needed'),
        ('image.width', None, 'image: width is None; a number is needed'),
        ('image.width', '640', "image: width is '640'; a number is needed"),
        ('image.width', 640.5, 'image: width is 640.5; a whole number of pixels is needed'),
        ('image.width', float('nan'), 'image: width is nan; a finite number is needed'),
        ('image.height', 0, 'height is 0; it must be above 0'),
        ('projection', None, 'projection is missing; a mapping is needed'),
        (
            'projection.model',
            None,
            'projection.model is None; choose from orthographic, equidistant',
        ),
        ('projection.model', 'pinhole', "projection.model is 'pinhole'; choose from"),
        ('projection.model', ['x'], r"projection.model is \['x'\]; choose from"),
        ('projection.fx', None, 'projection: fx is None; a number is needed'),
        ('projection.fx', True, 'projection: fx is True; a number is needed'),
        ('projection.fx', -1.0, 'fx is -1.0; it must be above 0'),
        ('projection.fx', 1e-300, 'fx is 1e-300 px; at least 0.001 px is needed'),
        ('projection.fy', float('inf'), 'fy is inf; a finite number is needed'),
        ('projection.cx', float('nan'), 'cx is nan; a finite number is needed'),
        ('projection.f', 400.0, 'projection has both f and fx or fy; keep one of them'),
        ('projection.k', 0.1, 'projection.k must be a list of numbers, is 0.1'),
        ('projection.k', ['a'], "projection.k: value is 'a'; a number is needed"),
        ('projection.k', [0.0] * 5, 'projection.k has 5 values; this model takes 4'),
        ('projection.k', [float('nan')], 'value is nan; a finite number is needed'),
        ('projection.k', [-0.3], r'max_incidence_deg is 95; these curves allow .* up to 60\.39'),
        ('projection.p1', 0.1, "projection: unknown field 'p1'; choose from"),
        ('max_incidence_deg', 'wide', "max_incidence_deg is 'wide'; a number is needed"),
        ('max_incidence_deg', 0, 'max_incidence_deg is 0; these curves allow a value above 0'),
        ('max_incidence_deg', 190, 'max_incidence_deg is 190; these curves allow'),
        ('max_incidence_deg', float('nan'), 'max_incidence_deg is nan; a finite number is needed'),
        ('viewpoint_shift', 0.001, 'viewpoint_shift must be a mapping with a model'),
        (
            'viewpoint_shift.model',
            'cahvore',
            "viewpoint_shift.model is 'cahvore'; choose from gennery",
        ),
        ('viewpoint_shift.s0', 'x', "viewpoint_shift: s0 is 'x'; a number is needed"),
        ('viewpoint_shift.e', [0.0] * 4, 'viewpoint_shift.e has 4 values; this model takes 3'),
        (
            'viewpoint_shift',
            {'model': 'flat_port', 'thickness': 0.01},
            'viewpoint_shift: incomplete; add refractive_index$',
        ),
        (
            'viewpoint_shift',
            {'model': 'flat_port', 'thickness': 0.01, 'refractive_index': 1.0},
            'refractive_index is 1.0; it must be above 1',
        ),
        (
            'viewpoint_shift',
            {'model': 'flat_port', 'thickness': 0.01, 'refractive_index': 1.5},
            'max_incidence_deg is 95; these curves allow .* up to 90',
        ),
        ('viewpoint_shift', [{'model': 'gennery'}, 1], 'viewpoint_shift must be a mapping with a'),
        ('viewpoint_shift', [], 'viewpoint_shift must be a mapping with a model'),
        ('corrections', [1], 'corrections must map each effect name to its parameters'),
        ('corrections.skew', 0.001, r'corrections\.skew: corrections must map .*p1: 0\.001'),
        ('corrections.skew', {'parameters': {}}, 'effect skew is incomplete'),
        ('corrections.bend', {}, "effect 'bend' is unknown; choose from"),
        ('effects', {'skew': 1}, 'effects must map each effect name to its parameters'),
        ('target.landmark_scale', 2, 'target must map each effect name to its parameters'),
        ('target.landmark_scale', {}, 'target: effect landmark_scale is incomplete'),
        (
            'target.landmarks',
            [[1, 2, 3]],
            'target.landmarks must be a list of .landmark, board, x, y',
        ),
        ('calibration', [1], r'calibration must be a mapping, is \[1\]'),
        (
            'distortion',
            {},
            "unknown field 'distortion'; choose from calibration, corrections, image",
        ),
    ],
)
def test_broken_lens_is_refused_with_its_reason(path, value, reason, tmp_path):
    file = tmp_path / 'broken.yaml'
    file.write_text(yaml.safe_dump(changed(path, value)))
    with pytest.raises(LensError, match=reason) as caught:
        load_lens(file)
    assert str(caught.value).startswith(str(file))
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize(
    ('content', 'reason'),
    [
        (b'', 'not a lens file: it has no projection'),
        (b'- 1\n', 'not a lens file: it has no projection'),
        (b'image: {width: 1\n', 'broken YAML at line 2: '),
        (b'\xff\xfe\x00', 'not a text file; one in UTF-8 is expected'),
    ],
)
def test_broken_file_is_refused_with_its_reason(content, reason, tmp_path):
    file = tmp_path / 'broken.yaml'
    file.write_bytes(content)
    with pytest.raises(LensError, match=reason) as caught:
        load_lens(file)
    assert str(caught.value).startswith(str(file))


def test_missing_file_and_unwritable_place(tmp_path):
    with pytest.raises(LensError, match=r'absent\.yaml: cannot be read .*; check the path'):
        load_lens(tmp_path / 'absent.yaml')
    with pytest.raises(LensError, match='a folder without lenses; those of a rig are'):
        load_lens(tmp_path)
    (tmp_path / 'file').write_text('')
    with pytest.raises(OutputError, match='cannot be written'):
        save_lens(lens_from_dict(DOCUMENT), tmp_path / 'file' / 'lens.yaml')
    assert [p.name for p in tmp_path.iterdir()] == ['file']


@pytest.mark.parametrize('name', IMAGE_HEIGHTS)
def test_image_height_curves_invert_and_differentiate(name):
    kind = IMAGE_HEIGHTS[name]
    curve = kind(-0.01, 0.004, 0.0, -0.0001) if name == 'kannala_brandt' else kind()
    theta = np.linspace(0.0, 0.97 * curve.limit, 300)
    height, slope = curve.value_and_slope(theta)
    np.testing.assert_allclose(curve.angle(height), theta, rtol=0, atol=1e-13)
    step = 1e-5
    low, high = (curve.value_and_slope(theta + d)[0] for d in (-step, step))
    np.testing.assert_allclose((high - low) / (2 * step), slope, rtol=1e-6)
    assert np.all(slope > 0)


def test_kannala_brandt_ends_where_its_height_stops_growing():
    curve = KannalaBrandt(-0.3)
    assert curve.limit == pytest.approx(np.sqrt(1 / 0.9), abs=1e-12)
    assert KannalaBrandt(0.1).limit == np.pi
    edge, slope = curve.value_and_slope(np.array(curve.limit))
    assert slope == pytest.approx(0.0, abs=1e-12)
    assert curve.angle(edge) == pytest.approx(curve.limit, abs=1e-6)


def test_a_coefficient_next_to_nothing_changes_no_limit():
    assert KannalaBrandt(-0.1, 0.0, 0.0, 1e-320).limit == KannalaBrandt(-0.1).limit
    assert KannalaBrandt(-0.1, 0.0, 0.0, 5e-324).limit == KannalaBrandt(-0.1).limit


def test_a_lens_prints_on_one_line_whatever_its_file_holds():
    calibration = {'stderr': {'fx': 0.1}, 'covariance': np.eye(40).tolist()}
    lens = lens_from_dict({**copy.deepcopy(DOCUMENT), 'calibration': calibration})
    assert len(repr(lens)) < 500 and 'covariance' not in repr(lens)
