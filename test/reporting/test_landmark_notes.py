"""What is said of wrong landmarks."""

import numpy as np

from fisheye_svp_ros.reporting.wording.poses import wrong_landmark_notes
from fisheye_svp_ros.solve.outliers import WrongLandmark


def test_wrong_landmarks_are_named_with_what_to_do():
    moved = WrongLandmark(3, 20, 25.3, np.array([0.0, 0.03, 0.04]))
    other = moved._replace(number=7, offset=np.array([0.012, 0.0, 0.0]))
    lost = WrongLandmark(9, 18, 300.2, np.full(3, np.nan))
    assert list(wrong_landmark_notes([moved, other, lost])) == [
        'landmarks not where x, y, z say: 3 by 50 mm and 7 by 12 mm; rejected; measure them again',
        'landmark 9: its 18 points are 300 px off and no other place explains them; rejected; '
        'check its number',
    ]
    assert moved.to_dict()['offset'] == [0.0, 0.03, 0.04] and lost.to_dict()['offset'] is None
