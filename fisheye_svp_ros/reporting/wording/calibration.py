"""A calibration in sentences: its estimate, its lens, the robot that carried the camera."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from fisheye_svp_ros.reporting.wording.inputs import exchanged_cameras, points_mirrored
from fisheye_svp_ros.scene.observations import STEREO, list_frames
from fisheye_svp_ros.solve.hand_eye import MAX_ODDS, HandEye
from fisheye_svp_ros.solve.lens_checks import image_coverage, is_no_fit
from fisheye_svp_ros.solve.mirrored_points import find_mirror
from fisheye_svp_ros.solve.outliers import FRAME
from fisheye_svp_ros.solve.rig_checks import MAX_RIG_RATIO, MIN_SHARED_FRAMES, is_exchanged

if TYPE_CHECKING:
    from fisheye_svp_ros.optics.lens import Lens
    from fisheye_svp_ros.reporting.calibrated_camera import CalibratedCamera
    from fisheye_svp_ros.scene.observations import Observations
    from fisheye_svp_ros.solve.rig_calibration import RigCalibration

STANDARD_ERRORS = (
    'Standard errors include local errors of target, frames, and image, and likely errors in '
    'the shape and scale of the target.'
)
ANY_TARGET = '95 %, any target'  # heads the range of a parameter
ANY_TARGET_NOTE = (
    f'{ANY_TARGET}: the shape and scale of the target may be wrong by as much as these data '
    'leave unnoticed'
)
_WORTH_SAYING = 1.001  # residuals over those of least squares
_MODEL_ERROR_RATIO = 2.0  # times the noise, from which residuals show a model error
_MAX_NOISE = 0.6  # px, of a coordinate: twice what the poorest detectors leave
_LARGE_SHARE = 0.5  # of the squares of all frames: such a pose is wrong
_MIN_FRAMES = 6
_ENOUGH_FRAMES = 8  # as for `diagnose`, which takes long to load
_MAX_SCALE = 2.0  # of lengths, either way: more is another unit, or the size of another board
_MAX_SCALE_ERROR, _MIN_SIGMAS = 0.02, 3.0  # of lengths that are measured, and standard errors
_MAX_NOISE_M, _MAX_NOISE_RAD = 2e-3, np.radians(0.3)  # of an arm; ten times its repeatability
_MIN_MM = 100.0  # such a factor, too large for a mistaken board, is that of mm


def estimate_sentence(figures: Mapping[str, Any]) -> str:
    """Return why the residual is larger than that of least squares; '' where it is not.

    figures: the `calibration` block of a lens.
    """
    least = figures.get('least_squares_rms_px')
    if least is None or figures['rms_px'] < _WORTH_SAYING * least:
        return ''
    return (
        f'On the board as stated, the rms is {figures["rms_px"]:.4f} px. Plain least squares '
        f'leaves {least:.4f} px, because it absorbs board errors into the lens (--plain writes '
        'that lens).'
    )


def reached_sentence(reached: float, claimed: float) -> str:
    """Return how far off axis the points reach, and what is beyond; angles in rad."""
    points, lens = (round(float(np.degrees(angle))) for angle in (reached, claimed))
    beyond = f'; from there to {lens} deg, the lens is extrapolated' if lens > points else ''
    return f'Image points reach {points} deg off axis{beyond}.'


def calibration_warnings(camera: CalibratedCamera) -> tuple[str, ...]:
    """Return what there is to say against a lens, a sentence each."""
    shifts = [
        f'{name} is undetermined: {1e3 * limits.low:.2f} to {1e3 * limits.high:.2f} mm, because '
        'the shape of the target is confounded with it. Run `fisheye-svp diagnose`'
        for name, limits in camera.trust.doubtful_shift.items()
    ]
    mirror = find_mirror(camera.table, camera.lens)
    return (
        *([points_mirrored('points', mirror)] if mirror else ()),
        *shifts,
        *_fit_warnings(camera),
        *_image_warnings(camera),
        *(hand_eye_warnings(camera.hand_eye) if camera.hand_eye else ()),
    )


def _fit_warnings(camera: CalibratedCamera) -> list[str]:
    texts, result = [], camera.result
    if result.left_out:
        texts.append(
            'left out, because their points do not determine a pose (all near one line, or of '
            f'another lens?): {list_frames(camera.table, result.left_out)}'
        )
    if not result.adjusted.converged:
        texts.append(
            'the fit did not converge, so the lens is inaccurate. Take more photographs, or '
            'check these'
        )
    texts += _few_frames(len(result.views.frame))
    rms, sigma = (camera.lens.calibration or {})['rms_px'], float(np.median(camera.table.sigma))
    noise = sigma if np.isfinite(sigma) else camera.trust.noise_px
    if is_no_fit(rms, sigma):
        texts.append(
            f'{camera.model} leaves {rms:.1f} px: the model does not fit this lens, two cameras '
            'are mixed, or image points and landmarks do not match. Do not use the lens. Check '
            'order, units, axes, and image size'
        )
    elif len(result.views.frame) > 1 and rms > _MODEL_ERROR_RATIO * 2**0.5 * noise:
        texts.append(
            f'the residual of {rms:.2g} px is {rms / noise / 2**0.5:.1f} times the image noise: '
            'the lens, the target, or the data have a model error. Run `fisheye-svp diagnose` '
            'before you use this lens'
        )
    if len(result.views.frame) > 1 and camera.trust.noise_px > _MAX_NOISE:
        texts.append(
            f'the noise in u and v is {camera.trust.noise_px:.1f} px, far more than a detector '
            'leaves (0.02 to 0.3 px). Check the sharpness, the detector, and the order of the '
            'corners'
        )
    if result.beyond:
        texts.append(
            f'{result.beyond} observations lie beyond max_incidence_deg, where the '
            'fitted curve stops growing; try another --model'
        )
    return texts


def _few_frames(frames: int) -> list[str]:
    """Say it where so few frames were taken that their lens cannot be judged."""
    if frames == 1:
        return [
            'one frame cannot separate noise from errors of the landmarks; take '
            f'{_ENOUGH_FRAMES} frames or more'
        ]
    if frames < _MIN_FRAMES:
        return [f'{frames} frames are too few to judge a lens; take {_ENOUGH_FRAMES} or more']
    return []


def _image_warnings(camera: CalibratedCamera) -> list[str]:
    """Say where the image of the lens lies askew, or was not covered."""
    views, texts = camera.result.views, []
    image = image_coverage(camera.lens, views.uv[views.used])
    if image.is_off_center:
        texts.append(
            f'the principal point is {image.offset[0]:.0f}, {image.offset[1]:.0f} px off the '
            'center of the image. Check the image size, and whether images are cropped'
        )
    if image.is_extrapolated:
        texts.append(
            f'the curve is extrapolated beyond {np.degrees(camera.result.reached):.0f} deg: '
            f'image points reach {image.radius:.0f} px from the center, but the nearest edge is '
            f'at {image.edge:.0f} px. Photograph the target near the edges, too'
        )
    return texts


def hand_eye_sentence(hand_eye: HandEye) -> str:
    """Return how many poses there are, what the flange carries, the robot's noise, the scale."""
    scale, error = hand_eye.scale, hand_eye.stderr[-1]
    carried = 'target, the camera is fixed' if hand_eye.fixed_camera else 'camera'
    sure = '' if hand_eye.odds < MAX_ODDS else 'more than '
    return (
        f'{len(hand_eye.frame)} poses of the flange, which carries the {carried} (odds '
        f'{sure}{hand_eye.odds:.3g} to 1). Noise of the robot: {1e3 * hand_eye.noise_m:.3f} mm '
        f'and {np.degrees(hand_eye.noise_rad):.4f} deg per axis. Lengths of the target are '
        f'{scale:.5f} ± {error:.5f} times those of the robot'
    )


def hand_eye_warnings(hand_eye: HandEye) -> list[str]:
    """Return what there is to say against the poses."""
    warnings, factor = [], max(hand_eye.scale, 1 / hand_eye.scale)
    if hand_eye.fixed_camera:
        warnings.append(
            'the poses are those of a flange that carries the target in front of a fixed '
            'camera. If it carries the camera, the poses are inverted: give those of the '
            'flange in the base'
        )
    if factor > _MAX_SCALE:
        longer = 'the poses' if hand_eye.scale < 1 else 'the target'
        likely = f': {longer} may be in mm' if factor > _MIN_MM else ''
        warnings.append(
            f'lengths of robot and target differ by a factor of {factor:.4g}{likely}; '
            'both are needed in m'
        )
    elif abs(hand_eye.scale - 1) > max(_MAX_SCALE_ERROR, _MIN_SIGMAS * hand_eye.stderr[-1]):
        warnings.append(
            f'lengths of the target are {100 * (hand_eye.scale - 1):+.1f} % off those of the '
            f'robot: a square of 25 mm would have to be {25 / hand_eye.scale:.1f} mm. Measure '
            'the squares'
        )
    if hand_eye.noise_m > _MAX_NOISE_M or hand_eye.noise_rad > _MAX_NOISE_RAD:
        warnings.append(
            f'the noise of the robot is {1e3 * hand_eye.noise_m:.2g} mm and '
            f'{np.degrees(hand_eye.noise_rad):.2g} deg, far above the repeatability of an arm. '
            'Check the stamps, the tool frame, and the lens'
        )
    noise = np.repeat((hand_eye.noise_m, hand_eye.noise_rad), 3)
    squares = ((hand_eye.residual / noise) ** 2).sum(axis=1)
    worst = int(np.argmax(squares))
    if len(squares) >= _MIN_FRAMES and squares[worst] >= _LARGE_SHARE * squares.sum():
        off, turn = np.linalg.norm(hand_eye.residual[worst].reshape(2, 3), axis=1)
        warnings.append(
            f'the pose of frame {hand_eye.frame[worst]} is {1e3 * off:.1f} mm and '
            f'{np.degrees(turn):.2f} deg off the others. Correct it, or remove it'
        )
    return warnings


def unrelated_cameras(group: Sequence[str], others: Sequence[str]) -> str:
    """Return why cameras are not in a rig with others."""
    return (
        f'{" and ".join(group)} cannot be related to {", ".join(others)}: no frame shows the '
        'target in both. Photograph it where two cameras see it, or turn the rig while each '
        'camera sees a board of its own. Give simultaneous photographs the same frame number'
    )


def rig_warnings(
    rig: RigCalibration, table: Observations, lenses: Mapping[str, Lens]
) -> Iterator[str]:
    """Yield what there is to say against a rig; lenses: of each camera, fitted by itself."""
    if rig.left_out:
        yield f'left out: {list_frames(table, rig.left_out)}: {FRAME}'
    if rig.reason:
        yield rig.reason
    if rig.cameras == STEREO and is_exchanged(rig.steps()[0]):
        yield exchanged_cameras(*STEREO)
    own = max((lenses[name].calibration or {}).get('rms_px', np.inf) for name in rig.cameras)
    if rig.total_rms_px > MAX_RIG_RATIO * own:
        yield (
            f'rms {rig.total_rms_px:.2f} px with a rigid rig, compared with at most {own:.2f} '
            'px for each camera alone. The cameras moved, their photographs were not '
            'simultaneous, or a lens is wrong'
        )
    for name, shared in zip(rig.cameras, rig.shared.tolist(), strict=True):
        if shared < MIN_SHARED_FRAMES:
            yield _few_shared_frames(name, shared, len(rig.cameras))
            if len(rig.cameras) == 2:
                return


def _few_shared_frames(name: str, shared: int, cameras: int) -> str:
    one = shared == 1
    if cameras > 2:
        what = f'relate{"s" if one else ""} {name} to the others'
    else:
        what = 'is shared' if one else 'are shared'
    return (
        f'only {shared} frame{"" if one else "s"} {what}. It is assumed that all cameras saw '
        'one target. Take more photographs of it with two cameras at once'
    )
