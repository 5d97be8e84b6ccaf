"""Lenses of one camera or several, their rig and a robot, from one table: for command and library.

Each camera is fitted by least squares, without outliers.  Cameras that frames hold together are
then fitted as one, with random parts of target and frames that all of them share: lenses, rig and
their covariance come from that fit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fisheye_svp_ros.errors import FisheyeSvpError, GeometryError, ObservationError
from fisheye_svp_ros.io.files import write_json, write_text, write_together
from fisheye_svp_ros.io.lens_files import save_lens
from fisheye_svp_ros.io.lens_formats import kalibr, transforms
from fisheye_svp_ros.io.readers import Sizes
from fisheye_svp_ros.io.rig_files import save_rig
from fisheye_svp_ros.optics.lens import Lens, parameter_values
from fisheye_svp_ros.optics.ports import Port
from fisheye_svp_ros.pose import Pose, quaternion_from_rotation
from fisheye_svp_ros.reporting.calibrated_camera import CalibratedCamera
from fisheye_svp_ros.reporting.wording.calibration import (
    calibration_warnings,
    rig_warnings,
    unrelated_cameras,
)
from fisheye_svp_ros.reporting.wording.inputs import reader_limit
from fisheye_svp_ros.scene.observations import Observations, join_tables, rig_cameras
from fisheye_svp_ros.scene.table_checks import check_frames_differ, check_rigid, remove_copies
from fisheye_svp_ros.solve.bundle_adjustment import adjust, rig_covariance
from fisheye_svp_ros.solve.hand_eye import HandEye
from fisheye_svp_ros.solve.lens_calibration import (
    Calibration,
    calibrate,
    calibrate_hand_eye,
    calibrate_port,
    rough_lenses,
    with_values,
)
from fisheye_svp_ros.solve.measured_poses import posable_observations, rms_px
from fisheye_svp_ros.solve.outliers import Outliers
from fisheye_svp_ros.solve.rig_calibration import (
    RigCalibration,
    calibrate_rig,
    connected_cameras,
    start_rig,
)
from fisheye_svp_ros.solve.rig_checks import MAX_RIG_RATIO
from fisheye_svp_ros.solve.rig_state import Linearization
from fisheye_svp_ros.solve.robust_calibration import calibrate_without_outliers

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class LensOptions:
    """What is fitted: the curve, its parameters (None: all), a port, a robot.

    air: the same camera in air; poses: of the robot's flange, by frame; plain: by least squares.
    """

    model: str = 'kannala_brandt'
    free: Sequence[str] | None = None
    port: Port | None = None
    air: Lens | None = None
    poses: Mapping[int, Pose] | None = None
    plain: bool = False


class _Fit(NamedTuple):
    """A lens of least squares, the rows that it is of, what was rejected, and the robot."""

    result: Calibration
    rows: Observations
    outliers: Outliers
    hand_eye: HandEye | None

    @property
    def lens(self) -> Lens:
        return self.result.adjusted.lens


@dataclass(frozen=True)
class CalibratedCameras:
    """What a table of observations says of its cameras, '' for one without a name.

    rig: of those that frames hold together, with their lenses; notes: what there is to say against
    it; observations: without frames that repeat earlier ones, copies.
    """

    cameras: dict[str, CalibratedCamera]
    rig: RigCalibration | None
    notes: tuple[str, ...]
    observations: Observations
    copies: tuple[int, ...]

    def paths(self, output: Path) -> dict[str, Path]:
        """Return the lens file of each camera: the output, or in a folder."""
        alone = len(self.cameras) == 1 and bool(output.suffix)
        return {
            name: output if alone or not name else output / f'{name}.yaml' for name in self.cameras
        }

    def save(self, output: Path, command: str) -> tuple[Path, list[str]]:
        """Write lenses, covariances, report and rig; return the report, and notes.

        command: to go on with, for the report.  Raises OutputError where it cannot be written.
        """
        from fisheye_svp_ros.reporting.calibration_report import write_calibration_report

        paths, notes = self.paths(output), []
        report = (
            output / 'calibration.html'
            if len(paths) > 1
            else next(iter(paths.values())).with_suffix('.calibrate.html')
        )
        with write_together():
            for name, camera in self.cameras.items():
                save_lens(camera.lens, paths[name])
                write_json(paths[name].with_suffix('.calibrate.json'), _document(camera))
            if self.rig:
                notes = write_rig(self.rig, output)
        write_calibration_report(report, self.cameras, command)  # results before pictures
        return report, notes


def _no_progress(stage: str, done: float) -> None:
    """Report no progress."""


def calibrate_cameras(
    observations: Observations,
    sizes: Sizes,
    options: LensOptions,
    names: Mapping[str, str] | None = None,
    progress: Progress = _no_progress,
) -> CalibratedCameras:
    """Fit the lenses of all cameras of a table, and their rig where frames hold them together.

    sizes: of the images, px, by camera, '' for all; names: of the lenses, by camera.
    Raises LensError for an unknown model or parameter, ObservationError or GeometryError where the
    data do not fix a lens.
    """
    check_frames_differ(observations)
    observations, copies = remove_copies(observations)
    check_rigid(observations)
    fits: dict[str, _Fit] = {}
    for number, name in enumerate(observations.cameras):
        progress('fitting the lens', 0.3 * number / len(observations.cameras))
        rows = observations.take(observations.camera == number)
        size = sizes.get(name) or sizes['']
        fits[name] = _fit_camera(rows, size, options, (names or {}).get(name, name))
    progress(f'{_values(fits)}; computing their standard errors', 0.4)
    try:
        rig, notes, cameras = _fit_together(fits, options)
        cameras |= {
            name: _assess(fit, options) for name, fit in fits.items() if name not in cameras
        }
        if len(fits) > 1 and not rig:
            rig, more = _rig_of_lenses(fits, cameras)
            notes = [*notes, *more]
    except np.linalg.LinAlgError as cause:
        remedy = 'check --port and --medium' if options.port else 'add views from other sides'
        raise GeometryError(
            f'{observations.source}: the fitted lens has no rays to some of the observed '
            f'points ({cause}); {remedy}'
        ) from cause
    cameras = {name: cameras[name] for name in fits}
    return CalibratedCameras(cameras, rig, tuple(notes), observations, copies)


def _values(fits: Mapping[str, _Fit]) -> str:
    """Return the first parameters of the lenses, to be shown while their errors are computed."""
    return '; '.join(
        f'{name}: ' * bool(name)
        + ', '.join(f'{key} {value:.6g}' for key, value in [*fit.lens.parameters.items()][:4])
        for name, fit in fits.items()
    )


def _fit_camera(
    table: Observations, size: tuple[int, int], options: LensOptions, name: str
) -> _Fit:
    """Fit one camera by least squares, without outliers, and the robot that carried it."""
    model, air, port = options.model, options.air, options.port

    def fit_rows(rows: Observations) -> Calibration:
        if air and port:
            return calibrate_port(rows, air, port, options.free)
        return calibrate(rows, model, size, options.free, name, port)

    starts = () if air else rough_lenses(model, size)
    result, kept, outliers = calibrate_without_outliers(table, fit_rows, starts)
    hand_eye = None
    if options.poses:
        result, hand_eye = calibrate_hand_eye(result, kept, dict(options.poses))
    return _Fit(result, kept, outliers, hand_eye)


def _assess(fit: _Fit, options: LensOptions) -> CalibratedCamera:
    """Return the lens of one camera by itself, with its errors."""
    from fisheye_svp_ros.study.trust import assess_lens, generalize

    trusted = assess_lens(fit.rows, fit.lens, fit.result.adjusted.names)
    result = fit.result if options.plain else generalize(fit.result, trusted)
    return _camera(fit, result, trusted, options)


def _camera(
    fit: _Fit, result: Calibration, trusted: Any, options: LensOptions
) -> CalibratedCamera:
    """Return a camera with a lens, what is known of it, and the robot of that lens."""
    from fisheye_svp_ros.study.trust import with_covariance

    hand_eye = fit.hand_eye
    if options.poses and result is not fit.result:
        result, hand_eye = calibrate_hand_eye(
            result, fit.rows, dict(options.poses), trusted.covariance
        )
    lens = with_covariance(result.adjusted.lens, trusted)
    return CalibratedCamera(lens, result, trusted, fit.rows, hand_eye, fit.outliers)


def _fit_together(
    fits: Mapping[str, _Fit], options: LensOptions
) -> tuple[RigCalibration | None, list[str], dict[str, CalibratedCamera]]:
    """Fit the cameras that frames hold together: rig, notes, and these cameras.

    No rig where there is none, or where the cameras do not keep their places.
    """
    from fisheye_svp_ros.study.trust import assess_cameras, generalize_rig

    if len(fits) < 2:
        return None, [], {}
    try:
        table, lenses, group, notes = _related(fits, {name: fits[name].lens for name in fits})
        start = start_rig(table, lenses, group)
        data, state = start.add_frames_of_one(table)
        known = Linearization(data, state, ())
        rig_covariance(known, 1.0, np.zeros((0, 0)))  # raises where it is not determined
        names = [f'{name}.{one}' for name in start.cameras for one in _names(fits[name])]
        state = adjust(data, replace(state, labels=start.cameras), names)
        alone = max(rms_px(fits[name].result.adjusted.residual) for name in group)
        if Linearization(data, state, ()).rms_px > MAX_RIG_RATIO * alone:
            return None, [], {}
        trusted = assess_cameras(data, state, names)
        final = state if options.plain else generalize_rig(data, state, names, trusted)
        rig = start.summarize(data, final, lambda sigma: trusted.rig_covariance())
        cameras = {}
        for name, before, after, known_of in zip(
            start.cameras, state.lenses, final.lenses, trusted.lenses, strict=True
        ):
            result = with_values(fits[name].result, parameter_values(before, _names(fits[name])))
            if final is not state:
                result = with_values(
                    result,
                    parameter_values(after, _names(fits[name])),
                    least_squares_rms_px=rms_px(result.adjusted.residual),
                )
            cameras[name] = _camera(fits[name], result, known_of, options)
    except FisheyeSvpError:
        return None, [], {}
    rig = rig._replace(lenses=tuple(cameras[name].lens for name in rig.cameras))
    return rig, [*notes, *rig_warnings(rig, table, lenses)], cameras


def _names(fit: _Fit) -> tuple[str, ...]:
    return fit.result.adjusted.names


def _related(
    fits: Mapping[str, _Fit], lenses: Mapping[str, Lens]
) -> tuple[Observations, dict[str, Lens], tuple[str, ...], list[str]]:
    """Return table and lenses of all cameras, the largest group of related ones, and notes.

    Raises ObservationError where no frame holds two cameras together.
    """
    table, _ = posable_observations(join_tables([fit.rows for fit in fits.values()]), lenses)
    groups = connected_cameras(table)
    largest = max(groups, key=len)
    notes = [unrelated_cameras(group, largest) for group in groups if group != largest]
    if len(largest) < 2:
        raise ObservationError('; '.join(notes))
    return table, dict(lenses), rig_cameras(largest) or largest, notes


def _rig_of_lenses(
    fits: Mapping[str, _Fit], cameras: Mapping[str, CalibratedCamera]
) -> tuple[RigCalibration | None, list[str]]:
    """Return a rig of lenses that were fitted one by one, and notes, or why there is none."""
    try:
        lenses = {name: camera.lens for name, camera in cameras.items()}
        table, lenses, group, notes = _related(fits, lenses)
        rig = calibrate_rig(table, lenses, group)
    except FisheyeSvpError as cause:
        return None, [f'{cause}']
    return rig, [*notes, *rig_warnings(rig, table, lenses)]


def _document(camera: CalibratedCamera) -> dict[str, Any]:
    """Return what scripts may want beside the lens itself; its errors are those of the lens."""
    adjusted = camera.result.adjusted
    return {
        **(camera.lens.calibration or {}),
        'left_out': camera.result.left_out,
        'beyond': camera.result.beyond,
        'sigma_px': camera.result.sigma,
        'wrong_landmarks': [landmark.to_dict() for landmark in camera.outliers.landmarks],
        'parameters': dict(
            zip(adjusted.names, parameter_values(adjusted.lens, adjusted.names), strict=True)
        ),
        'admissible': {name: asdict(range_) for name, range_ in camera.trust.admissible.items()},
        'warnings': list(calibration_warnings(camera)),
    }


def write_rig(calibration: RigCalibration, folder: Path) -> list[str]:
    """Write a rig as tools read it, its lenses apart; return what a file cannot hold."""
    save_rig(calibration.steps(), folder / 'rig.yaml', calibration.cameras)
    turns = quaternion_from_rotation(calibration.rig.rotation)
    write_json(
        folder / 'rig.json',
        {  # cameras in the first one, with covariances
            'frame': calibration.cameras[0],
            'frames': len(calibration.frame),
            'sigma_px': calibration.sigma_px,
            'left_out': list(calibration.left_out),
            'cameras': {
                name: {
                    'position': calibration.rig.position[i].tolist(),
                    'quaternion': turns[i].tolist(),
                    'covariance': calibration.covariance[i - 1].tolist() if i else None,
                    'rms_px': float(calibration.rms_px[i]),
                    'frames': int(calibration.shared[i]),
                    'board': calibration.boards[i] if calibration.boards else 0,
                }
                for i, name in enumerate(calibration.cameras)
            },
        },
    )
    write_text(folder / 'rig.urdf', transforms.urdf_text(calibration.cameras, calibration.rig))
    write_text(
        folder / 'tf_static.yaml',
        transforms.static_transforms_text(calibration.cameras, calibration.rig),
    )
    try:
        chain = kalibr.write_chain(calibration.lenses, calibration.steps())
    except FisheyeSvpError as cause:
        return [f'camchain.yaml of Kalibr is not written: {cause}']
    write_text(folder / 'camchain.yaml', chain)
    return [*filter(None, (reader_limit(lens, 'kalibr') for lens in calibration.lenses))]
