"""Sentences about landmarks that are not where they are said to be."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from fisheye_svp_ros.solve.outliers import WrongLandmark

_MAX_NAMES = 10


def wrong_landmark_notes(landmarks: Sequence[WrongLandmark]) -> Iterator[str]:
    """Yield what to say of wrong landmarks: which, how far off, and what to do."""
    moved = [landmark for landmark in landmarks if landmark.displaced]
    if moved:
        sizes = [float((landmark.offset**2).sum()) ** 0.5 for landmark in moved]
        names = [
            f'{landmark.number} by {1e3 * size:.3g} mm'
            for landmark, size in zip(moved, sizes, strict=True)
        ]
        many = len(moved) > 1
        yield (
            f'landmark{"s" if many else ""} not where x, y, z say: {_listed(names)}; rejected; '
            f'measure {"them" if many else "it"} again'
        )
    for landmark in landmarks:
        if not landmark.displaced:
            yield (
                f'landmark {landmark.number}: its {landmark.points} points are {landmark.px:.3g} '
                'px off and no other place explains them; rejected; check its number'
            )


def _listed(names: Sequence[str]) -> str:
    if len(names) > _MAX_NAMES:
        return f'{", ".join(names[:_MAX_NAMES])} and {len(names) - _MAX_NAMES} more'
    return ' and '.join(filter(None, (', '.join(names[:-1]), names[-1])))
