"""What is wrong with data, and what to do: the figure first, the remedy last."""

from __future__ import annotations

from collections.abc import Sequence
from math import degrees
from typing import Any

from fisheye_svp_ros.diagnosis import Flaw, FlawKind

NOT_CERTAIN = 'not certain, since the data are inadequate'
_COUNTS = {2: 'two', 3: 'three', 4: 'four'}
_MAX_FRAMES = 4  # by name
_REMEDIES = {
    FlawKind.CAMERAS_MIXED: 'calibrate each group of frames by itself',
    FlawKind.FOCAL_VARIES: 'switch off zoom, autofocus and stabilization, and take all again; '
    'if two cameras are mixed, calibrate each by itself',
    FlawKind.CENTER_VARIES: 'switch off stabilization and cropping, and take all again',
    FlawKind.FRAMES_DIFFER: 'check that all frames are of one camera, one size and one board',
    FlawKind.NO_FIT: 'check order and units of the points, image size and model',
    FlawKind.LENS_UNKNOWN: 'take nearer and tilted views of a larger board',
    FlawKind.ANGLE_SHORT: 'take photographs with the board near the edges of the image',
    FlawKind.OFF_CENTER: 'check the image size, and that images are not cropped',
}
_OF_TARGET = {
    True: 'nothing is known of it while frames contradict each other',
    False: 'its errors show only where the points are',
}


def flaw_statement(flaw: Flaw) -> str:
    """Return what is wrong as a clause."""
    of = f' of {flaw.camera}' if flaw.camera else ''
    groups = [frame_list(*pair) for pair in zip(flaw.groups, _names(flaw), strict=True)]
    if flaw.kind == FlawKind.CAMERAS_MIXED:
        count = _COUNTS.get(len(groups), str(len(groups)))
        return (
            f'{count} groups of frames fit {count} cameras, not one ({flaw.size:.2g} px, noise '
            f'{flaw.beside:.2g} px): {"; ".join(groups)}'
        )
    if flaw.kind == FlawKind.FOCAL_VARIES:
        return (
            f'the focal length{of} differs from frame to frame by {100 * flaw.size:.2g} %: '
            f'{" against ".join(groups)}'
        )
    if flaw.kind == FlawKind.CENTER_VARIES:
        return (
            f'the image{of} is shifted by {flaw.size:.2g} px rms from frame to frame, most in '
            f'{groups[0]}'
        )
    if flaw.kind == FlawKind.FRAMES_DIFFER:
        return (
            f'frames contradict each other: {flaw.size:.2g} px are left, noise {flaw.beside:.2g} '
            f'px, most in {groups[0]}'
        )
    if flaw.kind == FlawKind.NO_FIT:
        return f'{flaw.size:.2g} px are left, noise {flaw.beside:.2g} px: no camera fits'
    if flaw.kind == FlawKind.LENS_UNKNOWN:
        return (
            f'rays{of} are known to {1e3 * flaw.size:.2g} mrad only, even where points are '
            f'(noise of a point {1e3 * flaw.beside:.2g} mrad)'
        )
    if flaw.kind == FlawKind.ANGLE_SHORT:
        return (
            f'points{of} reach {degrees(flaw.size):.0f} deg, the lens is used to '
            f'{degrees(flaw.beside):.0f} deg: nothing is known beyond {degrees(flaw.size):.0f} deg'
        )
    return (
        f'the principal point{of} lies {flaw.size:.0f}, {flaw.beside:.0f} px off the center of '
        'the image'
    )


def flaw_remedy(flaw: Flaw) -> str:
    """Return what to do about it as a clause."""
    return _REMEDIES[flaw.kind]


def flaw_headline(flaw: Flaw) -> str:
    """Return what is wrong as the start of a sentence."""
    statement = flaw_statement(flaw)
    return statement[0].upper() + statement[1:]


def flaw_reason(flaws: Sequence[Flaw], about: str) -> str:
    """Return why nothing else is said about `lens`, `target` or `photographs`, as a clause."""
    if about == 'lens':
        return '; '.join(flaw_statement(flaw) for flaw in flaws)
    if about == 'target':
        return _OF_TARGET[flaws[0].kind.is_misfit]
    return '; '.join(dict.fromkeys(flaw_remedy(flaw) for flaw in flaws))


def flaw_document(flaw: Flaw) -> dict[str, Any]:
    """Return what diagnosis.json says of it."""
    return {
        'flaw': flaw.kind.name.lower(),
        'size': flaw.size,
        'beside': flaw.beside,
        'frames': [[*group] for group in flaw.groups],
        'photographs': [[*names] for names in flaw.names],
        'camera': flaw.camera,
        'why': flaw_statement(flaw),
        'do': flaw_remedy(flaw),
    }


def frame_list(frames: Sequence[int], names: Sequence[str] = ()) -> str:
    """Return frames as one enumerates them: a range, or the first ones and how many more."""
    if names:
        more = len(names) - _MAX_FRAMES
        return ', '.join(names[:_MAX_FRAMES]) + (f' and {more} more' if more > 0 else '')
    if len(frames) > 2 and [*frames] == [*range(frames[0], frames[-1] + 1)]:
        return f'frames {frames[0]} to {frames[-1]}'
    more = len(frames) - _MAX_FRAMES
    listed = ', '.join(map(str, frames[:_MAX_FRAMES])) + (f' and {more} more' if more > 0 else '')
    return f'frame{"s" * (len(frames) > 1)} {listed}'


def _names(flaw: Flaw) -> tuple[tuple[str, ...], ...]:
    return flaw.names or ((),) * len(flaw.groups)
