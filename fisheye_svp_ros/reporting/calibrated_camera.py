"""A calibration in rows: of a lens, and of the robot that carried the camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.optics.lens import Lens, monotone_limit, parameter_values
from fisheye_svp_ros.pose import Pose, vector_from_rotation
from fisheye_svp_ros.reporting.terminal import UNITS, interval, with_error
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.solve.hand_eye import HandEye
from fisheye_svp_ros.solve.localization import localize
from fisheye_svp_ros.solve.measured_poses import rms_px
from fisheye_svp_ros.solve.outliers import WrongLandmark

if TYPE_CHECKING:
    from fisheye_svp_ros.solve.lens_calibration import Calibration
    from fisheye_svp_ros.study.trust import LensTrust

ROBOT_HEADER = ('transform', 'x, mm', 'y, mm', 'z, mm', 'rx, deg', 'ry, deg', 'rz, deg')


@dataclass(frozen=True)
class CalibratedCamera:
    """One camera's lens with its errors, the fit, its trust, its table, and the robot, if any.

    least_squares: the lens of least squares, with the same errors; wrong_landmarks: that are not
    where the table says, their points rejected.
    """

    lens: Lens
    least_squares: Lens
    result: Calibration
    trust: LensTrust
    table: Observations
    model: str
    hand_eye: HandEye | None = None
    wrong_landmarks: tuple[WrongLandmark, ...] = ()

    def generalize(self, lens: Lens) -> Lens:
        """Return a lens of least squares, fitted to more, moved as far as that of the camera was.

        It states no errors: it is to stay as it is.
        """
        names = self.result.adjusted.names
        values = [np.array(parameter_values(of, names)) for of in (lens, self.lens)]
        moved = values[1] - parameter_values(self.least_squares, names)
        lens = lens.with_parameters(names, (values[0] + moved).tolist())
        limit = min(self.lens.max_incidence, monotone_limit(lens))
        return replace(lens, calibration=None, max_incidence=limit)

    def with_lens(self, lens: Lens) -> CalibratedCamera:
        """Return the camera with a lens fitted to more, and the poses of its views by it."""
        adjusted, views = self.result.adjusted, self.result.views
        solved = localize(ForwardModel(lens), views, adjusted.pose)
        lens = replace(
            lens, calibration={**(lens.calibration or {}), 'rms_px': rms_px(solved.residual)}
        )
        return replace(
            self,
            lens=lens,
            result=self.result._replace(
                adjusted=adjusted._replace(lens=lens, pose=solved.pose, residual=solved.residual)
            ),
        )

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
        for known in (errors, ranges):
            if 'f' in known:
                known['fx'] = known['fy'] = known['f']
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
        *_rows(hand_eye.transform_names[0], hand_eye.camera, hand_eye.stderr[:6]),
        *_rows(hand_eye.transform_names[1], hand_eye.target, hand_eye.stderr[6:12]),
    ]


def _rows(name: str, pose: Pose, stderr: Array) -> list[tuple[str, ...]]:
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
