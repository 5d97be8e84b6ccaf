"""From photographs to observations: every photograph searched, the odd ones named.

How thoroughly, those before it have shown.  A chessboard is mostly found at a first look.  All
that follows where it is not takes ten times as long, and is put off until some photograph shows
the board; a few are searched thoroughly at once.  Boards whose dark squares are bright are found
at a first look at the inverted image.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.detect.finders import (
    FIRST_LOOKS,
    NO_TAGS,
    TagReport,
    default_detector,
    invert_image,
    report_tags,
)
from fisheye_svp_ros.detect.order import Agreement, agree, board_residuals, of_rig, turn_field
from fisheye_svp_ros.detect.patterns import LOOSE_TAGS, Pattern, Turn, check_of_board
from fisheye_svp_ros.detect.photographs import Photograph, Pixels, caught_stderr, exif_turned
from fisheye_svp_ros.detect.points import (
    SATURATED_SHARE,
    Points,
    eight_bit,
    find_points,
    full_scale_share,
    goes_on,
)
from fisheye_svp_ros.detect.rig_photographs import Pairing, pair_photographs, stamp_of
from fisheye_svp_ros.detect.tag_grids import common_layout
from fisheye_svp_ros.detect.tags import known_points
from fisheye_svp_ros.detect.workers import TimedOut, bounded_map
from fisheye_svp_ros.errors import FisheyeSvpError, ObservationError
from fisheye_svp_ros.io.files import read_bytes
from fisheye_svp_ros.io.tag_maps import tags_of
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Observations, make_observations
from fisheye_svp_ros.solve.lens_calibration import calibrate

_FIRST_ONES, _ONE_OF = 3, 24  # photographs that are searched thoroughly in any case
SECONDS = 30.0  # a photograph
_BLUR_LIMITS = 1.5  # times the median blur, and px
_STANDSTILL_PX = 0.3  # px
_MIN_RIG_FRAMES = 3  # frames of two cameras that say how they stand
_FREE = ('fx', 'fy', 'cx', 'cy', 'k1', 'k2', 'k3', 'k4', 'e0')
_ROTATION_NOTE = 'its orientation tag asks for a rotation; the pixels are used as stored'
LARGER_BOARD = 'the board is larger: its squares continue beyond the given corners'
_OTHER_LAYOUT = 'its tags are printed or numbered otherwise than in most photographs'
_DAMAGE_NOTE = 'damaged: the JPEG decodes only in part; copy it again'


class Look(Enum):
    """What is done with a photograph; SAMPLE: thorough, and whether the board is inverted."""

    FIRST_SEARCH = 'first'
    SAMPLE = 'sample'
    THOROUGH = 'thorough'
    INVERTED_IMAGE = 'inverted'


class Effort:
    """The looks at photographs, one after the other."""

    def __init__(self, has_first_look: bool) -> None:
        """Take whether a detector has a first look; others are always thorough."""
        self._has_first_look = has_first_look
        self._found = self._inverted = 0

    @property
    def has_found_board(self) -> bool:
        """Whether any photograph showed the board."""
        return self._found > 0

    def note(self, has_board: bool, inverted: bool) -> None:
        """Take note of what a photograph has shown."""
        self._found += has_board
        self._inverted += inverted

    def look(self, number: int, repeatable: bool) -> Look:
        """Return how to look at a photograph; repeatable: it can be read once more."""
        if not self._has_first_look:
            return Look.THOROUGH
        if self.has_found_board:
            return Look.INVERTED_IMAGE if self._inverted == self._found else Look.THOROUGH
        sample = number < _FIRST_ONES or number % _ONE_OF == 0 or not repeatable
        return Look.SAMPLE if sample else Look.FIRST_SEARCH


@dataclass(frozen=True, eq=False)
class SearchedPhotograph:
    """One photograph after the search; points: None where there is no board, `reason` says why.

    notes: what is odd about it; bright: share of the board's pixels at the end of the scale;
    inverted: what is dark in print is bright; tags: how many there are.
    """

    name: str
    key: str
    camera: str
    t: float
    size: tuple[int, int] = (0, 0)
    points: Points | None = None
    reason: str = ''
    notes: tuple[str, ...] = ()
    bright: float = 0.0
    digest: str = ''
    inverted: bool = False
    tags: TagReport = NO_TAGS


class Detection(NamedTuple):
    """observations of all photographs with a board; searched: all of them, in their order.

    frame of each is that of its row in `frames` (S,), -1 without a board; image_sizes: width,
    height of each camera; certainty (S,): of the order of corners, 1 where the board tells it, NaN
    unknown; pairing: of photographs of one moment.
    """

    observations: Observations
    searched: tuple[SearchedPhotograph, ...]
    frames: Index
    image_sizes: dict[str, tuple[int, int]]
    certainty: Array
    pairing: Pairing

    def __repr__(self) -> str:
        count = sum(photo.points is not None for photo in self.searched)
        return (
            f'Detection(board in {count} of {len(self.searched)} photographs, {self.observations})'
        )

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height, px, of the first camera's images."""
        return next(iter(self.image_sizes.values()))


class _Task(NamedTuple):
    photograph: Photograph
    pattern: Pattern
    detector: str
    look: Look = Look.THOROUGH


def detect(
    photographs: Iterable[Photograph],
    pattern: Pattern,
    detector: str = '',
    progress: Callable[[], object] = lambda: None,
    source: str = 'photographs',
    sync: float | None = None,
) -> Detection:
    """Search photographs for a board, in processes of their own, SECONDS at most for each.

    progress is called after each; sync: see `pairing.pair_photographs`.  Raises ObservationError
    where no photograph shows the board.
    """
    detector = detector or default_detector(pattern)
    effort, begun = Effort(detector in FIRST_LOOKS), list[_Task]()
    results: dict[int, SearchedPhotograph] = {}

    def tasks() -> Iterator[_Task]:
        for number, photograph in enumerate(photographs):
            repeatable = isinstance(photograph.data, Path)
            look = effort.look(number, repeatable)
            # Pixels of a video would fill the memory.
            kept = photograph if repeatable else replace(photograph, data=b'')
            begun.append(_Task(kept, pattern, detector, look))
            yield begun[-1]._replace(photograph=photograph)

    def search(todo: Iterable[_Task], numbers: Sequence[int] | None = None) -> None:
        for index, result in bounded_map(examine, todo, SECONDS):
            number = index if numbers is None else numbers[index]
            if isinstance(result, TimedOut):
                photo = begun[number].photograph
                why = (
                    f'no board within {SECONDS:g} s' if result.timed_out else 'the search crashed'
                )
                result = SearchedPhotograph(
                    photo.name, photo.key, photo.camera, photo.t, reason=why
                )
            results[number] = result
            effort.note(result.points is not None, result.inverted)
            if numbers is None:
                progress()

    search(tasks())
    postponed = [
        number
        for number, task in enumerate(begun)
        if task.look is Look.FIRST_SEARCH and results[number].points is None
    ]
    if effort.has_found_board:
        search(
            (begun[number]._replace(look=effort.look(number, True)) for number in postponed),
            postponed,
        )
    if pattern.kind == 'aprilgrid':
        search(*_by_common_layout(begun, results))
    searched = _add_notes(_of_cameras(_one_size([results[number] for number in sorted(results)])))
    if not any(photo.points for photo in searched):
        reasons = Counter(photo.reason.partition(';')[0] for photo in searched).most_common(2)
        said = ', '.join(f'{reason} ({count})' for reason, count in reasons)
        raise ObservationError(
            f'{source}: no {pattern.spec} in {len(searched)} '
            f'photograph{"s" * (len(searched) > 1)}: {said}; {check_of_board(pattern)}'
        )
    return _table(*_moments(searched, sync), pattern, source)


def _by_common_layout(
    begun: Sequence[_Task], results: dict[int, SearchedPhotograph]
) -> tuple[list[_Task], list[int]]:
    """Return which photographs of an AprilGrid to search again, with the layout of most.

    Results with points of another layout are left out, since these are other landmarks.
    """
    layout = common_layout([photo.tags.layouts for photo in results.values()])
    again = list[int]()
    for number, photo in results.items():
        own = photo.points.grid.layout if photo.points and photo.points.grid else None
        if layout is None or not photo.tags.layouts or own == layout:
            continue
        if layout in photo.tags.layouts and isinstance(begun[number].photograph.data, Path):
            again.append(number)
        elif own is not None or layout not in photo.tags.layouts:
            results[number] = replace(photo, points=None, reason=_OTHER_LAYOUT)
    return [
        begun[i]._replace(pattern=begun[i].pattern.with_layout(layout)) for i in again if layout
    ], again


def _moments(
    searched: tuple[SearchedPhotograph, ...], sync: float | None
) -> tuple[tuple[SearchedPhotograph, ...], Pairing]:
    """Return photographs with the time that their names say, and equal keys for one moment."""
    t = np.array([photo.t for photo in searched])
    stamps = [stamp for photo in searched if (stamp := stamp_of(photo.key)) is not None]
    if len(stamps) == len(searched) and np.isnan(t).all():
        searched = tuple(
            replace(photo, t=stamp / 1e9) for photo, stamp in zip(searched, stamps, strict=True)
        )
        # Numbers of s since 1970 are no finer than a quarter of a microsecond.
        t = np.array([stamp - min(stamps) for stamp in stamps]) / 1e9
    pairing = pair_photographs(
        [photo.key for photo in searched], [photo.camera for photo in searched], t, sync
    )
    return tuple(
        replace(photo, key=key) for photo, key in zip(searched, pairing.keys, strict=True)
    ), pairing


def examine(task: _Task) -> SearchedPhotograph:
    """Search one photograph; what is wrong with it becomes its reason."""
    photograph, pattern = task.photograph, task.pattern
    blank = SearchedPhotograph(photograph.name, photograph.key, photograph.camera, photograph.t)
    try:
        with caught_stderr() as said:
            pixels = photograph.pixels()
        notes = (_ROTATION_NOTE,) if _is_rotated(photograph) else ()
        if any(line.startswith('Corrupt JPEG') for line in said):
            notes = (*notes, _DAMAGE_NOTE)
        points, inverted = _look(pixels, task)
        if pattern.kind == LOOSE_TAGS and isinstance(points, Points):
            points = known_points(points, pattern)
        grid = points.grid if isinstance(points, Points) else None
        tags = report_tags(eight_bit(pixels), pattern, grid)
    except (FisheyeSvpError, cv2.error, MemoryError) as cause:
        text = str(cause).removeprefix(f'{photograph.name}: ')
        return replace(blank, reason=text.splitlines()[0] if text else 'not enough memory')
    blank = replace(blank, size=(int(pixels.shape[1]), int(pixels.shape[0])), tags=tags)
    if isinstance(points, str):
        return replace(blank, reason=points, notes=notes)
    if points.grid is not None and points.grid.others:
        notes = (*notes, f'{points.grid.others} tags of another grid are left out')
    if pattern.kind == 'chessboard' and goes_on(pixels, points, pattern):
        notes = (*notes, LARGER_BOARD)
    digest = hashlib.sha1(pixels.tobytes()).hexdigest()
    return replace(
        blank,
        points=points,
        notes=notes,
        digest=digest,
        inverted=inverted,
        bright=full_scale_share(pixels, points.uv),
    )


def _look(pixels: Pixels, task: _Task) -> tuple[Points | str, bool]:
    """Return what `find_points` does, and whether the board is found inverted alone."""
    _, pattern, detector, look = task
    if look is Look.FIRST_SEARCH:
        return find_points(pixels, pattern, detector, finder=FIRST_LOOKS[detector]), False
    if look is Look.INVERTED_IMAGE:
        points = find_points(pixels, pattern, detector, finder=invert_image(FIRST_LOOKS[detector]))
        if isinstance(points, Points):
            return points, True
    points = find_points(pixels, pattern, detector)
    if look is not Look.SAMPLE or isinstance(points, str):
        return points, False
    own, inverted = (
        find_points(pixels, pattern, detector, finder=finder)
        for finder in (FIRST_LOOKS[detector], invert_image(FIRST_LOOKS[detector]))
    )
    return points, isinstance(own, str) and isinstance(inverted, Points)


def _is_rotated(photograph: Photograph) -> bool:
    data = photograph.data
    if isinstance(data, Path):
        data = read_bytes(data, ObservationError)
    return isinstance(data, bytes) and exif_turned(data)


def _one_size(searched: list[SearchedPhotograph]) -> list[SearchedPhotograph]:
    """Leave out boards in photographs of another size than most with a board of their camera."""
    sizes = {
        camera: Counter(
            photo.size for photo in searched if photo.camera == camera and photo.points
        )
        for camera in {photo.camera for photo in searched}
    }
    usual = {camera: count.most_common(1)[0][0] for camera, count in sizes.items() if count}
    return [
        photo
        if not photo.points or photo.size == usual[photo.camera]
        else replace(
            photo,
            points=None,
            reason='is {}x{} px; the others are {}x{}'.format(*photo.size, *usual[photo.camera]),
        )
        for photo in searched
    ]


def _of_cameras(searched: list[SearchedPhotograph]) -> list[SearchedPhotograph]:
    """Leave out boards in photographs of no camera where others are of one."""
    cameras = sorted({photo.camera for photo in searched if photo.camera and photo.points})
    reason = (
        f'of no camera, others are of {", ".join(cameras)}; put it into a folder of its camera'
    )
    return [
        replace(photo, points=None, reason=reason)
        if cameras and photo.points and not photo.camera
        else photo
        for photo in searched
    ]


def _add_notes(searched: list[SearchedPhotograph]) -> tuple[SearchedPhotograph, ...]:
    """Leave out copies; name photographs that are blurred, burnt out or from the same place."""
    blur = float(np.median([photo.points.blur for photo in searched if photo.points] or [0.0]))
    done: list[SearchedPhotograph] = []
    for photo in searched:
        if photo.points is None:
            done.append(photo)
            continue
        notes = list(photo.notes)
        if photo.points.blur > max(_BLUR_LIMITS, _BLUR_LIMITS * blur):
            notes.append(f'blurred by {photo.points.blur:.1f} px')
        if photo.bright > SATURATED_SHARE:
            notes.append(f'over-exposed: {100 * photo.bright:.0f} % of the board at full scale')
        for other in (o for o in done if o.points is not None and o.camera == photo.camera):
            if photo.digest == other.digest:
                photo = replace(photo, points=None, reason=f'a copy of {other.name}')
                break
            if photo.key == other.key:
                photo = replace(
                    photo,
                    points=None,
                    reason=(
                        f'the same frame as {other.name}, by name or stamp; rename or remove it'
                    ),
                )
                break
            if _is_same_moment(photo, other):
                notes.append(f'from the same viewpoint as {Path(other.name).name}')
                break
        done.append(replace(photo, notes=tuple(notes)))
    return tuple(done)


def _is_same_moment(photo: SearchedPhotograph, other: SearchedPhotograph) -> bool:
    a, b = photo.points, other.points
    if a is None or b is None:
        return False
    _, mine, theirs = np.intersect1d(a.ids, b.ids, return_indices=True)
    return len(mine) > 3 and float(np.abs(a.uv[mine] - b.uv[theirs]).max()) < _STANDSTILL_PX


def _table(
    searched: tuple[SearchedPhotograph, ...], pairing: Pairing, pattern: Pattern, source: str
) -> Detection:
    keys = sorted({photo.key for photo in searched}, key=[o.key for o in searched].index)
    number = {key: i for i, key in enumerate(keys)}
    cameras = tuple(sorted({photo.camera for photo in searched if photo.points}))
    with_board = [photo for photo in searched if photo.points is not None]
    certainty = np.ones(len(searched))
    if len(pattern.symmetries) > 1:
        with_board, sure = _agree_on_order(with_board, pattern, cameras, number, source)
        certainty[[photo.points is not None for photo in searched]] = sure
        again = iter(with_board)
        searched = tuple(next(again) if photo.points is not None else photo for photo in searched)
    frames = np.array([number[photo.key] if photo.points else -1 for photo in searched])
    observations = _observations(with_board, pattern, cameras, number, source)
    sizes = {
        name: next(photo.size for photo in with_board if photo.camera == name) for name in cameras
    }
    return Detection(observations, searched, frames, sizes, certainty, pairing)


def _agree_on_order(
    with_board: list[SearchedPhotograph],
    pattern: Pattern,
    cameras: tuple[str, ...],
    number: dict[str, int],
    source: str,
) -> tuple[list[SearchedPhotograph], Array]:
    """Return the photographs with their corners in one order, and how sure that is."""
    table = _observations(with_board, pattern, cameras, number, source)
    field = np.full((len(with_board), len(pattern.points), 2), np.nan)
    poses = Pose(np.full((len(with_board), 3, 3), np.nan), np.full((len(with_board), 3), np.nan))
    for camera, name in enumerate(cameras):
        mine = {number[photo.key]: i for i, photo in enumerate(with_board) if photo.camera == name}
        size = next(photo.size for photo in with_board if photo.camera == name)
        try:
            # With a viewpoint shift, lest that be taken for the board's errors.
            fitted = calibrate(table.take(table.camera == camera), 'kannala_brandt', size, _FREE)
        except FisheyeSvpError:
            continue
        views = fitted.views
        for view, frame in enumerate(views.frame.tolist()):
            used = views.used[view]
            field[mine[frame], views.landmark[view, used]] = board_residuals(
                views.points[view, used, :2],
                views.uv[view, used],
                fitted.adjusted.residual[view, used],
            )
            for whole, part in zip(poses, fitted.adjusted.pose, strict=True):
                whole[mine[frame]] = part[view]
    seen = np.isfinite(field).any(axis=(1, 2))
    sure = np.full(len(with_board), np.nan)
    if seen.sum() < 3:
        return with_board, sure
    leader, own = _order_by_left(with_board, cameras, poses, pattern)
    together = np.zeros_like(field)
    for i in np.flatnonzero(seen):
        together[leader[i]] += np.nan_to_num(turn_field(field[i], pattern.symmetries[own[i]]))
    leaders = np.unique(leader[seen])
    agreement: Agreement = agree(together[leaders], pattern.symmetries)
    done = list(with_board)
    for i in np.flatnonzero(seen):
        at = np.searchsorted(leaders, leader[i])
        points, sure[i] = with_board[i].points, agreement.certainty[at]
        assert points is not None
        for turn in (own[i], agreement.turn[at]):
            points = _turned_points(points, pattern.symmetries[turn])
        done[i] = replace(with_board[i], points=points)
    return done, sure


def _order_by_left(
    with_board: list[SearchedPhotograph], cameras: tuple[str, ...], poses: Pose, pattern: Pattern
) -> tuple[Index, Index]:
    """Return with which photograph (S,) each one is turned, and how it is turned to fit that.

    Those of a rig go with the first camera's of the same moment, all others by themselves.
    """
    leader, own = np.arange(len(with_board)), np.zeros(len(with_board), dtype=int)
    posed = set(np.flatnonzero(np.isfinite(poses.position).all(axis=1)).tolist())
    first = {with_board[i].key: i for i in posed if with_board[i].camera == cameras[0]}
    for name in cameras[1:]:
        mine = np.array(
            sorted(
                i for i in posed if with_board[i].camera == name and with_board[i].key in first
            ),
            dtype=int,
        )
        theirs = np.array([first[with_board[i].key] for i in mine], dtype=int)
        turns = (
            of_rig(poses.take(theirs), poses.take(mine), pattern.points[:, :2], pattern.symmetries)
            if len(mine) >= _MIN_RIG_FRAMES
            else None
        )
        if turns is not None:
            leader[mine], own[mine] = theirs, turns
    return leader, own


def _turned_points(points: Points, turn: Turn) -> Points:
    where = np.argsort(turn.source)
    order = np.argsort(where[points.ids], kind='stable')
    return points._replace(
        ids=where[points.ids][order],
        uv=points.uv[order],
        sigma=points.sigma[order],
        reach=points.reach[order],
    )


def _observations(
    with_board: list[SearchedPhotograph],
    pattern: Pattern,
    cameras: tuple[str, ...],
    number: dict[str, int],
    source: str,
) -> Observations:
    points = [photo.points for photo in with_board if photo.points is not None]
    count = [len(part.ids) for part in points]
    index = np.concatenate([part.ids for part in points])

    def column(values: list[float]) -> Array:
        return np.repeat(np.array(values, dtype=float), count)

    t = [photo.t for photo in with_board]
    table = make_observations(
        column([number[photo.key] for photo in with_board]).astype(np.int64),
        index,
        np.concatenate([part.uv for part in points]),
        pattern.points[index],
        camera=column([cameras.index(photo.camera) for photo in with_board]).astype(np.int64),
        t=column(t if np.isfinite(t).all() else [np.nan] * len(t)),
        cameras=cameras,
        source=source,
        sigma=np.concatenate([part.sigma for part in points]),
        board=tags_of(index) if pattern.kind == LOOSE_TAGS else None,
    )
    return replace(
        table,
        photographs=tuple((number[photo.key], photo.camera, photo.name) for photo in with_board),
    )
