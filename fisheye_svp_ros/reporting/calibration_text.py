"""A calibration in words and rows: of a lens, and of the robot that carried the camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.optics.lens import Lens, monotone_limit, parameter_values
from fisheye_svp_ros.pose import Pose, vector_from_rotation
from fisheye_svp_ros.reporting.terminal import UNITS, interval, with_error
from fisheye_svp_ros.scene.observations import Observations, list_frames
from fisheye_svp_ros.solve.hand_eye import MAX_ODDS, HandEye
from fisheye_svp_ros.solve.lens_checks import image_coverage, is_no_fit
from fisheye_svp_ros.solve.localization import localize
from fisheye_svp_ros.solve.measured_poses import rms_px
from fisheye_svp_ros.solve.outliers import WrongLandmark

if TYPE_CHECKING:
    from fisheye_svp_ros.solve.lens_calibration import Calibration
    from fisheye_svp_ros.study.trust import LensTrust

STANDARD_ERRORS = (
    'standard errors include local errors of target, frames and image, and the '
    'shape and scale of the target'
)
_MODEL_ERROR_RATIO = 2.0  # times the noise, from which residuals show a model error
ROBOT_HEADER = ('transform', 'x, mm', 'y, mm', 'z, mm', 'rx, deg', 'ry, deg', 'rz, deg')
_LARGE_SHARE = 0.5  # of the squares of all frames: such a pose is wrong
_MIN_FRAMES = 6
_MAX_SCALE = 2.0  # of lengths, either way: more is another unit, or the size of another board
_MIN_MM = 100.0  # such a factor, too large for a mistaken board, is that of mm


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

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """What there is to say against the lens, a sentence each."""
        shifts = [
            f'{name} is undetermined: {1e3 * range_.low:.2f} to {1e3 * range_.high:.2f} mm, since '
            'the shape of the target is confounded with it; run `fisheye-svp diagnose`'
            for name, range_ in self.trust.doubtful_shift.items()
        ]
        return (
            *shifts,
            *self._fit_warnings(),
            *self._image_warnings(),
            *(hand_eye_warnings(self.hand_eye) if self.hand_eye else ()),
        )

    def _fit_warnings(self) -> list[str]:
        found, result = [], self.result
        if result.left_out:
            found.append(
                'left out, their points do not determine a pose (all near one line, or '
                f'of another lens?): {list_frames(self.table, result.left_out)}'
            )
        if not result.adjusted.converged:
            found.append(
                'the adjustment has not converged, so the lens is inaccurate; take more '
                'photographs, or check these'
            )
        rms, sigma = (self.lens.calibration or {})['rms_px'], float(np.median(self.table.sigma))
        if is_no_fit(rms, sigma):
            found.append(
                f'{self.model} leaves {rms:.1f} px: the model does not fit this lens, or '
                'image points and landmarks do not match (check order, units, axes, '
                'image size)'
            )
        elif np.isfinite(sigma) and rms > _MODEL_ERROR_RATIO * 2**0.5 * sigma:
            found.append(
                f'{rms:.2g} px are {rms / sigma / 2**0.5:.1f} times the noise of image '
                'points: lens or target has a model error; run `fisheye-svp diagnose`'
            )
        if result.beyond:
            found.append(
                f'{result.beyond} observations lie beyond max_incidence_deg, where the '
                'fitted curve stops growing; try another --model'
            )
        return found

    def _image_warnings(self) -> list[str]:
        """Say where the image of the lens lies askew, or was not covered."""
        views, found = self.result.views, []
        image = image_coverage(self.lens, views.uv[views.used])
        if image.is_off_center:
            found.append(
                f'the principal point lies {image.offset[0]:.0f}, {image.offset[1]:.0f} px off '
                'the center of the image; check the image size, and that images are not cropped'
            )
        if image.is_extrapolated:
            found.append(
                f'the curve is extrapolated beyond {np.degrees(self.result.reached):.0f} deg: '
                f'image points reach {image.radius:.0f} px from the center, the nearest edge is '
                f'at {image.edge:.0f} px; photograph the target near the edges too'
            )
        return found


def hand_eye_sentence(found: HandEye) -> str:
    """Return how many poses there are, what the flange carries, the robot's noise, the scale."""
    scale, error = found.scale, found.stderr[-1]
    carried = 'target, the camera is fixed' if found.fixed_camera else 'camera'
    sure = '' if found.odds < MAX_ODDS else 'more than '
    return (
        f'{len(found.frame)} poses of the flange, which carries the {carried} (odds '
        f'{sure}{found.odds:.3g} to 1); noise of the robot '
        f'{1e3 * found.noise_m:.3f} mm and {np.degrees(found.noise_rad):.4f} deg an axis; '
        f'lengths of the target are {scale:.5f} ± {error:.5f} times those of the robot'
    )


def hand_eye_rows(found: HandEye) -> list[tuple[str, ...]]:
    """Return both transforms as ROBOT_HEADER has them, each with its standard errors below it."""
    return [
        *_rows(found.places[0], found.camera, found.stderr[:6]),
        *_rows(found.places[1], found.target, found.stderr[6:12]),
    ]


def hand_eye_warnings(found: HandEye) -> list[str]:
    """Return what there is to say against the poses."""
    warnings, factor = [], max(found.scale, 1 / found.scale)
    if found.fixed_camera:
        warnings.append(
            'the poses are those of a flange that carries the target before a fixed camera; if it '
            'carries the camera, they are inverted: give the flange in the base'
        )
    if factor > _MAX_SCALE:
        longer = 'the poses' if found.scale < 1 else 'the target'
        likely = f': {longer} may be in mm' if factor > _MIN_MM else ''
        warnings.append(
            f'lengths of robot and target differ by a factor of {factor:.4g}{likely}; '
            'both are needed in m'
        )
    noise = np.repeat((found.noise_m, found.noise_rad), 3)
    squares = ((found.residual / noise) ** 2).sum(axis=1)
    worst = int(np.argmax(squares))
    if len(squares) >= _MIN_FRAMES and squares[worst] >= _LARGE_SHARE * squares.sum():
        off, turn = np.linalg.norm(found.residual[worst].reshape(2, 3), axis=1)
        warnings.append(
            f'the pose of frame {found.frame[worst]} is {1e3 * off:.1f} mm and '
            f'{np.degrees(turn):.2f} deg off the others: correct it, or remove it from the poses'
        )
    return warnings


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
