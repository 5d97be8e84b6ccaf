"""The library, `import fisheye_svp_ros as fsvp`: what commands and nodes call, on plain objects.

A lens is a `Lens`, a lens file or the name of one that comes with the package; observations are
an `Observations` table or a file that `read_observations` reads; a rig is the left camera in the
right one, or a file or folder that holds it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects import forward
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import ObservationError, ParameterError
from fisheye_svp_ros.io import lens_files
from fisheye_svp_ros.io.columns import plain_columns
from fisheye_svp_ros.io.csv_files import FramePoses
from fisheye_svp_ros.io.files import as_read
from fisheye_svp_ros.io.parameters import SWEEP, rows, with_values
from fisheye_svp_ros.io.readers import (
    check_size_given,
    check_sizes,
    read_observations,
    read_poses,
    sizes_beside,
)
from fisheye_svp_ros.io.rig_files import load_pair
from fisheye_svp_ros.io.share import typed_lens_path
from fisheye_svp_ros.io.tag_maps import TagMap, read_tag_map
from fisheye_svp_ros.library import calibration
from fisheye_svp_ros.library.calibration import CalibratedCameras, LensOptions
from fisheye_svp_ros.library.checks import (
    check_count,
    check_list,
    check_number,
    check_numbers,
    check_parameters,
    check_pose,
    check_room,
    check_size,
    check_type,
    is_at_most,
)
from fisheye_svp_ros.library.results import (
    Budgeted,
    Calibrated,
    CalibratedRig,
    Diagnosed,
    Localized,
    Simulated,
    StereoDepth,
    Swept,
)
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.planning import MAX_VIEWS
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.process import limit_threads
from fisheye_svp_ros.rectify.cameras import camera_for
from fisheye_svp_ros.rectify.maps import RANGE, Rectification, RectifiedPair, rectify_pair
from fisheye_svp_ros.scene.observations import STEREO, Observations, stereo_views
from fisheye_svp_ros.scene.rigs import BASELINE, rig
from fisheye_svp_ros.scene.table_checks import check_sigma
from fisheye_svp_ros.simulate import scenario as scenarios
from fisheye_svp_ros.simulate.scenario import Scenario
from fisheye_svp_ros.solve import stereo_calibration
from fisheye_svp_ros.solve.measured_poses import rms_px, sigma_known
from fisheye_svp_ros.solve.reliability import noise_sigma
from fisheye_svp_ros.solve.stereo_depth import epipolar_offset, triangulate
from fisheye_svp_ros.solve.table_poses import solve_table
from fisheye_svp_ros.study import budget as budgets
from fisheye_svp_ros.study import sweep as sweeps

if TYPE_CHECKING:
    from fisheye_svp_ros.optics.camera import Image, Rays

AnyLens = Lens | str | Path
AnyObservations = Observations | str | Path
AnyPoses = FramePoses | str | Path
AnyRig = Pose | str | Path
AnyTagMap = TagMap | str | Path
_ROBUST_SIGMA = 1.4826  # standard deviation over the median absolute value, of normal errors
_MAX_DISTANCE = 1e50  # m
# Called with a stage of long work and the share (0 to 1) that is done.
Progress = Callable[[str, float], None]


def silent(stage: str, done: float) -> None:
    """Report no progress."""


def load_lens(lens: AnyLens) -> Lens:
    """Return a lens from its file, or by the name of one that comes with the package.

    Raises LensError, naming file and field, for anything impossible.
    """
    if not isinstance(lens, Lens | str | Path):
        raise ParameterError(
            f'lens is of type {type(lens).__name__}; a Lens, a file or a name is needed'
        )
    return lens if isinstance(lens, Lens) else lens_files.load_lens(typed_lens_path(str(lens)))


def save_lens(lens: Lens, path: str | Path) -> None:
    """Write a lens file; raise OutputError where it cannot be written."""
    lens_files.save_lens(check_type(lens, Lens, 'lens', 'a Lens'), path)


def project(lens: AnyLens, points: Array) -> Image:
    """Project points (..., 3), m, in the camera frame; return uv (..., 2), px, and valid (...).

    Outside the domain of the lens uv is NaN.  Raises ParameterError for points of another shape.
    """
    points = _check_last_axis(3, points, 'points')
    # Beyond, squares overflow; the image is that of the direction long before.
    largest = np.abs(points).max(axis=-1, keepdims=True)
    scale = np.where(largest > _MAX_DISTANCE, largest / _MAX_DISTANCE, 1.0)
    return forward.project_corrected(load_lens(lens), points / scale)


def back_project(lens: AnyLens, uv: Array) -> Rays:
    """Return the rays of image points (..., 2), px, in the camera frame.

    origin (..., 3), m: (0, 0, s(theta)); direction (..., 3), of unit length; theta (...), rad;
    valid (...).  Raises ParameterError for points of another shape.
    """
    return forward.back_project_corrected(load_lens(lens), _check_last_axis(2, uv, 'uv'))


def _by_frame(poses: AnyPoses) -> dict[int, Pose]:
    return (poses if isinstance(poses, FramePoses) else read_poses(poses)).by_frame()


def _check_last_axis(size: int, values: Array, name: str) -> Array:
    numbers = check_numbers(values, name, f'(..., {size})')
    if numbers.shape[-1:] != (size,):
        raise ParameterError(f'{name} has the shape {numbers.shape}; (..., {size}) is needed')
    return np.where(np.isfinite(numbers), numbers, np.nan)


@limit_threads
def localize(
    observations: AnyObservations,
    lens: AnyLens,
    *,
    model_error: bool = False,
    tag_map: AnyTagMap | None = None,
    readout_time: float = 0.0,
) -> Localized:
    """Pose every frame of one camera that can be posed; no start values are needed.

    Returns frame, pose, rms_px, reasons (F,), covariance (F, 6, 6), residual (N, 2), see
    `Localized`.
    model_error: covariances with what the lens says of its own errors (`uncertainty`).
    tag_map: `tags` of `map`, or its file: where tags hang whose corners (4 id + 0 to 3) are the
    landmarks; its errors are in the covariances, and tags are rejected as wholes.
    readout_time: the longest that a rolling shutter may take from the first row to the last, s, if
    the lens does not model it: where frames have times, covariances hold what it does to a pose.
    Raises ObservationError for rows of several cameras, GeometryError where no frame can be posed,
    LensError for a lens that does not know its errors.
    """
    table, known = table_and_lens(observations, lens)
    tags, seconds = tag_map_of(tag_map), check_readout(readout_time)
    if model_error:
        from fisheye_svp_ros.diagnosis import LensErrors
        from fisheye_svp_ros.study.trust import localize_with_errors

        solved, _ = localize_with_errors(
            LensErrors.from_lens(known), table, tags, readout_time=seconds
        )
    else:
        solved = solve_table(table, ForwardModel(known), tags, readout_time=seconds)
    return Localized.from_solved(solved, len(table))


@limit_threads
def calibrate(
    observations: AnyObservations,
    model: str = 'kannala_brandt',
    image_size: tuple[int, int] | None = None,
    free: Sequence[str] | None = None,
    name: str = 'lens',
    *,
    poses: AnyPoses | None = None,
    plain: bool = False,
    progress: Progress = silent,
) -> Calibrated:
    """Fit a lens to image points of known targets, see `solve.lens_calibration.calibrate`.

    By generalized least squares, so that the lens does not bend to errors of the target; plain:
    by least squares.

    image_size: width, height, px; None: that which `detect` wrote beside a file; free: names of
    what is fitted, all by default.
    Outliers are rejected, and standard errors are honest, as those of the command.
    poses: of the flange of a robot that carried the camera; `calibration` of the lens has
    `hand_eye` then, where the camera sits in it.
    progress: called with each stage and the share that is done.
    Raises LensError for an unknown model or parameter, ParameterError for an image size that is
    none, ObservationError or GeometryError where the data do not fix a lens, ObservationError for
    rows of several cameras (`calibrate_cameras`).
    """
    table = table_of(observations)
    if len(np.unique(table.camera)) > 1:
        raise ObservationError(
            f'{table.source}: the observations hold the cameras {", ".join(table.cameras)}; use '
            'calibrate_cameras, or the rows of one'
        )
    found = _calibrate(observations, table, image_size, name, progress, model, free, poses, plain)
    camera = next(iter(found.cameras.values()))
    adjusted = camera.result.adjusted
    return Calibrated(
        camera.lens,
        tuple(adjusted.names),
        camera.trust.covariance,
        camera.result.sigma,
        camera.result.left_out,
        bool(adjusted.converged),
    )


@limit_threads
def calibrate_cameras(
    observations: AnyObservations,
    image_size: tuple[int, int] | Mapping[str, tuple[int, int]] | None = None,
    model: str = 'kannala_brandt',
    free: Sequence[str] | None = None,
    *,
    poses: AnyPoses | None = None,
    plain: bool = False,
    progress: Progress = silent,
) -> CalibratedCameras:
    """Fit the lenses of all cameras of a table and, where frames hold them together, their rig.

    Lenses and rig are of one fit, in which all cameras see the same errors of the target.
    Arguments and errors are those of `calibrate`; image_size: also by camera.  The result has
    `cameras` (by name: `lens`), `rig` (None: no frame holds two of them together) and `notes`.
    """
    table = table_of(observations)
    return _calibrate(observations, table, image_size, '', progress, model, free, poses, plain)


def _calibrate(
    observations: AnyObservations,
    table: Observations,
    image_size: tuple[int, int] | Mapping[str, tuple[int, int]] | None,
    name: str,
    progress: Progress,
    model: str,
    free: Sequence[str] | None,
    poses: AnyPoses | None,
    plain: bool,
) -> CalibratedCameras:
    """Call what the command calls, with checked arguments; name: of each lens, '': its camera."""
    if image_size is None:
        sizes = {} if isinstance(observations, Observations) else sizes_beside(Path(observations))
        if not sizes:
            raise ParameterError(
                f'{table.source}: the image size is unknown; give image_size=(width, height)'
            )
    else:
        by_camera = image_size if isinstance(image_size, Mapping) else {'': image_size}
        sizes = {camera: check_size(size, 'image_size') for camera, size in by_camera.items()}
    if missing := [camera for camera in table.cameras if not {camera, ''} & set(sizes)]:
        raise ParameterError(f'image_size has no size of camera {missing[0]!r}')
    if not isinstance(observations, Observations):
        check_size_given(str(observations), {}, sizes, 'image_size')
    options = LensOptions(
        model, free, poses=None if poses is None else _by_frame(poses), plain=plain
    )
    names = {camera: name or camera or 'lens' for camera in table.cameras}
    return calibration.calibrate_cameras(table, sizes, options, names, progress)


@limit_threads
def calibrate_stereo(
    observations: AnyObservations, left: AnyLens, right: AnyLens
) -> CalibratedRig:
    """Return the rig of the cameras `left` and `right` of a table, lenses known.

    The result has rig, covariance (6, 6), m and rad, and pose (V,) of each frame (V,).
    Raises ObservationError for a missing camera, GeometryError where the views fix no rig.
    """
    table, models = _stereo_inputs(observations, left, right)
    views = stereo_views(table)
    calibration = stereo_calibration.calibrate_stereo(*models, *views)
    residual = np.concatenate([calibration.left_residual, calibration.right_residual])
    sigma = (
        1.0
        if sigma_known(table)
        else noise_sigma(
            float(calibration.cost[0]),
            int(np.isfinite(residual).sum()),
            6 * (len(views[0].frame) + 1),
        )
    )
    return CalibratedRig(
        calibration.rig.take(0),
        sigma**2 * calibration.rig_covariance[0],
        views[0].frame,
        calibration.pose.take(0),
        rms_px(residual),
        bool(calibration.converged[0]),
    )


@limit_threads
def stereo_depth(
    observations: AnyObservations,
    left: AnyLens,
    right: AnyLens,
    rig: AnyRig,
    *,
    model_error: bool = False,
) -> StereoDepth:
    """Measure every landmark that both cameras of a rig (left in right) see, with SVP or not.

    Returns points (N, 3), m, in the right camera; frame, landmark, gap, epipolar_px (N,).
    model_error: covariances, too: of the noise (that of the lenses, or of the image points where
    that is more), and of what the lenses say of their own errors; the rig is taken as it is.
    Raises ObservationError for a missing camera, LensError for a lens that does not know its
    errors.
    """
    rig = _rig_of(rig)
    table, models = _stereo_inputs(observations, left, right)
    one, other = stereo_views(table)
    both = one.used & other.used
    known = (*models, rig, one.uv[both], other.uv[both])
    solved = triangulate(*known)
    frame = np.broadcast_to(one.frame[:, None], both.shape)
    distance = epipolar_offset(*known).distance
    covariance = None
    if model_error:
        from fisheye_svp_ros.diagnosis import LensErrors
        from fisheye_svp_ros.study.trust import depth_errors

        errors = [LensErrors.from_lens(load_lens(lens)) for lens in (left, right)]
        # Both points of a pair move the point off the curve.
        sigma = (
            float(np.median(table.sigma))
            if sigma_known(table)
            else _ROBUST_SIGMA * float(np.nanmedian(np.abs(distance))) / 2**0.5
        )
        covariance = depth_errors(errors[0], errors[1], rig, solved.points, sigma).total
    return StereoDepth(
        frame[both],
        one.landmark[both],
        solved.points,
        solved.gap,
        distance,
        covariance,
    )


def simulate_scenario(
    *,
    lens: AnyLens = Scenario.lens,
    shift_scale: float = Scenario.shift_scale,
    environment: str = Scenario.environment,
    radius: float = Scenario.radius,
    style: str = Scenario.style,
    baseline: float = Scenario.baseline,
    vergence: float = Scenario.vergence,
    poses: Sequence[float] = Scenario.poses,
    poses_file: str = Scenario.poses_file,
    trajectory_steps: int = Scenario.trajectory_steps,
    noise_px: float = Scenario.noise_px,
    seed: int = Scenario.seed,
    rig_file: str = Scenario.rig_file,
) -> Simulated:
    """Return what the cameras of a scenario see; keywords: parameters of the synthetic camera.

    radius, baseline: m; vergence: rad; poses (7 F,): x, y, z, m, and qx, qy, qz, qw of F poses
    one after the other; noise_px: standard deviation of u and of v.
    Raises ParameterError for a value that is not allowed, FisheyeSvpError for a lens, landmarks
    or poses that cannot be used.
    """
    given = dict(locals())  # all keywords, by name: the rows of Scenario
    given['lens'] = Scenario.lens if isinstance(lens, Lens) else str(lens)
    seen = scenarios.simulate_scenario(
        with_values(Scenario(), check_parameters(given, 'scenario')),
        lens=lens if isinstance(lens, Lens) else None,
    )
    return Simulated(seen.lens, seen.observations, seen.poses[-1], seen.rig)


@limit_threads
def sweep(
    over: Mapping[str, Sequence[Any]],
    *,
    synthetic_camera: Mapping[str, Any] | None = None,
    localizer: Mapping[str, Any] | None = None,
    stereo_calibrator: Mapping[str, Any] | None = None,
    stereo_depth: Mapping[str, Any] | None = None,
) -> Swept:
    """Solve the Cartesian product of lists of scenario parameters, as `fisheye-svp sweep` does.

    over: lists by parameter; synthetic_camera, ...: further parameters of each node.  The result
    has one row a scenario, pose and repetition, as the command's table.
    Raises ParameterError for an unknown parameter or a value that is not allowed.
    """
    swept = {
        f'{SWEEP}{name}': check_list(values, f'over[{name!r}]')
        for name, values in check_type(over, Mapping, 'over', 'a mapping of lists').items()
    }
    given = {
        'synthetic_camera': synthetic_camera,
        'localizer': localizer,
        'stereo_calibrator': stereo_calibrator,
        'stereo_depth': stereo_depth,
    }
    nodes = {node: values for node, values in given.items() if values is not None}
    parameters = {node: check_parameters(values, node) for node, values in nodes.items()}
    parameters[sweeps.CAMERA] = {**parameters.get(sweeps.CAMERA, {}), **swept}
    for node, values in parameters.items():
        _check_names(node, values)
    plan = sweeps.plan_sweep(parameters)
    if idle := sweeps.idle_solvers(plan, nodes):
        raise ParameterError(f'{idle[0]}; choose that, or leave it out')
    return Swept(plain_columns(sweeps.sweep_rows(plan, range(len(plan.sweep)))))


@limit_threads
def diagnose(
    observations: AnyObservations,
    lens: AnyLens,
    *,
    free_intrinsics: bool | None = None,
    held_out: AnyObservations | None = None,
    against: AnyObservations | None = None,
    poses: AnyPoses | None = None,
    with_: Sequence[str] = (),
    without: Sequence[str] = (),
    next: int = 0,
    number: str | None = None,
    room: tuple[float, float] | None = None,
    progress: Progress = silent,
) -> Diagnosed:
    """Find what a lens's simulation gets wrong about observations, and extend it.

    free_intrinsics: whether they are to be fitted, by default where a fit made the lens;
    held_out: other frames of the same camera and target to measure the gain on; against: of the
    same camera with another target or of another day, where causes of the lens must hold, too;
    poses: of the camera, or of the flange of a robot that carries it, which the data tell apart;
    `with_`, without: names of effects that are known to be there, or not to be;
    next: how many photographs to take next are listed in `document['next']`, those that separate
    the causes best; number, room: as in `plan`, by default what is unclear, and the distances of
    the observations;
    progress: called with each stage and the share that is done.
    Raises GeometryError or ObservationError where the data cannot be solved at all,
    ParameterError for an unknown effect, or one that is both; with next, GeometryError for a
    target that is not one flat board.
    """
    from fisheye_svp_ros.diagnosis import DiagnosisOptions, diagnose_against
    from fisheye_svp_ros.diagnosis import diagnose as find_causes
    from fisheye_svp_ros.planning.optimal_design import ViewLimits
    from fisheye_svp_ros.planning.plan import check_parameter_name as check_number_known
    from fisheye_svp_ros.planning.plan import next_photographs
    from fisheye_svp_ros.reporting.diagnosis_document import diagnosis_document
    from fisheye_svp_ros.solve.measured_poses import poses_by_frame, usable_observations
    from fisheye_svp_ros.solve.rig_state import free_parameters

    included, left_out = (
        tuple(map(str, check_list(names, name)))
        for name, names in (('with_', with_), ('without', without))
    )
    if both := [name for name in included if name in left_out]:
        raise ParameterError(f'{both[0]!r} is in with_ and in without; remove one of them')
    options = DiagnosisOptions(included, left_out)
    count = check_count(next, MAX_VIEWS, 'next') if next else 0
    limits = None if room is None else ViewLimits(*check_room(room))
    table, known = table_and_lens(observations, lens)
    table, test = usable_observations(table, known).observations, None
    if held_out is not None:
        test = usable_observations(*table_and_lens(held_out, known)).observations
    given = None if poses is None else poses_by_frame(table, _by_frame(poses), 'poses')
    if count and number is not None:  # before the work
        check_number_known(number, table, known, free_parameters({'': known}, free_intrinsics))
    settings: dict[str, Any] = {
        'free_intrinsics': free_intrinsics,
        'held_out': test,
        'poses': given,
        'options': options,
        'progress': progress,
    }
    if against is None:
        found = find_causes(table, known, **settings)
    else:
        other = usable_observations(*table_and_lens(against, known)).observations
        found = diagnose_against(table, other, known, **settings)
    document = diagnosis_document(found)
    if count:
        after = found.evaluation.fixed_model
        wanted = next_photographs(after, found.causes, found.noise_px, count, number, limits)
        document['next'] = wanted.to_list()
    return Diagnosed(found.verdict, as_read(document), found.lens)


@limit_threads
def budget(
    lens: AnyLens, *, noise_px: float = 0.3, style: str = 'parallel', baseline: float = BASELINE
) -> Budgeted:
    """Tabulate what SVP costs and what noise does, by spread and range of the landmarks.

    Returns spreads (A,), rad, ranges (R,), m, and by quantity error and noise (A, R), SI and px.
    style, baseline (m): of the stereo rig.
    Raises LensError for a lens without a viewpoint shift, ParameterError for impossible noise.
    """
    noise = check_number(noise_px, 'noise_px', 'a number of px')
    width = check_number(baseline, 'baseline', 'a number of m')
    setup = budgets.Setup(load_lens(lens), rig(style, width), noise)
    return Budgeted(*budgets.make_budget(setup))


def undistort_maps(
    lens: AnyLens,
    projection: str = 'pinhole',
    *,
    size: tuple[int, int] | None = None,
    field_of_view: float | None = None,
    range_m: float = RANGE,
) -> Rectification:
    """Return what maps photographs to an ideal camera: `maps` for cv2.remap, `k`, `p`, `remap`.

    maps: u and v (H, W), px, of each pixel of the new image; k (3, 3), p (3, 4).
    projection: pinhole, cylindrical, equirectangular or fisheye (equidistant); size: width,
    height, px; field_of_view: over the width, rad; range_m: where the maps are exact, if the
    viewpoint of the lens moves.
    Raises ParameterError for what no such camera has.
    """
    lens = load_lens(lens)
    view = _check_view(size, field_of_view, range_m)
    return Rectification(lens, camera_for([lens], projection, *view), range_m)


def rectify_maps(
    left: AnyLens,
    right: AnyLens,
    rig: AnyRig,
    projection: str = 'pinhole',
    *,
    size: tuple[int, int] | None = None,
    field_of_view: float | None = None,
    range_m: float = RANGE,
) -> RectifiedPair:
    """Return what maps both photographs of a rig (the left camera in the right one) to rows.

    Its `left` and `right` are as of `undistort_maps`; a point at range_m, from the middle of the
    baseline, is in the same row of both.
    Raises ParameterError as `undistort_maps` does, GeometryError for cameras that do not stand
    side by side.
    """
    lenses = load_lens(left), load_lens(right)
    view = _check_view(size, field_of_view, range_m)
    camera = camera_for(lenses, projection, *view, along_baseline=True)
    return rectify_pair(*lenses, _rig_of(rig), camera, range_m)


def _rig_of(rig: AnyRig) -> Pose:
    """Return the left camera in the right one, read where a path is given."""
    return load_pair(rig, STEREO) if isinstance(rig, str | Path) else check_pose(rig, 'rig')


def _check_view(
    size: tuple[int, int] | None, field_of_view: float | None, range_m: float
) -> tuple[tuple[int, int] | None, float | None]:
    if field_of_view is not None and not is_at_most(field_of_view, 2 * np.pi):
        raise ParameterError(f'field_of_view is {field_of_view!r}; rad are needed')
    if not is_at_most(range_m, np.inf):
        raise ParameterError(f'range_m is {range_m!r}; m are needed')
    return None if size is None else check_size(size, 'size'), field_of_view


def _check_names(node: str, values: Mapping[str, Any]) -> None:
    known = [row.name for row in rows(sweeps.TABLES[node])]
    for name in (given.removeprefix(SWEEP) for given in values):
        if name not in known:
            raise ParameterError(
                f'{name!r} is not a parameter of {node}; choose from {", ".join(known)}'
            )


def table_of(given: AnyObservations) -> Observations:
    """Return a table, read where a path is given; raise ParameterError for what is neither."""
    if not isinstance(given, Observations | str | Path):
        raise ParameterError(
            f'observations are of type {type(given).__name__}; a table or a path is needed'
        )
    return check_sigma(given) if isinstance(given, Observations) else read_observations(given)


def tag_map_of(given: AnyTagMap | None) -> TagMap | None:
    """Return a map of tags, read where a path is given."""
    if given is None or isinstance(given, TagMap):
        return given
    if not isinstance(given, str | Path):
        raise ParameterError(
            f'tag_map is of type {type(given).__name__}; a map of tags or its file is needed'
        )
    return read_tag_map(given)


def check_readout(seconds: float) -> float:
    """Return the time of a readout, s; raise ParameterError for one that cannot be."""
    value = check_number(seconds, 'readout_time', 'a number of s')
    if not 0 <= value <= 1:
        raise ParameterError(f'readout_time is {value!r}; 0 to 1 s are needed')
    return value


def check_images(given: AnyObservations, lenses: Mapping[str, Lens]) -> None:
    """Raise LensError where `detect` found images of another size than the lens of a camera."""
    if not isinstance(given, Observations):
        check_sizes(str(given), {}, lenses)


def table_and_lens(given: AnyObservations, lens: AnyLens) -> tuple[Observations, Lens]:
    """Return a table and the lens of all its cameras; raise LensError as `check_images` does."""
    table, known = table_of(given), load_lens(lens)
    check_images(given, dict.fromkeys(table.cameras, known))
    return table, known


def _stereo_inputs(
    observations: AnyObservations, left: AnyLens, right: AnyLens
) -> tuple[Observations, tuple[ForwardModel, ForwardModel]]:
    table = table_of(observations)
    lenses = {'left': load_lens(left), 'right': load_lens(right)}
    check_images(observations, lenses)
    return table, (ForwardModel(lenses['left']), ForwardModel(lenses['right']))
