"""Lenses with an image field beside mrcal's splined models."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import convert_lens
from helpers.lenses import FRONT, SHORT

from fisheye_svp_ros.effects.forward import back_project_corrected, project_corrected
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.lens_files import load_lens, save_lens
from fisheye_svp_ros.io.lens_formats import write_foreign
from fisheye_svp_ros.optics.curves import Gennery
from fisheye_svp_ros.optics.image_field import ImageField
from fisheye_svp_ros.optics.lens import Lens

# mrcal.project of version 2.2, for the model and the points of the test
MRCAL_POINTS = [
    [510.261171875, 372.331486111111],
    [777.079959671433, 468.411792739346],
    [221.997819295729, 603.746690654982],
    [598.350237840049, 72.867097588771],
    [264.686653350586, 127.58585437085],
]


def with_smooth_field(lens: Lens) -> Lens:
    """Return a lens of one viewpoint with a field of .4 px, rms."""
    grid = ImageField(np.zeros(2), np.full(2, 50.0), np.zeros((17, 18, 2))).nodes
    waves = np.stack([np.sin(grid @ [0.008, 0.004]), np.cos(grid @ [0.003, -0.007])], axis=-1)
    field = ImageField.interpolate(np.zeros(2), np.full(2, 50.0), 0.4 * waves)
    return replace(lens, viewpoint_shift=None, image_field=field)


def points_in_image(lens: Lens, count: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Return image points all over the image and points, m, that they are of."""
    uv = np.stack(
        np.meshgrid(np.linspace(5, lens.width - 6, count), np.linspace(5, lens.height - 6, count)),
        axis=-1,
    ).reshape(-1, 2)
    rays = back_project_corrected(lens, uv)
    return uv[rays.valid], rays.direction[rays.valid]


def test_an_image_field_is_a_splined_model_of_mrcal(tmp_path: Path) -> None:
    own = replace(with_smooth_field(FRONT), corrections={'skew': {'parameters': {'shear': 0.001}}})
    path = tmp_path / 'lens.cameramodel'
    path.write_text(write_foreign(own, 'mrcal'))
    assert "'LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=" in path.read_text()
    back = load_lens(path)
    uv, points = points_in_image(own)
    assert len(uv) > 1000
    assert np.abs(project_corrected(back, points).uv - uv).max() < 0.01
    assert np.abs(project_corrected(replace(own, image_field=None), points).uv - uv).max() > 0.4
    again = tmp_path / 'again.yaml'
    save_lens(back, again)
    assert load_lens(again).image_field == back.image_field
    # A viewpoint shift has a place in CAHVORE alone, which has none for the field.
    assert 'CAHVORE' in write_foreign(replace(SHORT, image_field=own.image_field), 'mrcal')


def test_a_splined_model_as_mrcal_writes_it(tmp_path: Path) -> None:
    """The points of mrcal 2.2, of `mrcal.project`, of a model with random control points."""
    rng = np.random.default_rng(4)
    values = [900.0, 910.0, 512.5, 380.5, *np.round(rng.normal(0, 0.01, 2 * 8 * 10), 4).tolist()]
    text = repr(
        {
            'lensmodel': 'LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=10_Ny=8_fov_x_deg=70',
            'intrinsics': values,
            'imagersize': [1024, 768],
            'extrinsics': [0.0] * 6,
        }
    )
    path = tmp_path / 'x.cameramodel'
    path.write_text(text)
    lens = load_lens(path)
    expected = np.array(MRCAL_POINTS)
    found = project_corrected(
        lens,
        np.array(
            [
                [0.0, 0.0, 1.0],
                [0.3, 0.1, 1.0],
                [-0.4, 0.3, 1.2],
                [0.1, -0.35, 1.0],
                [-0.2, -0.2, 0.7],
            ]
        ),
    ).uv
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
    corner = 2 * np.arctan(np.hypot(512.5 / 900, 380.5 / 910) / 2)
    assert np.radians(36) < lens.max_incidence < corner  # within a step of the nodes


@pytest.mark.parametrize(
    ('old', 'new', 'said'),
    [
        ('order=3', 'order=2', 'its splines must be of order 3'),
        ('Nx=', 'Nx=1', 'values; it needs'),
        ("'imagersize': [848, 800]", "'imagersize': [0, 0]", 'no point of it is in the image'),
        ("'intrinsics': [", "'intrinsics': [0.0, ", 'it needs'),
    ],
)
def test_a_broken_splined_model_is_refused(old: str, new: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / 'x.cameramodel'
    text = write_foreign(with_smooth_field(FRONT), 'mrcal')
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(LensError, match=re.escape(said)) as refused:
        load_lens(path)
    assert str(refused.value).startswith(f'{path}: ')


def test_command_shows_an_image_field_and_what_a_form_loses(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    convert_lens(with_smooth_field(FRONT), tmp_path, 'ros.yaml', 'ros')
    said = capsys.readouterr().out
    assert re.search(
        r'^  image_field +0\.4\d* px rms, splines of 18 x 17 nodes$', said, re.MULTILINE
    )
    assert 'left out: image_field\n' in said
    convert_lens(with_smooth_field(FRONT), tmp_path, 'x.cameramodel', 'mrcal')
    assert 'left out' not in capsys.readouterr().out


@pytest.mark.parametrize(
    ('lens', 'said'),
    [
        (replace(FRONT, corrections={'skew': {'parameters': {'shear': 0.001}}}), None),
        (
            replace(SHORT, viewpoint_shift=Gennery(0.002, 0.004)),
            'left out: s0 of the viewpoint shift',
        ),
    ],
)
def test_only_what_mrcal_does_not_hold_is_left_out(
    lens: Lens, said: str | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    convert_lens(lens, tmp_path, 'x.cameramodel', 'mrcal')
    lines = [line for line in capsys.readouterr().out.splitlines() if 'left out' in line]
    assert lines == ([said] if said else [])
