"""A calibration in rows: of a lens, and of the robot that carried the camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.optics.curves import IMAGE_HEIGHTS
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, vector_from_rotation
from fisheye_svp_ros.reporting.terminal import UNITS, interval, with_error
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.solve.hand_eye import HandEye
from fisheye_svp_ros.solve.outliers import NO_OUTLIERS, Outliers

if TYPE_CHECKING:
    from fisheye_svp_ros.solve.lens_calibration import Calibration
    from fisheye_svp_ros.study.trust import LensTrust

ROBOT_HEADER = ('transform', 'x, mm', 'y, mm', 'z, mm', 'rx, deg', 'ry, deg', 'rz, deg')


@dataclass(frozen=True)
class CalibratedCamera:
    """One camera's lens with its errors, the fit, its trust, its table, and the robot, if any.

    table: without outliers.
    """

    lens: Lens
    result: Calibration
    trust: LensTrust
    table: Observations
    hand_eye: HandEye | None = None
    outliers: Outliers = NO_OUTLIERS

    @property
    def model(self) -> str:
        """The name of the image-height curve."""
        kind = type(self.lens.image_height)
        return IMAGE_HEIGHTS.name_of(kind) or kind.__name__

    def parameter_rows(self) -> list[tuple[str, str, str, str, str]]:
        """Return name, value, standard error, range over targets ('': settled) and unit.

        Standard errors are those that the lens file holds.
        """
        errors = dict((self.lens.calibration or {}).get('stderr', {}))
        ranges = {
            name: interval(limits.low, limits.high)
            for name, limits in self.trust.admissible.items()
            if not limits.settled
        }
        for by_name in (errors, ranges):
            if 'f' in by_name:
                by_name['fx'] = by_name['fy'] = by_name['f']
        return [
            (
                name,
                *with_error(value, errors.get(name, 0.0)),
                ranges.get(name, ''),
                UNITS.get(name, '1'),
            )
            for name, value in self.lens.parameters.items()
        ]


def hand_eye_rows(hand_eye: HandEye) -> list[tuple[str, ...]]:
    """Return both transforms as ROBOT_HEADER has them, each with its standard errors below it."""
    return [
        *_transform_rows(hand_eye.transform_names[0], hand_eye.camera, hand_eye.stderr[:6]),
        *_transform_rows(hand_eye.transform_names[1], hand_eye.target, hand_eye.stderr[6:12]),
    ]


def _transform_rows(name: str, pose: Pose, stderr: Array) -> list[tuple[str, ...]]:
    turn = np.degrees(vector_from_rotation(pose.rotation))
    values = [
        *(f'{1e3 * value:.3f}' for value in pose.position),
        *(f'{value:.4f}' for value in turn),
    ]
    errors = [
        *(f'± {1e3 * value:.3f}' for value in stderr[:3]),
        *(f'± {value:.4f}' for value in np.degrees(stderr[3:])),
    ]
    return [(name, *values), ('', *errors)]
