"""The library's part about boards: their image points, photographs and views; lens files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.detect.patterns import parse_pattern
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.io.lens_formats import write_foreign
from fisheye_svp_ros.library import AnyLens, load_lens, save_lens
from fisheye_svp_ros.library_checks import (
    check_count,
    check_numbers,
    check_pair,
    check_pose,
    check_whole_numbers,
    is_at_most,
)
from fisheye_svp_ros.planning import MAX_VIEWS
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Observations, make_observations

if TYPE_CHECKING:
    from fisheye_svp_ros.planning.plan import PhotographPlan


def observations(
    u: Array, v: Array, landmark: Index, board: str | Array, *, frame: Index | int = 0
) -> Observations:
    """Return a table of image points u, v (N,), px, of landmarks (N,).

    board: as in `--board`, or places (L, 3), m, of landmarks 0 to L - 1; frame (N,).
    Raises ParameterError for arrays of different lengths, image points that are not finite, and
    landmarks that are not there or twice in a frame.
    """
    places = parse_pattern(board).points if isinstance(board, str) else (
        check_numbers(board, 'board', '(L, 3)'))
    image = [np.atleast_1d(check_numbers(values, name, '(N,)'))
             for name, values in (('u', u), ('v', v))]
    number = np.atleast_1d(check_whole_numbers(landmark, 'landmark'))
    if {column.shape for column in (*image, number)} != {(len(number),)} or (
            places.shape[1:] != (3,)):
        raise ParameterError('u, v and landmark must have one length, places the shape (L, 3)')
    frames = check_whole_numbers(frame, 'frame')
    if frames.shape not in ((), (1,), number.shape):
        raise ParameterError(f'frame has the shape {frames.shape}; one number, or one for each of '
                             f'the {len(number)} points, is needed')
    frames = np.broadcast_to(frames, number.shape).copy()
    if not np.isfinite(image).all():
        raise ParameterError('u and v must be finite; leave out what was not seen')
    if not np.isfinite(places).all():
        raise ParameterError('board has places that are not finite; number only landmarks whose '
                             'place is known')
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
    if not noise >= 0:
        raise ParameterError(f'noise is {noise!r}; 0 or more grey levels are needed')
    printed = Print(pattern.columns, pattern.rows, pattern.size)
    return expose(load_lens(lens), printed, pose, Exposure(noise=noise),
                  np.random.default_rng(seed))


def plan(
    lens: AnyLens, board: str, room: tuple[float, float], *, count: int = 12,
    number: str | None = None, noise_px: float = 0.1,
) -> PhotographPlan:
    """Return which photographs to take of a board, as the command does.

    room: nearest and furthest distance, m; number: the parameter that matters most, None for the
    lens as a whole; noise_px: standard deviation of u and of v of a corner.
    Raises ParameterError for a room, count or noise that cannot be.
    """
    from fisheye_svp_ros.planning.optimal_design import ViewLimits
    from fisheye_svp_ros.planning.plan import plan as choose

    near, far = check_pair(room, 'room', '(nearest, furthest) in m')
    if not 0 < near < far < np.inf:
        raise ParameterError(f'room is {room!r}; two distances above 0, m, are needed, the nearer '
                             'first')
    count = check_count(count, MAX_VIEWS, 'count')
    if not is_at_most(noise_px, np.finfo(float).max) or not noise_px > 0:
        raise ParameterError(f'noise_px is {noise_px!r}; a number above 0 px is needed')
    return choose(load_lens(lens), parse_pattern(board).points, ViewLimits(near, far), count,
                  number, noise_px)


def write_lens(lens: AnyLens, path: str | Path, form: str = '') -> None:
    """Write a lens file, or in the form of another tool: kalibr, ros, opencv, colmap, ...

    Raises LensError for a lens that the form cannot hold to a hundredth of a pixel.
    """
    if form:
        write_text(path, write_foreign(load_lens(lens), form))
    else:
        save_lens(load_lens(lens), path)
