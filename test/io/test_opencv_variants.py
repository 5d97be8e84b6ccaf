"""Files of OpenCV as its versions and other people's programs write them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from fisheye_svp_ros import cli
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.lens_files import cameras_in, load_lens, read_lens_file

K = np.array([[410.3, 0, 640.2], [0, 409.1, 470.1], [0, 0, 1.0]])
D = np.array([-0.01, 0.003, -0.002, 0.0002])


def matrix(name: str, value: np.ndarray) -> str:
    rows, columns = value.shape
    return (
        f'{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n'
        f'   data: {value.ravel().tolist()}\n'
    )


def flat(name: str, value: np.ndarray) -> str:
    return (
        f'{name}: !!opencv-nd-matrix\n   sizes: {list(value.shape)}\n   dt: d\n'
        f'   data: {value.ravel().tolist()}\n'
    )


def check(path: Path, camera: str = '') -> None:
    lens = load_lens(f'{path}#{camera}' if camera else path)
    assert (lens.width, lens.height) == (1280, 960)
    assert [*lens.parameters.values()][:8] == pytest.approx([410.3, 409.1, 640.2, 470.1, *D])


@pytest.mark.parametrize('form', ['yml', 'xml', 'json'])
def test_arrays_of_one_dimension(form: str, tmp_path: Path) -> None:
    """Version 5 of OpenCV writes them by their sizes."""
    path = tmp_path / f'o.{form}'
    if form == 'yml':
        path.write_text(
            '%YAML 1.2\n---\nimage_width: 1280\nimage_height: 960\n'
            + matrix('cameraMatrix', K) + flat('distCoeffs', D)
        )  # fmt: skip
    elif form == 'json':
        path.write_text(
            '{"image_width": 1280, "image_height": 960, "K": {"type_id": "opencv-matrix", '
            f'"rows": 3, "cols": 3, "dt": "d", "data": {K.ravel().tolist()}}}, '
            '"D": {"type_id": "opencv-nd-matrix", "sizes": [4], "dt": "d", '
            f'"data": {D.tolist()}}}}}'
        )
    else:
        numbers = [' '.join(map(str, one.ravel())) for one in (K, D)]
        path.write_text(
            '<?xml version="1.0"?><opencv_storage><image_width>1280</image_width>'
            '<image_height>960</image_height><K type_id="opencv-matrix"><rows>3</rows>'
            f'<cols>3</cols><dt>d</dt><data>{numbers[0]}</data></K>'
            '<D type_id="opencv-nd-matrix"><sizes>4</sizes><dt>d</dt>'
            f'<data>{numbers[1]}</data></D></opencv_storage>'
        )
    check(path)


@pytest.mark.parametrize(
    ('size', 'left', 'right'),
    [
        ('img_size: [1280, 960]', ('K1', 'D1'), ('K2', 'D2')),
        ('imageSize: [1280, 960]', ('M1', 'D1'), ('M2', 'D2')),
        (
            'imageWidth: 1280\nimageHeight: 960',
            ('camera_matrix_left', 'dist_coeffs_left'),
            ('camera_matrix_right', 'dist_coeffs_right'),
        ),
        ('size: [1280, 960]', ('K_l', 'D_l'), ('K_r', 'D_r')),
        ('frame_size: [1280, 960]', ('leftK', 'leftD'), ('rightK', 'rightD')),
        (
            'image_width: 1280\nimage_height: 960',
            ('cameraMatrix0', 'distCoeffs0'),
            ('cameraMatrix1', 'distCoeffs1'),
        ),
    ],
)
def test_two_cameras_by_any_names(
    size: str, left: tuple[str, str], right: tuple[str, str], tmp_path: Path
) -> None:
    path = tmp_path / 'stereo.yaml'
    text = f'%YAML:1.0\n---\n{size}\n'
    for names, scale in ((left, 2.0), (right, 1.0)):
        k = K.copy()
        k[:2, :2] *= scale
        text += matrix(names[0], k) + matrix(names[1], D[None])
    place = flat('T', np.array([-0.064, 0, 0]))
    path.write_text(text + matrix('R', np.eye(3)) + place)
    assert cameras_in(path) == ('left', 'right')
    check(path, 'right')
    assert load_lens(f'{path}#left').parameters['fx'] == pytest.approx(820.6)
    foreign = read_lens_file(path)
    assert foreign is not None and foreign.rigs[0].position.tolist() == [-0.064, 0, 0]


def test_lists_in_place_of_matrices(tmp_path: Path) -> None:
    path = tmp_path / 'o.yaml'
    path.write_text(
        f'%YAML:1.0\n---\nresolution: [1280, 960]\nmtx: {K.tolist()}\ndist: {D.tolist()}\n'
    )
    check(path)


def test_a_missing_size_is_told_with_its_remedy(tmp_path: Path) -> None:
    path = tmp_path / 'o.yaml'
    path.write_text('%YAML:1.0\n---\n' + matrix('K', K) + matrix('D', D[None]))
    with pytest.raises(LensError, match='image size is missing; add image_width and image_height'):
        load_lens(path)


@pytest.mark.parametrize(('more', 'told'), [('', True), ('fisheye_model: 1\n', False)])
def test_four_coefficients_are_told_as_what_they_are_read(
    more: str, told: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / 'o.yaml'
    head = f'%YAML:1.0\n---\nimage_width: 1280\nimage_height: 960\n{more}'
    path.write_text(head + matrix('camera_matrix', K) + matrix('distCoeffs', D[None]))
    assert cli.main(['lens', str(path)]) == 0
    said = capsys.readouterr().err
    assert (
        '4 coefficients are read as those of cv2.fisheye; add `fisheye_model: 0`' in said
    ) == told


def test_what_is_written_says_that_it_is_of_a_fisheye(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / 'o.yaml', tmp_path / 'again.yaml'
    path.write_text(
        '%YAML:1.0\n---\nimage_size: [1280, 960]\n' + matrix('K', K) + matrix('D', D[None])
    )
    assert cli.main(['lens', str(path), '-o', str(out), '--format', 'opencv']) == 0
    capsys.readouterr()
    assert cli.main(['lens', str(out)]) == 0
    assert capsys.readouterr().err == ''
    storage = cv2.FileStorage(str(out), cv2.FILE_STORAGE_READ)
    assert storage.getNode('fisheye_model').real() == 1
    check(out)


@pytest.mark.parametrize(
    'text',
    [
        f'camera_matrix: {K.tolist()}\ndist_coeff: [{D.tolist()}]\nimg_size: [1280, 960]\n',
        f'K:\n- {K[0].tolist()}\n- {K[1].tolist()}\n- {K[2].tolist()}\nD: {D.tolist()}\n'
        'image_size: [1280, 960]\n',
        f'{{"K": {K.tolist()}, "D": {D[:, None].tolist()}, "image_size": [1280, 960]}}',
        f'{{\n "mtx": {K.tolist()},\n "dist": {D.tolist()},\n "width": 1280, "height": 960\n}}',
    ],
)
def test_lists_of_a_script(text: str, tmp_path: Path) -> None:
    """As `yaml.dump` and `json.dump` of `.tolist()` write them."""
    (tmp_path / 'camera.txt').write_text(text)
    check(tmp_path / 'camera.txt')


def test_fisheye_by_its_short_name_is_no_assumption(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / 'o.yaml'
    entries = f'{matrix("K", K)}{matrix("D", D[None])}image_size: [1280, 960]\n'
    for more, notes in (('', 1), ('fisheye: 1\n', 0)):
        path.write_text(f'%YAML:1.0\n{entries}{more}')
        assert cli.main(['lens', str(path)]) == 0
        assert capsys.readouterr().err.count('4 coefficients') == notes


def test_a_baseline_in_millimeters_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / 'stereo.yaml'
    for size, told in ((0.12, False), (120.0, True)):
        path.write_text(
            '%YAML:1.0\nimage_size: [1280, 960]\n'
            + ''.join(matrix(f'K{i}', K) + matrix(f'D{i}', D[None]) for i in (1, 2))
            + matrix('R', np.eye(3)) + matrix('T', np.array([[-size], [0.0], [0.0]]))
        )  # fmt: skip
        assert cli.main(['lens', str(path)]) == 0
        assert ('120 m apart; translations must be in m' in capsys.readouterr().err) == told
