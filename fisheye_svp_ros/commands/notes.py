"""What a command has to say beside its results, on standard error."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from fisheye_svp_ros.reporting.terminal import print_note
from fisheye_svp_ros.reporting.wording.inputs import (
    points_extrapolated,
    points_mirrored,
    reader_limit,
)
from fisheye_svp_ros.reporting.wording.poses import wrong_landmark_notes
from fisheye_svp_ros.scene.observations import frame_name, list_frames
from fisheye_svp_ros.scene.table_checks import MAX_TARGET_SIZE, target_size
from fisheye_svp_ros.solve.lens_checks import extrapolated_points
from fisheye_svp_ros.solve.mirrored_points import Mirror, find_mirror

if TYPE_CHECKING:
    from fisheye_svp_ros.arrays import Array
    from fisheye_svp_ros.optics.lens import Lens
    from fisheye_svp_ros.scene.observations import Observations
    from fisheye_svp_ros.solve.outliers import Outliers, WrongLandmark

_MAX_SIMILAR_NOTES = 3  # frames whose reasons differ by numbers alone; of more, the first only
_DAY = 86_400.0  # s
_DIGITS = re.compile(r'\d')


def say(note: str) -> None:
    """Print a note."""
    print_note(note)


def note_reader_limit(lens: Lens, form: str) -> None:
    """Say it where the readers of a format end at 90 degrees, and the image of a lens does not."""
    if limit := reader_limit(lens, form):
        say(limit)


def note_extrapolated(what: str, lens: Lens, uv: Array) -> None:
    """Say it where image points uv (N, 2), px, lie beyond what is known of a lens."""
    if beyond := extrapolated_points(lens, uv):
        say(points_extrapolated(what, beyond))


def note_mirrored(what: str, lens: Lens, table: Observations) -> None:
    """Say it where the table of one camera is a mirror image of what it saw."""
    if mirror := find_mirror(table, lens):
        say(points_mirrored(what, mirror))


def note_upwards(table: Observations, lenses: Mapping[str, Lens]) -> None:
    """Say it where y of a board points up: other mirror images are flaws of a diagnosis."""
    for camera, (name, lens) in enumerate(lenses.items()):
        mine = table.take(table.camera == camera) if len(lenses) > 1 else table
        if find_mirror(mine, lens) == Mirror.Y_UPWARDS:
            say(points_mirrored(name or 'image points', Mirror.Y_UPWARDS))


def count_text(count: int, noun: str) -> str:
    """Return a number of things, one of them in the singular."""
    return f'{count} {noun}' if count == 1 else f'{count} {noun}s'


def note_formats() -> None:
    """Say it where tables come in one form only, once a day."""
    from fisheye_svp_ros.io.columns import arrow

    _, problem = arrow()
    if not problem:
        return
    home = Path(os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache')
    mark = home / 'fisheye_svp_ros' / 'no_parquet.said'
    with suppress(OSError):  # said each time where no mark can be kept
        if mark.exists() and time.time() - mark.stat().st_mtime < _DAY:
            return
        mark.parent.mkdir(parents=True, exist_ok=True)
        mark.touch()
    say(problem)


def note_left_out(table: Observations, frames: Sequence[int]) -> None:
    """Name the frames of a table that could not be posed, if there are any."""
    if frames:
        say(
            'left out, because their points do not determine a pose (all near one line, or of '
            f'another lens?): {list_frames(table, frames)}'
        )


def note_copies(table: Observations, frames: Sequence[int]) -> None:
    """Name the frames of a table that are other frames once more, if there are any."""
    if frames:
        say(
            'left out, because their image points repeat those of an earlier frame: '
            f'{list_frames(table, frames)}'
        )


def note_huge(table: Observations) -> None:
    """Ask for the unit of a target that is larger than targets are."""
    across = target_size(table)
    if across > MAX_TARGET_SIZE:
        say(f'the target is {across:.0f} m across; x, y, z must be in m, not in mm')


def note_wrong_landmarks(landmarks: Sequence[WrongLandmark], of_tags: bool = False) -> None:
    """Name landmarks, or tags, that are not where they are said to be."""
    for note in wrong_landmark_notes(landmarks, of_tags):
        say(note)


def note_gross_errors(table: Observations, gross: Outliers) -> None:
    """Say which landmarks are wrong, how many other rows are rejected, and which are furthest."""
    note_wrong_landmarks(gross.landmarks)
    gross = gross.without_landmarks()
    if len(gross.rows):
        worst = ', '.join(
            f'{frame_name(table, int(table.frame[gross.rows[i]]))} landmark '
            f'{table.landmark[gross.rows[i]]} '
            f'({gross.px[i]:.1f} px)'
            for i in (-gross.px).argsort()[:3]
        )
        frames = table.frame[gross.rows]
        whole = [
            frame
            for frame in dict.fromkeys(frames.tolist())
            if (frames == frame).sum() == (table.frame == frame).sum()
        ]
        views = (
            f'; all points of {list_frames(table, whole)} are outliers: check their order'
            if whole
            else ''
        )
        say(
            f'{len(gross.rows)} of {len(table)} points are outliers and are rejected; the '
            f'largest: {worst}{views}'
        )


def note_doubtful(table: Observations, frames: Sequence[int], reasons: Sequence[str]) -> None:
    """Name the frames of a table whose poses should not be relied on as they are, and why."""
    alike: dict[str, list[tuple[int, str]]] = {}
    for frame, reason in zip(frames, reasons, strict=True):
        if reason:
            alike.setdefault(_DIGITS.sub('', reason), []).append((frame, reason))
    for doubtful in alike.values():
        shown = len(doubtful) if len(doubtful) <= _MAX_SIMILAR_NOTES else 1
        for frame, reason in doubtful[:shown]:
            say(f'{frame_name(table, frame)}: {reason}')
        if rest := [frame for frame, _ in doubtful[shown:]]:
            say(f'{list_frames(table, rest)}: likewise')


def note_unconnected(table: Observations) -> None:
    """Say which cameras share no frame with others, so that nothing relates them."""
    from fisheye_svp_ros.solve.rig_calibration import connected_cameras

    first, *others = connected_cameras(table)
    for group in others:
        say(
            f'{" and ".join(group)}: no frame shared with {" and ".join(first)}, so their '
            'relative pose is not estimated, and no rig.yaml is written'
        )
        first += group
