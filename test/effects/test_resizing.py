"""The lens of an image that is cut and scaled projects where the pixels went."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.lenses import FRONT, LENSES, points_on_rays
from helpers.uncertain import BOARD, uncertain

import fisheye_svp_ros as fsvp
from fisheye_svp_ros import cli
from fisheye_svp_ros.diagnosis import LensErrors
from fisheye_svp_ros.effects.forward import back_project_corrected, project_corrected
from fisheye_svp_ros.effects.resizing import ImageChange, transform_lens
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.lens_files import lens_from_dict, lens_to_dict, load_lens, save_lens
from fisheye_svp_ros.io.lens_formats import WRITABLE
from fisheye_svp_ros.library.lenses import change_image
from fisheye_svp_ros.optics.image_field import ImageField
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.optics.ports import FlatGlass
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import views_of

CORRECTIONS = {
    'decentering': {'parameters': {'p1': 0.002, 'p2': -0.001}},
    'sensor_tilt': {'parameters': {'about_x': 0.01, 'about_y': -0.004}},
    'skew': {'parameters': {'shear': 0.003}},
    'radial_profile': {'terms': 2, 'theta_max': 1.7, 'parameters': {'h1': 3.0, 'h2': -1.0}},
    'pupil_decentering': {'parameters': {'e0_x': 0.001, 'e0_y': 0.0}},
}
_NODES = np.random.default_rng(3).normal(0, 2, (5, 6, 2))
FIELD = ImageField(np.array([-50.0, -20.0]), np.array([260.0, 250.0]), _NODES, np.ones((5, 6)))
EVERY = [
    *LENSES,
    pytest.param(
        lens_from_dict({**lens_to_dict(FRONT), 'corrections': CORRECTIONS}), id='corrections'
    ),
    pytest.param(replace(FRONT, image_field=FIELD), id='image_field'),
    pytest.param(replace(FRONT, port=FlatGlass(0.02, 1.333), max_incidence=1.2), id='port'),
]
CHANGES = [
    {'scale': 0.5},
    {'crop': (40, 30, 600, 500)},
    {'crop': (41, 31, 600, 500), 'scale': 1.5},
    {'crop': (0, 100, 800, 600), 'size': (500, 391)},
]


def change_of(lens: Lens, **given: object) -> ImageChange:
    return ImageChange.of((lens.width, lens.height), **given)


@pytest.mark.parametrize('given', CHANGES, ids=str)
@pytest.mark.parametrize('lens', EVERY)
def test_points_go_where_pixels_go(lens: Lens, given: dict) -> None:
    change = change_of(lens, **given)
    resized, lost = transform_lens(lens, change)
    assert not lost and (resized.width, resized.height) == change.size
    points = points_on_rays(
        replace(lens, corrections={}, port=None), np.random.default_rng(1), 200, 0.5, 3.0, 0.8
    )
    old, new = project_corrected(lens, points), project_corrected(resized, points)
    both = old.valid & new.valid
    assert both.sum() > 50
    np.testing.assert_allclose(new.uv[both], change.apply(old.uv[both]), rtol=0, atol=1e-8)
    inside = ((new.uv >= 0) & (new.uv <= np.array(change.size) - 1)).all(axis=1)
    rays = [
        back_project_corrected(*pair)
        for pair in ((resized, new.uv[inside]), (lens, old.uv[inside]))
    ]
    np.testing.assert_allclose(rays[0].direction, rays[1].direction, atol=1e-9)


def test_pixel_centers_are_as_averaging_pixels_has_them() -> None:
    """A spot in an image, and where it is once OpenCV has resized that."""
    spot = np.array([231.3, 118.8])
    v, u = np.mgrid[:320, :480]
    image = np.exp(-((u - spot[0]) ** 2 + (v - spot[1]) ** 2) / 200.0)
    small = cv2.resize(image[10:310, 30:450], (140, 100), interpolation=cv2.INTER_AREA)
    y, x = np.mgrid[:100, :140]
    found = np.array([(x * small).sum(), (y * small).sum()]) / small.sum()
    change = ImageChange.of((480, 320), (30, 10, 420, 300), 1 / 3)
    assert change.size == (140, 100)
    np.testing.assert_allclose(change.apply(spot), found, atol=1e-3)


def test_principal_point_of_half_the_size() -> None:
    lens = fsvp.resize_lens(FRONT, scale=0.5)
    assert lens.cx == pytest.approx((FRONT.cx + 0.5) / 2 - 0.5)
    assert (lens.fx, lens.fy) == (FRONT.fx / 2, FRONT.fy / 2)


def test_the_rows_of_a_part_are_read_in_less_time() -> None:
    lens = replace(FRONT, corrections={'rolling_shutter': {'parameters': {'readout': 0.02}}})
    half, _ = transform_lens(lens, change_of(lens, scale=0.5))
    part, _ = transform_lens(lens, change_of(lens, crop=(0, 200, 848, 400), scale=0.5))
    for one, readout in ((half, 0.02), (part, 0.01)):
        assert one.corrections['rolling_shutter']['parameters']['readout'] == readout


def test_what_belongs_to_the_pixels_is_lost_and_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = {'detector_bias': {'order': 1, 'parameters': {'sine': 0.05}}}
    save_lens(replace(FRONT, corrections=own), tmp_path / 'lens.yaml')
    out = ['-o', str(tmp_path / 'out.yaml')]
    assert cli.main(['lens', str(tmp_path / 'lens.yaml'), '--crop', '8,0,400,400', *out]) == 0
    assert load_lens(tmp_path / 'out.yaml').corrections == own
    assert capsys.readouterr().err == ''
    assert cli.main(['lens', str(tmp_path / 'lens.yaml'), '--scale', '1/2', *out]) == 0
    assert load_lens(tmp_path / 'out.yaml').corrections == {}
    assert (
        'left out, because the pixels have another size: detector_bias' in capsys.readouterr().err
    )


def test_errors_of_a_calibration_are_those_of_the_new_pixels() -> None:
    names = ['fx', 'cy', 'k1']
    block = {
        'rms_px': 0.4,
        'frames': 10,
        'stderr': dict(zip(names, [1.0, 0.5, 0.01], strict=True)),
        'covariance': [[1.0, 0.1, 0.002], [0.1, 0.25, 0.0], [0.002, 0.0, 1e-4]],
    }
    lens = fsvp.resize_lens(replace(FRONT, calibration=block), scale=0.5)
    found = lens.calibration
    assert found['rms_px'] == 0.2 and found['frames'] == 10
    assert [*found['stderr'].values()] == pytest.approx([0.5, 0.25, 0.01])
    np.testing.assert_allclose(
        found['covariance'], [[0.25, 0.025, 0.001], [0.025, 0.0625, 0.0], [0.001, 0.0, 1e-4]]
    )


def test_poses_are_as_sure_by_the_lens_of_a_smaller_image() -> None:
    """All that the file says of its errors follows: covariances of poses are the same."""
    lens = uncertain()
    change = change_of(lens, crop=(20, 0, 960, 800), scale=0.5)
    small, lost = change_image(lens, change)
    assert not lost
    pose = Pose(rotation_from_vector(np.array([[0.1, 0.2, 0.0]])), np.array([[0.1, 0.05, -0.3]]))
    points = pose.into_body(BOARD[None])
    covariances = []
    for one, sigma in ((lens, 0.2), (small, 0.1)):
        uv = project_corrected(one, points).uv
        views = views_of(BOARD[None], uv)._replace(weight=np.full(uv.shape[:2], 1 / sigma))
        covariances.append(LensErrors.from_lens(one).of_poses(views, pose).total)
    np.testing.assert_allclose(covariances[1], covariances[0], rtol=1e-6, atol=1e-18)
    _, lost = change_image(lens, change_of(lens, size=(500, 300)))
    assert lost == ('uncertainty',)


@pytest.mark.parametrize('form', ['', *WRITABLE])
def test_the_command_writes_every_format(
    form: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_lens(FRONT, tmp_path / 'lens.yaml')
    out = tmp_path / 'out'
    options = ['--format', form] if form else []
    assert cli.main(
        ['lens', str(tmp_path / 'lens.yaml'), '--crop', '40,20,800,760', '--scale', '0.5',
         '-o', str(out), *options]
    ) == 0  # fmt: skip
    lens = load_lens(out)
    assert (lens.width, lens.height) == (400, 380)
    points = points_on_rays(FRONT, np.random.default_rng(2), 50, edge=0.6)
    right = (project_corrected(FRONT, points).uv + 0.5 - (40, 20)) / 2 - 0.5
    assert np.abs(project_corrected(lens, points).uv - right).max() < 0.01
    assert '400x380 px' in capsys.readouterr().out


@pytest.mark.parametrize(
    ('options', 'said'),
    [
        (['--scale', '1/3'], '848x800 px times 0.333333 is not a whole number .*example 283x267'),
        (['--scale', '0'], "'0' is not a factor above 0, such as 1/2"),
        (['--scale', '1/0'], "'1/0' is not a factor above 0"),
        (['--crop', '0,0,900,800'], 'crop 0,0,900,800 is not within the image of 848x800 px'),
        (['--crop', '0,0,0,800'], 'crop 0,0,0,800 is not within'),
        (['--crop', '0,0,800'], "'0,0,800' is not of the form X,Y,WIDTH,HEIGHT"),
        (['--size', '424'], "'424' is not of the form 1280x800"),
        (['--size', '424x400', '--scale', '1/2'], 'not allowed with argument'),
    ],
)
def test_what_cannot_be_is_refused(
    options: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_lens(FRONT, tmp_path / 'lens.yaml')
    try:
        code = cli.main(['lens', str(tmp_path / 'lens.yaml'), *options])
    except SystemExit as exit_:
        code = exit_.code
    error = capsys.readouterr().err
    assert code == 2 and re.search(said, error)


def test_another_aspect_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_lens(FRONT, tmp_path / 'lens.yaml')
    assert cli.main(['lens', str(tmp_path / 'lens.yaml'), '--size', '640x480']) == 0
    assert 'stretches the image by 0.7547 along u and 0.6 along v' in capsys.readouterr().err
    assert cli.main(['lens', str(tmp_path / 'lens.yaml'), '--size', '424x400']) == 0
    assert capsys.readouterr().err == ''


@pytest.mark.parametrize(
    ('given', 'said'),
    [
        ({'scale': 0.5, 'size': (10, 10)}, 'scale and size are both given'),
        ({'crop': (1, 2, 3)}, 'x, y, width, height'),
        ({'scale': 'half'}, 'scale'),
        ({'size': (10.5, 10)}, 'size'),
    ],
)
def test_the_library_refuses_what_is_no_image(given: dict, said: str) -> None:
    with pytest.raises(ParameterError, match=said):
        fsvp.resize_lens(FRONT, **given)
