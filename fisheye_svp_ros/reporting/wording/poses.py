"""Sentences about poses, maps of tags, and landmarks that are not where they are said to be."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from fisheye_svp_ros.io.tag_maps import tags_of

if TYPE_CHECKING:
    # A node starts with these words, but without what adjusts.
    from fisheye_svp_ros.solve.outliers import WrongLandmark

_MAX_NAMES = 10
_POOR_CORNERS = 0.5  # px rms; sharp images leave 0.1 to 0.3
_SURE, _LARGE_CHANGE = 4.0, 0.003  # standard errors; share of the focal length


def second_pose_note(frames: str, count: int) -> str:
    """Say which frames a second pose explains about as well; frames: as they are enumerated."""
    poses = 'pose is' if count == 1 else 'poses are'
    return (
        f'{count} {poses} ambiguous ({frames}): the target may be tilted the other way (odds in '
        'localize.json). Go nearer, or add landmarks'
    )


def rig_reason(outliers: int, contradicted: bool) -> str:
    """Say why the pose of a rig should not be relied on; '' for a reliable one."""
    points = f'{outliers} outliers rejected' if outliers else ''
    rig = 'the relative poses of the cameras differ; calibrate the rig again'
    return '; '.join(filter(None, (points, rig if contradicted else '')))


def map_notes(
    missing: Sequence[int], outside: int, rms_px: float, focal: tuple[float, float]
) -> Iterator[str]:
    """Yield what a map lacks, and whether it can be relied on.

    missing: ids of tags; outside: sightings beyond the field of view; rms_px: of the
    corners; focal: by which share they would have the focal length larger, its standard error.
    """
    if missing:
        names = ', '.join(map(str, missing))
        tags = 'tag is' if len(missing) == 1 else 'tags are'
        yield (
            f'{len(missing)} {tags} not in the map ({names}): no image shows them together with '
            'a mapped tag. Add such images'
        )
    if outside:
        yield (
            f'{outside} sightings of a tag reach beyond the field of view of the lens and are '
            'left out'
        )
    if rms_px > _POOR_CORNERS:
        yield (
            f'corners are off by {rms_px:.2f} px, more than those of flat tags (under '
            f'{_POOR_CORNERS:g} px). Standard errors do not cover that. Does the lens belong to '
            'this camera? Are the tags flat, of one size, and at rest?'
        )
    change, error = focal
    if abs(change) > max(_SURE * error, _LARGE_CHANGE):
        yield (
            f'the tags would have the focal length {100 * change:+.1f} ± {100 * error:.1f} %: '
            'calibrate the lens again. Standard errors of the map do not cover that'
        )


def wrong_landmark_notes(
    landmarks: Sequence[WrongLandmark], of_tags: bool = False
) -> Iterator[str]:
    """Yield what to say of wrong landmarks: which, how far off, and what to do.

    of_tags: they are corners of tags, which are named in their place.
    """
    kind = 'tag' if of_tags else 'landmark'
    numbers = tags_of(np.array([one.number for one in landmarks], dtype=np.int64))
    groups: dict[int, list[WrongLandmark]] = {}
    for landmark, tag in zip(landmarks, numbers.tolist(), strict=True):
        groups.setdefault(tag if of_tags else landmark.number, []).append(landmark)
    moved = {
        number: max(float((one.offset**2).sum()) ** 0.5 for one in group if one.is_displaced)
        for number, group in groups.items()
        if any(one.is_displaced for one in group)
    }
    if moved:
        names = [f'{number} ({1e3 * size:.3g} mm)' for number, size in moved.items()]
        if len(moved) > 1:
            yield (
                f'{kind}s {_enumerate_names(names)} are not at their stated positions and are '
                'rejected. Measure them again'
            )
        else:
            ((number, size),) = moved.items()
            yield (
                f'{kind} {number} is {1e3 * size:.3g} mm from its stated position and is '
                'rejected. Measure it again'
            )
    for number, group in groups.items():
        if number not in moved:
            points, px = sum(one.points for one in group), max(one.px for one in group)
            yield (
                f'{kind} {number}: its {points} points are {px:.3g} px off, and no other position '
                'explains them. They are rejected. Check its number'
            )


def _enumerate_names(names: Sequence[str]) -> str:
    if len(names) > _MAX_NAMES:
        return f'{", ".join(names[:_MAX_NAMES])} and {len(names) - _MAX_NAMES} more'
    return ' and '.join(filter(None, (', '.join(names[:-1]), names[-1])))
