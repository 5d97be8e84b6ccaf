"""What is to be said of poses, and of maps of tags."""

from __future__ import annotations

from collections.abc import Sequence


def second_pose_note(frames: str, count: int) -> str:
    """Say which frames a second pose explains about as well; frames: as they are enumerated."""
    poses = 'pose is' if count == 1 else 'poses are'
    return (
        f'{count} {poses} ambiguous ({frames}): the target may be tilted the other way, odds in '
        'localize.json; go nearer, or add landmarks'
    )


def rig_reason(outliers: int, contradicted: bool) -> str:
    """Say why the pose of a rig should not be relied on; '' for a reliable one."""
    points = f'{outliers} outliers rejected' if outliers else ''
    rig = 'the relative poses of the cameras differ; calibrate the rig again'
    return '; '.join(filter(None, (points, rig if contradicted else '')))


def missing_tags_note(ids: Sequence[int]) -> str:
    """Say which tags a map lacks."""
    names = ', '.join(map(str, ids))
    tags = 'tag is' if len(ids) == 1 else 'tags are'
    return (
        f'{len(ids)} {tags} not in the map ({names}): no image shows them together with a mapped '
        'tag; add such images'
    )
