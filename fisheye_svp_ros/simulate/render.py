"""Photographs of a board, or of several, as a lens with a moving viewpoint takes them.

Each pixel's own ray, with its origin on the axis, is met with the board, which may be bowed; what
is printed there is averaged over the pixel exactly for straight edges.  Blur, vignetting, gain,
noise, rolling shutter and errors of the print are what a camera and a printer add.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.forward import back_project_corrected, project_corrected
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.optics.camera import Rays
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, identity, rotation_from_vector

_MAX_BLUR, _MAX_NOISE = 100.0, 255.0  # px, gray levels
_SAMPLES = 3  # samples along each side of a pixel
_ROUNDS = 6  # to meet a bowed board
_DARK, _BRIGHT, _ROOM = 0.08, 0.85, 0.30  # reflectance of ink, paper, what is behind
_EDGE_WIDTH = 0.75  # pixels around an edge that may see it: a half, and what bends
_SHEET_MARGIN = 12.0  # px around the sheet that may see it once it is moved
_CHUNK = 200_000  # pixels whose rays are computed at once

Field = Callable[[Array], Array]  # of places (..., 2), m, on a board


class Drawing(NamedTuple):
    """What else than a chessboard is printed: points (N, 2) and the ends (2,) of it, squares.

    ink: share (...) of ink in boxes about places (..., 2) and of a width (..., 2), squares.
    """

    points: Array
    low: Array
    high: Array
    ink: Callable[[Array, Array], Array]


@dataclass(frozen=True)
class Print:
    """A chessboard: columns, rows of inner corners, size of a square, m; margin of white, squares.

    drawing: what is printed in its place; bow: height (...), m, over the board's plane at places
    (..., 2), towards +z; shift: where the print of a place really is, minus that place, (..., 2),
    m.  The first inner corner is the origin, x right, y down, z into the board.
    """

    columns: int
    rows: int
    size: float
    margin: float = 0.6
    bow: Field | None = None
    shift: Field | None = None
    drawing: Drawing | None = None

    @property
    def corners(self) -> Array:
        """Nominal inner corners (N, 3), m, row by row, or the points of the drawing."""
        if self.drawing is not None:
            return np.pad(self.drawing.points, ((0, 0), (0, 1))) * self.size
        y, x = np.mgrid[: self.rows, : self.columns]
        return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1) * self.size

    @property
    def ends(self) -> tuple[Array, Array]:
        """Least and largest x and y of what is printed, (2,), squares."""
        if self.drawing is not None:
            return self.drawing.low, self.drawing.high
        return np.array([-1.0, -1.0]), np.array([self.columns, self.rows], dtype=float)

    def true_corners(self) -> Array:
        """Where the inner corners really are (N, 3), m, in the board's frame."""
        points = self.corners
        if self.shift is not None:
            points[:, :2] += self.shift(points[:, :2])
        if self.bow is not None:
            points[:, 2] = self.bow(points[:, :2])
        return points


class BoardPose(NamedTuple):
    """A board and its pose in the target: one face of a cube, one wall of a room."""

    printed: Print
    pose: Pose

    def true_corners(self) -> Array:
        """Where the inner corners really are (N, 3), m, in the target's frame."""
        return self.pose.transform(self.printed.true_corners())


@dataclass(frozen=True)
class Exposure:
    """What a camera makes of the light.

    gain: on reflectance, for a full scale of 1; blur, px, at the axis, and blur_edge, px, which
    is added (in squares) in proportion to the angle; vignetting: loss at the edge of the field;
    slope (2,): uneven light, relative change per image width; noise: of a pixel, in grey levels
    of 255, half of it shot noise at mid-grey; twist (6,), m/s and rad/s, of the camera in the
    board's frame and line_time, s: a rolling shutter, from the row in the middle.
    """

    gain: float = 1.0
    blur: float = 0.6
    blur_edge: float = 0.0
    vignetting: float = 0.3
    slope: tuple[float, float] = (0.0, 0.0)
    noise: float = 1.5
    twist: tuple[float, ...] = ()
    line_time: float = 0.0

    def __post_init__(self) -> None:
        """Raise ParameterError for a blur or noise that leaves no picture."""
        for name, most, unit in (
            ('blur', _MAX_BLUR, 'px'),
            ('blur_edge', _MAX_BLUR, 'px'),
            ('noise', _MAX_NOISE, 'gray levels'),
        ):
            if not 0 <= (value := getattr(self, name)) <= most:
                raise ParameterError(f'{name} is {value:g}; 0 to {most:g} {unit} are needed')


def render(
    lens: Lens,
    printed: Print | Sequence[BoardPose],
    camera: Pose,
    exposure: Exposure,
    rng: np.random.Generator,
    moved: Field | None = None,
    rays: Rays | None = None,
) -> NDArray[np.uint8]:
    """Return a photograph (H, W) of a board from a camera's pose in the board's frame.

    printed: also the boards of a target, in whose frame the camera is then; none may hide another.
    moved: what else moves the image of a place (..., 2), m, on the board, px (..., 2): effects
    that are not among the lens's own.  rays (H, W): `pixel_rays(lens)`, for many photographs of
    one lens.  The same rng gives the same photograph.
    """
    uv, rays = _pixel_grid(lens), pixel_rays(lens) if rays is None else rays
    theta = rays.theta
    light = np.full(theta.shape, _ROOM)
    boards = [BoardPose(printed, identity())] if isinstance(printed, Print) else printed
    window = _window(lens, boards, camera)
    part = uv[window]
    if part.size:
        parts = Rays(
            rays.origin[window], rays.direction[window], theta[window], rays.valid[window]
        )
        seen = sum(
            _of_board(lens, board, camera, exposure, part, parts, moved) for board in boards
        )
        light[window] = _lens_blur(
            np.asarray(_ROOM + seen, np.float32), theta[window], exposure, lens.max_incidence
        )
    outwards = np.nan_to_num(theta / lens.max_incidence)
    light *= exposure.gain * (1 - exposure.vignetting * outwards**2)
    light *= 1 + (uv / lens.width - 0.5) @ np.array(exposure.slope)
    light[np.isnan(theta)] = 0.0
    level = 255 * light
    scatter = exposure.noise * np.sqrt(0.5 + np.clip(level, 0, 255) / 255)
    level = np.round(level + scatter * rng.standard_normal(level.shape))
    return np.asarray(np.clip(level, 0, 255), dtype=np.uint8)


def pixel_rays(lens: Lens) -> Rays:
    """Return the rays of all pixels (H, W), camera frame."""
    return back_project_corrected(lens, _pixel_grid(lens))


def _pixel_grid(lens: Lens) -> Array:
    """Return the image points of all pixels (H, W, 2)."""
    v, u = np.mgrid[: lens.height, : lens.width].astype(float)
    return np.stack([u, v], axis=-1)


def _window(lens: Lens, boards: Sequence[BoardPose], camera: Pose) -> tuple[slice, slice]:
    """Return the rows and columns in which the sheets lie, and a little more."""
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for printed, place in boards:
        low_end, high_end = printed.ends
        first, last = low_end - printed.margin, high_end + printed.margin
        steps = np.linspace(0.0, 1.0, 25)
        sheet = np.stack(np.meshgrid(*(first + steps[:, None] * (last - first)).T), axis=-1)
        sheet *= printed.size
        height = np.zeros(sheet.shape[:2]) if printed.bow is None else printed.bow(sheet)
        points = np.concatenate([sheet, height[..., None]], axis=-1).reshape(-1, 3)
        image = project_corrected(lens, camera.into_body(place.transform(points)))
        if not image.valid.all():
            return slice(None), slice(None)
        low, high = np.minimum(low, image.uv.min(axis=0)), np.maximum(high, image.uv.max(axis=0))
    low = np.floor(low - _SHEET_MARGIN).astype(int).clip(0)
    high = np.ceil(high + _SHEET_MARGIN).astype(int).clip(0)
    return slice(low[1], high[1]), slice(low[0], high[0])


def _of_board(
    lens: Lens,
    board: BoardPose,
    camera: Pose,
    exposure: Exposure,
    uv: Array,
    rays: Rays,
    moved: Field | None,
) -> NDArray[np.float32]:
    """Return what a board adds to the light of the parts of pixels uv (H, W, 2), rays (H, W)."""
    places = _board_xy(lens, board, camera, exposure, uv, rays)
    if moved is not None:
        for _ in range(3):
            # The image of a place is moved: look where the unmoved image of what is seen lies.
            unmoved = uv - moved(_is_near_sheet(places, board.printed))
            places = _board_xy(
                lens, board, camera, exposure, unmoved, back_project_corrected(lens, unmoved)
            )
    return _sheet_reflectance(board.printed, places) - np.float32(_ROOM)


def _board_xy(
    lens: Lens, board: BoardPose, camera: Pose, exposure: Exposure, uv: Array, rays: Rays
) -> Array:
    """Return which place (H, W, 2), m, of the board is seen at uv (H, W, 2), px; NaN for none."""
    line = uv[..., 1].ravel() - (lens.height - 1) / 2
    origin, direction = rays.origin.reshape(-1, 3), rays.direction.reshape(-1, 3)
    parts = [slice(i, i + _CHUNK) for i in range(0, len(line), _CHUNK)]
    return np.concatenate(
        [
            _board_share(board, camera, exposure, line[part], origin[part], direction[part])
            for part in parts
        ]
    ).reshape(uv.shape)


def _board_share(
    board: BoardPose,
    camera: Pose,
    exposure: Exposure,
    line: Array,
    origin: Array,
    direction: Array,
) -> Array:
    """Return places (N, 2) of rays (N, 3); line (N,): rows of the image after the middle one."""
    printed = board.printed
    if exposure.line_time:
        twist = (exposure.line_time * line)[:, None] * np.array(exposure.twist)
        place = camera.position + twist[:, :3]
        turn = rotation_from_vector(twist[:, 3:]) @ camera.rotation
        origin = (turn @ origin[..., None])[..., 0] + place
        direction = (turn @ direction[..., None])[..., 0]
    else:
        origin = origin @ camera.rotation.T + camera.position
        direction = direction @ camera.rotation.T
    origin, direction = board.pose.into_body(origin), direction @ board.pose.rotation
    height: Array | float = 0.0
    with np.errstate(divide='ignore', invalid='ignore'):
        for _ in range(_ROUNDS if printed.bow is not None else 1):
            reach = (height - origin[:, 2]) / direction[:, 2]
            places = origin[:, :2] + reach[:, None] * direction[:, :2]
            if printed.bow is not None:
                height = printed.bow(_is_near_sheet(places, printed))
    # Only the printed side is seen, and only ahead.
    places[~((reach > 0) & (direction[:, 2] > 0))] = np.nan
    if printed.shift is not None:
        nominal = places
        for _ in range(3):
            nominal = places - printed.shift(_is_near_sheet(nominal, printed))
        places = nominal
    return np.asarray(places)


def _is_near_sheet(places: Array, printed: Print) -> Array:
    """Keep places (..., 2) where fields over the board are meant to be asked."""
    low, high = (np.array(end) * printed.size for end in printed.ends)
    low, high = low - printed.size, high + printed.size
    return np.clip(np.nan_to_num(places, nan=float(low[0]), posinf=0, neginf=0), low, high)


def _sheet_reflectance(printed: Print, places: Array) -> NDArray[np.float32]:
    """Return the reflectance (H, W, each times _SAMPLES) that the parts of pixels see."""
    part = places / printed.size
    by_v, by_u = np.gradient(part, axis=(0, 1))
    (vv, uv_), uu = np.gradient(by_v, axis=(0, 1)), np.gradient(by_u, axis=1)
    wide = _EDGE_WIDTH * (np.abs(by_u) + np.abs(by_v))
    # Few pixels see an edge; the others see one brightness all over.
    edge = ~(_line_distance(printed, part) > wide).all(axis=-1)
    light = np.empty((*edge.shape, _SAMPLES, _SAMPLES), np.float32)
    light[:] = np.expand_dims(_reflectance(printed, part, np.full(2, 1e-12)), (2, 3))
    part, by_u, by_v, uu, uv_, vv = (
        np.asarray(array)[edge] for array in (part, by_u, by_v, uu, uv_, vv)
    )
    steps = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
    for row, b in enumerate(steps):
        for column, a in enumerate(steps):
            sample = part + a * by_u + b * by_v + 0.5 * a * a * uu + a * b * uv_ + 0.5 * b * b * vv
            # How far, in squares, a sample reaches across lines of x and of y.
            reach = np.abs(by_u + a * uu + b * uv_) + np.abs(by_v + a * uv_ + b * vv)
            light[edge, row, column] = _reflectance(printed, sample, reach / _SAMPLES + 1e-12)
    light[~np.isfinite(light)] = _ROOM
    height, width = edge.shape
    return light.swapaxes(1, 2).reshape(_SAMPLES * height, _SAMPLES * width)


def _line_distance(printed: Print, places: Array) -> Array:
    """Return how far places (..., 2), squares, are from the nearest lines of x and of y."""
    low, high = printed.ends
    squares = np.abs(places - np.clip(np.round(places), low, high))
    if printed.drawing is not None:
        squares = np.maximum(np.maximum(low - places, places - high), 0.0)
    sheet = np.minimum(
        np.abs(places - low + printed.margin), np.abs(places - high - printed.margin)
    )
    return np.asarray(np.minimum(squares, sheet))


def _reflectance(printed: Print, places: Array, width: Array) -> Array:
    """Return the reflectance at places (..., 2), squares, averaged over a sample's width."""
    low, high = printed.ends
    if printed.drawing is not None:
        near = np.clip(np.nan_to_num(places), low - 1, high + 1)
        ink = printed.drawing.ink(near, np.nan_to_num(width, nan=1.0, posinf=1.0))
    else:
        # Brightness changes across the lines through inner corners alone.
        line = np.clip(np.round(places), 0, high - 1)
        face = np.where(line % 2 == 0, 1.0, -1.0) * np.clip(2 * (places - line) / width, -1, 1)
        ink = 0.5 + 0.5 * face[..., 0] * face[..., 1]
    squares = _covered_share(places, low, high, width)
    sheet = _covered_share(places, low - printed.margin, high + printed.margin, width)
    board = _BRIGHT + (_DARK - _BRIGHT) * ink * squares
    return np.asarray(_ROOM + (board - _ROOM) * sheet)


def _covered_share(places: Array, low: Any, high: Any, width: Array) -> Array:
    depth = np.minimum(places - low, high - places) / width
    share = np.clip(depth + 0.5, 0.0, 1.0)
    return np.asarray(share[..., 0] * share[..., 1])


def _lens_blur(light: NDArray[np.float32], theta: Array, exposure: Exposure, edge: float) -> Array:
    """Return what pixels (H, W) see of light between them: the lens blurs before they sample."""
    if not exposure.blur_edge:
        return _sample_pixels(light, exposure.blur)
    # Blur that grows outwards: between images of few blurs, by the square of the blur.
    part = np.nan_to_num(theta / edge, nan=1.0)
    square = exposure.blur**2 + (exposure.blur_edge * part) ** 2
    levels = np.linspace(exposure.blur**2, exposure.blur**2 + exposure.blur_edge**2, 6)
    place = np.clip((square - levels[0]) / (levels[1] - levels[0]), 0, len(levels) - 1 - 1e-9)
    stack = np.stack([_sample_pixels(light, float(np.sqrt(level))) for level in levels])
    lower = np.floor(place).astype(int)
    row, column = np.indices(theta.shape)
    weight = place - lower
    return np.asarray(
        (1 - weight) * stack[lower, row, column] + weight * stack[lower + 1, row, column]
    )


def _sample_pixels(light: NDArray[np.float32], blur: float) -> Array:
    if blur > 0.05:
        light = np.asarray(cv2.GaussianBlur(light, (0, 0), _SAMPLES * blur))
    height, width = (size // _SAMPLES for size in light.shape)
    parts = light.reshape(height, _SAMPLES, width, _SAMPLES)
    return np.asarray(parts.mean(axis=(1, 3), dtype=float))
