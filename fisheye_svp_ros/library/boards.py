"""The library's part about boards and rigs of any number of cameras; lens files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.detect.patterns import parse_pattern
from fisheye_svp_ros.errors import ObservationError, ParameterError
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.io.lens_formats import write_foreign
from fisheye_svp_ros.io.rig_files import load_cameras
from fisheye_svp_ros.library.checks import (
    check_count,
    check_number,
    check_numbers,
    check_pose,
    check_room,
    check_type,
    check_whole_numbers,
)
from fisheye_svp_ros.library.functions import (
    AnyLens,
    AnyObservations,
    AnyTagMap,
    check_images,
    check_readout,
    load_lens,
    save_lens,
    table_of,
    tag_map_of,
)
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.planning import MAX_VIEWS
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.process import limit_threads
from fisheye_svp_ros.scene.observations import Observations, make_observations
from fisheye_svp_ros.solve import rig_calibration
from fisheye_svp_ros.solve.measured_poses import posable_observations, rig_lenses
from fisheye_svp_ros.solve.rig_calibration import RigCalibration
from fisheye_svp_ros.solve.solved_poses import SolvedPoses
from fisheye_svp_ros.solve.table_poses import solve_rig_table

if TYPE_CHECKING:
    from fisheye_svp_ros.planning.plan import PhotographPlan


def observations(
    u: Array, v: Array, landmark: Index, board: str | Array, *, frame: Index | int = 0
) -> Observations:
    """Return a table of image points u, v (N,), px, of landmarks (N,).

    board: as in `--board`, or places (L, 3), m, of landmarks 0 to L - 1; frame (N,).
    Points that a mask hides in any of the arrays are left out.
    Raises ParameterError for arrays of different lengths, image points that are not finite, and
    landmarks that are not there or twice in a frame.
    """
    columns: Any = (u, v, landmark, frame)
    if any(isinstance(column, np.ma.MaskedArray) for column in columns):
        whole = np.ma.atleast_1d(*np.broadcast_arrays(*columns, subok=True))
        kept = ~np.any([np.ma.getmaskarray(column) for column in whole], axis=0)
        u, v, landmark, frame = (np.ma.getdata(column)[kept] for column in whole)
    places = (
        parse_pattern(board).points
        if isinstance(board, str)
        else (check_numbers(board, 'board', '(L, 3)'))
    )
    image = [
        np.atleast_1d(check_numbers(values, name, '(N,)')) for name, values in (('u', u), ('v', v))
    ]
    number = np.atleast_1d(check_whole_numbers(landmark, 'landmark'))
    if {column.shape for column in (*image, number)} != {(len(number),)} or (
        places.shape[1:] != (3,)
    ):
        raise ParameterError('u, v and landmark must have one length, places the shape (L, 3)')
    frames = check_whole_numbers(frame, 'frame')
    if frames.shape not in ((), (1,), number.shape):
        raise ParameterError(
            f'frame has the shape {frames.shape}; one number, or one for each of '
            f'the {len(number)} points, is needed'
        )
    frames = np.broadcast_to(frames, number.shape).copy()
    if not np.isfinite(image).all():
        raise ParameterError('u and v must be finite; leave out what was not seen')
    if not np.isfinite(places).all():
        raise ParameterError(
            'board has places that are not finite; number only landmarks whose place is known'
        )
    if len(np.unique(np.stack([frames, number]), axis=1).T) < len(number):
        raise ParameterError('a landmark is twice in a frame; frame (N,) says which photograph')
    outside = number[(number < 0) | (number >= len(places))]
    if len(outside):
        raise ParameterError(f'landmarks are 0 to {len(places) - 1}; there is {outside[0]}')
    return make_observations(frames, number, np.stack(image, axis=-1), places[number])


def render(
    lens: AnyLens, board: str, pose: Pose, *, noise: float = 2.0, seed: int = 0
) -> NDArray[np.uint8]:
    """Return a photograph (H, W) of a chessboard by a lens with its viewpoint shift.

    pose: one, of the camera in the board's frame; noise: grey levels, rms.
    Raises ParameterError for another board, several poses or a negative noise.
    """
    from fisheye_svp_ros.simulate.render import Exposure, Print
    from fisheye_svp_ros.simulate.render import render as expose

    pattern = parse_pattern(board)
    if pattern.kind != 'chessboard':
        raise ParameterError(f'board {board!r}: only chessboards can be rendered')
    pose = check_pose(pose, 'pose')
    exposure = Exposure(noise=check_number(noise, 'noise', 'a number of gray levels'))
    printed = Print(pattern.columns, pattern.rows, pattern.size)
    return expose(load_lens(lens), printed, pose, exposure, np.random.default_rng(seed))


def plan(
    lens: AnyLens,
    board: str,
    room: tuple[float, float],
    *,
    count: int = 12,
    number: str | None = None,
    noise_px: float = 0.1,
) -> PhotographPlan:
    """Return which photographs to take of a board, as the command does.

    room: nearest and furthest distance, m; number: the parameter that matters most, None for the
    lens as a whole; noise_px: standard deviation of u and of v of a corner.
    Raises ParameterError for a room, count or noise that cannot be.
    """
    from fisheye_svp_ros.planning.optimal_design import ViewLimits
    from fisheye_svp_ros.planning.plan import plan as choose

    near, far = check_room(room)
    count = check_count(count, MAX_VIEWS, 'count')
    return choose(
        load_lens(lens),
        parse_pattern(board).points,
        ViewLimits(near, far),
        count,
        number,
        check_number(noise_px, 'noise_px', 'a number of px'),
    )


def write_lens(lens: AnyLens, path: str | Path, form: str = '') -> None:
    """Write a lens file, or in the form of another tool: kalibr, ros, opencv, colmap, ...

    Raises LensError for a lens that the form cannot hold to a hundredth of a pixel.
    """
    if form:
        write_text(path, write_foreign(load_lens(lens), form))
    else:
        save_lens(load_lens(lens), path)


@limit_threads
def calibrate_rig(observations: AnyObservations, lenses: Mapping[str, AnyLens]) -> RigCalibration:
    """Fit where the cameras of a table stand, in the first of them; lenses by camera.

    A lens that states its standard errors (`calibrate`) is fitted, too, with these as its prior;
    the rig goes with the lenses of the result.
    Cameras whose views no relative pose explains as those of one target see boards of their own:
    these stand still, and the motion of the rig relates them.
    Raises ObservationError for a camera without a lens, for cameras that no frame holds to the
    others, and where no rig explains most frames; GeometryError where it is not determined.
    """
    table, known = _inputs(observations, lenses)
    table, _ = posable_observations(table, known)
    group, *others = rig_calibration.connected_cameras(table)
    if others:
        raise ObservationError(
            f'{table.source}: {" and ".join(others[0])} cannot be related to '
            f'{", ".join(group)}: no frame shows the target to both at once'
        )
    return rig_calibration.calibrate_rig(table, known, table.cameras)


@limit_threads
def localize_rig(
    observations: AnyObservations,
    lenses: Mapping[str, AnyLens],
    rig: RigCalibration | str | Path,
    *,
    tag_map: AnyTagMap | None = None,
    readout_time: float = 0.0,
) -> SolvedPoses:
    """Pose every frame from all cameras of a rig at once: its first camera in the world.

    rig: from `calibrate_rig`, or a file or folder that `calibrate` has written; tag_map,
    readout_time: as of `localize`.
    Raises ObservationError for a camera without a lens, or that the rig does not have, and
    GeometryError where no frame can be posed.
    """
    table, known = _inputs(observations, lenses)
    names, places = (
        (rig.cameras, rig.rig) if isinstance(rig, RigCalibration) else load_cameras(rig)
    )
    return solve_rig_table(
        table,
        known,
        names,
        places,
        tag_map_of(tag_map),
        readout_time=check_readout(readout_time),
    )


def _inputs(
    observations: AnyObservations, lenses: Mapping[str, AnyLens]
) -> tuple[Observations, dict[str, Lens]]:
    table = table_of(observations)
    check_type(lenses, Mapping, 'lenses', 'a mapping of cameras to lenses')
    known = {name: load_lens(lens) for name, lens in lenses.items()}
    check_images(observations, known)
    return table, rig_lenses(table, known)
