"""Environments and landmark files."""

import numpy as np
import pytest

from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.io.landmark_files import environment, load_landmarks
from fisheye_svp_ros.scene.observations import RADII, SPREADS


def angles(landmarks):
    """Degrees from the camera's gaze, -z."""
    across = np.hypot(landmarks.points[:, 0], landmarks.points[:, 1])
    return np.degrees(np.arctan2(across, -landmarks.points[:, 2]))


@pytest.mark.parametrize('radius', RADII)
def test_kitas_environments(radius):
    whole, inner, outer = (environment(spread, radius) for spread in SPREADS)
    assert [len(e.ids) for e in (whole, inner, outer)] == [33, 15, 18]
    np.testing.assert_array_equal(whole.ids, np.concatenate([inner.ids, outer.ids]))
    np.testing.assert_array_equal(whole.points, np.concatenate([inner.points, outer.points]))
    np.testing.assert_allclose(np.linalg.norm(whole.points, axis=-1), radius, rtol=1e-15)
    assert np.all(whole.points[:, 2] < 0)
    assert angles(inner).max() < angles(outer).min()


def test_lookup_by_id_in_any_order_and_shape():
    landmarks = environment('outer', 0.5)
    ids = np.array([[20, 15], [3, 32]])
    points, known = landmarks.lookup(ids)
    assert known.tolist() == [[True, True], [False, True]]
    np.testing.assert_array_equal(points[0, 0], landmarks.points[landmarks.ids == 20][0])
    assert np.isnan(points[1, 0]).all()


@pytest.mark.parametrize(
    ('spread', 'radius', 'reason'),
    [
        ('middle', 2.0, "environment 'middle' is unknown; choose from whole, inner, outer"),
        ('whole', 0.0, 'environment radius is 0.0 m; it must be above 0'),
        ('whole', float('nan'), 'environment radius is nan m; it must be above 0'),
        ('whole', float('inf'), 'environment radius is inf m; it must be above 0'),
    ],
)
def test_impossible_environment(spread, radius, reason):
    with pytest.raises(ObservationError, match=reason):
        environment(spread, radius)


def test_landmark_file_in_any_column_order(tmp_path):
    file = tmp_path / 'landmarks.csv'
    file.write_text('z,colour,landmark,y,x\n3,red,7,2,1\n-3e-1,blue,4,0,0\n')
    landmarks = load_landmarks(file)
    assert landmarks.ids.tolist() == [7, 4]
    np.testing.assert_array_equal(landmarks.points, [[1, 2, 3], [0, 0, -0.3]])
    points, known = landmarks.lookup(np.array([4, 5]))
    assert known.tolist() == [True, False]
    np.testing.assert_array_equal(points[0], [0, 0, -0.3])


def test_landmarks_of_a_spreadsheet_begin_with_a_byte_order_mark(tmp_path):
    file = tmp_path / 'landmarks.csv'
    file.write_bytes(b'\xef\xbb\xbflandmark,x,y,z\n7,1,2,3\n')
    assert load_landmarks(file).ids.tolist() == [7]


WHOLE = 'a whole number from 0 to 4294967295 is needed'


@pytest.mark.parametrize(
    ('content', 'reason'),
    [
        ('', 'it is empty; a header with landmark,x,y,z is needed'),
        ('landmark,x,y\n', "column 'z' is missing"),
        ('landmark,x,y,z\n', 'no row below the header; at least one is needed'),
        ('landmark,x,y,z\n1,0,0,0\n1,1,1,1\n', 'landmark 1 is listed twice'),
        ('landmark,x,y,z\n1,0,nan,0\n', "line 2: y is 'nan'; a finite number is needed"),
        ('landmark,x,y,z\n1,0,0,0\n2,0,abc,0\n', "line 3: y is 'abc'; a number is needed"),
        ('landmark,x,y,z\n1,0,0\n', 'line 2: 3 fields where the header has 4'),
        ('landmark,x,y,z\n1.5,0,0,0\n', f"line 2: landmark is '1.5'; {WHOLE}"),
        (f'landmark,x,y,z\n{2**70},0,0,0\n', f'line 2: landmark is .*; {WHOLE}'),
    ],
)
def test_broken_landmark_file(content, reason, tmp_path):
    file = tmp_path / 'landmarks.csv'
    file.write_text(content)
    with pytest.raises(ObservationError, match=reason) as caught:
        load_landmarks(file)
    assert str(caught.value).startswith(str(file))


def test_unreadable_landmark_file(tmp_path):
    with pytest.raises(ObservationError, match=r'absent\.csv: cannot be read'):
        load_landmarks(tmp_path / 'absent.csv')
    (tmp_path / 'binary.csv').write_bytes(b'\xff\xfe\x00\x01')
    with pytest.raises(ObservationError, match=r'binary\.csv: not a text file'):
        load_landmarks(tmp_path / 'binary.csv')
