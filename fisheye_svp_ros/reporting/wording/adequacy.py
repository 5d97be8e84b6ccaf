"""What is wrong with data, and what to do: the figure first, the remedy last."""

from __future__ import annotations

from collections.abc import Sequence
from math import degrees
from typing import Any

import numpy as np

from fisheye_svp_ros.diagnosis import MIN_FRAMES, Flaw, FlawKind
from fisheye_svp_ros.reporting.wording.inputs import MIRROR_REMEDY, MIRROR_WORDS

_COUNTS = {2: 'two', 3: 'three', 4: 'four'}
_MAX_FRAMES = 4  # by name, and of those that differ most
_MAX_RUNS = 8  # of frame numbers
_UNIT_REMEDY = 'write x, y, z in m (divide mm by 1000), and diagnose again'
_REMEDIES = {
    FlawKind.MIRRORED: f'{MIRROR_REMEDY}, and diagnose again',
    FlawKind.TARGET_TOO_LARGE: _UNIT_REMEDY,
    FlawKind.SHIFT_TOO_LARGE: _UNIT_REMEDY,
    FlawKind.CAMERAS_MIXED: 'calibrate each group of frames separately, from a table of its own',
    FlawKind.FOCAL_VARIES: 'switch off zoom, autofocus, and stabilization, and retake all '
    'photographs; if two cameras are mixed, calibrate each one separately',
    FlawKind.CENTER_VARIES: 'switch off stabilization and cropping, and retake all photographs',
    FlawKind.FRAMES_DIFFER: 'check that all frames show one board through one camera at one '
    'image size',
    FlawKind.NO_FIT: 'check the order and the units of the points, the image size, and the model',
    FlawKind.FEW_FRAMES: f'take {MIN_FRAMES} or more, tilted, and out to the edges of the image',
    FlawKind.SIDES_DIFFER: 'number the corners in the same order in all frames, without mirroring',
    FlawKind.NOISE_TOO_LARGE: 'check the sharpness, the detector, and the order of the corners',
    FlawKind.LENS_UNKNOWN: 'go near, tilt the target, and cover the image out to its edges',
    FlawKind.ANGLE_SHORT: 'photograph the board near the edges of the image, too',
    FlawKind.OFF_CENTER: 'check the image size, and whether images are cropped',
}
_OF_LENS_MISFIT = {
    False: 'a lens from other photographs is neither confirmed nor refuted',
    True: 'until then, trust no lens, pose or size from these data',
}
_OF_LENS = {
    FlawKind.FEW_FRAMES: 'so few frames cannot separate its errors from those of the board',
    FlawKind.SIDES_DIFFER: 'its rays may be right, but the poses of some frames are mirrored',
    FlawKind.NOISE_TOO_LARGE: 'points with so much noise may have systematic errors, too',
    FlawKind.LENS_UNKNOWN: 'more photographs would make it better',
    FlawKind.ANGLE_SHORT: 'beyond its points, its curve is extrapolated',
    FlawKind.OFF_CENTER: 'no valid image has its center there',
}


def flaw_statement(flaw: Flaw) -> str:
    """Return what is wrong as a clause, with the frames that it is about."""
    frames = {
        FlawKind.CAMERAS_MIXED: f', and {common_residual(flaw)}: ',
        FlawKind.FOCAL_VARIES: ': ',
        FlawKind.SIDES_DIFFER: ', so their corners are in mirrored order: ',
        FlawKind.CENTER_VARIES: ', ',
        FlawKind.FRAMES_DIFFER: ', ',
    }
    if flaw.kind not in frames:
        return flaw_summary(flaw)
    lists = group_lists(flaw)
    where = ' (all in diagnosis.json)' if lists.endswith(' more') else ''
    return f'{flaw_summary(flaw)}{frames[flaw.kind]}{lists}{where}'


def common_residual(flaw: Flaw) -> str:
    """Return what one lens for the frames of several cameras leaves."""
    return f'one lens for all leaves {flaw.size:.2g} px ({_noise(flaw)})'


def group_lists(flaw: Flaw, most: int = _MAX_RUNS) -> str:
    """Return the frames of each group, or those that differ most; most: names of one group."""
    if flaw.kind in (FlawKind.CENTER_VARIES, FlawKind.FRAMES_DIFFER):
        return f'most in {_first_frames(flaw)}'
    pairs = zip(flaw.groups, _names(flaw), strict=True)
    lists = [frame_list(*pair, most) for pair in pairs]
    if flaw.kind is FlawKind.CAMERAS_MIXED:
        return f'one camera took {"; another ".join(lists)}'
    return ' differ from '.join(
        [*lists[:1], *(names.removeprefix('frames ') for names in lists[1:])]
    )


def flaw_summary(flaw: Flaw) -> str:
    """Return what is wrong as a clause of few words."""
    of, whose = (f' of {flaw.camera}', 'its') if flaw.camera else ('', "the lens's")
    count = _COUNTS.get(len(flaw.groups), str(len(flaw.groups)))
    px, mrad, angle = f'{flaw.size:.2g} px', f'{1e3 * flaw.size:.2g} mrad', degrees(flaw.size)
    if flaw.mirror:
        return f'every frame{of} shows the board from behind: {MIRROR_WORDS[flaw.mirror]}'
    texts = {
        FlawKind.TARGET_TOO_LARGE: f'the target is {flaw.size:.0f} m across: x, y, z must be in '
        'm, not mm',
        FlawKind.SHIFT_TOO_LARGE: f'the viewpoint would shift by {1e3 * flaw.size:.0f} mm, more '
        'than in any real lens',
        FlawKind.CAMERAS_MIXED: f'{count} groups of frames come from {count} cameras',
        FlawKind.FOCAL_VARIES: f'the focal length{of} differs between frames by up to '
        f'{100 * flaw.size:.2g} %',
        FlawKind.CENTER_VARIES: f'the image{of} is shifted by {px} rms from frame to frame',
        FlawKind.FRAMES_DIFFER: f'frames contradict each other: residuals are {px} '
        f'({_noise(flaw)})',
        FlawKind.NO_FIT: f'no camera model fits: residuals are {px} ({_noise(flaw)})',
        FlawKind.FEW_FRAMES: (f'{flaw.size:.0f} frames are' if flaw.size > 1 else 'one frame is')
        + ' too few to judge the lens',
        FlawKind.SIDES_DIFFER: f'{flaw.size:.0f} of {flaw.beside:.0f} frames see the board from '
        'behind',
        FlawKind.NOISE_TOO_LARGE: f'the image noise is {flaw.size:.1f} px; detectors leave 0.02 '
        'to 0.3 px',
        FlawKind.LENS_UNKNOWN: f'rays{of} are uncertain by up to {mrad} ({1e3 * flaw.size:.2g} mm '
        'at 1 m; 95 % sure)',
        FlawKind.ANGLE_SHORT: f'points{of} reach {angle:.0f} of {whose} '
        f'{degrees(flaw.beside):.0f} deg',
        FlawKind.OFF_CENTER: f'the principal point{of} is {flaw.size:.0f}, {flaw.beside:.0f} px '
        'off the image center',
    }
    return texts[flaw.kind]


def remedy(kind: FlawKind) -> str:
    """Return what to do about a flaw as a clause."""
    return _REMEDIES[kind]


def flaw_headline(flaw: Flaw) -> str:
    """Return what is wrong as the start of a sentence, in few words."""
    summary = flaw_summary(flaw)
    return summary[0].upper() + summary[1:]


def flaw_reason(flaws: Sequence[Flaw], about: str) -> str:
    """Return why nothing else is said about `lens`, `target` or `photographs`, as a clause."""
    worst = flaws[0].kind
    if about == 'lens':
        first = _OF_LENS_MISFIT[worst.is_unit] if worst.is_misfit else _OF_LENS[worst]
        return '; '.join([first, *map(flaw_statement, flaws[1:])])
    if about == 'target':
        if worst.is_unit:
            return 'it cannot be judged until lengths are in m'
        if worst is FlawKind.MIRRORED:
            return 'it cannot be judged until the points are corrected'
        if worst.is_misfit:
            return 'it cannot be judged while no single lens fits the frames'
        if worst.is_of_table:
            return 'it cannot be judged until that is corrected'
        return 'these views cannot separate its errors from those of the lens'
    return '; '.join(dict.fromkeys(remedy(flaw.kind) for flaw in flaws))


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
        'do': remedy(flaw.kind),
    }


def frame_list(frames: Sequence[int], names: Sequence[str] = (), most: int = _MAX_RUNS) -> str:
    """Return frames as one enumerates them, ranges as such; of many, the first ones."""
    if names:
        return _join_first([(name, 1) for name in names], min(most, _MAX_FRAMES))
    step = frames[1] - frames[0] if len(frames) > 2 else 0
    if step > 1 and [*frames] == [*range(frames[0], frames[-1] + 1, step)]:
        return f'frames {frames[0]}, {frames[1]}, … {frames[-1]}'
    runs = np.split(np.array(frames), np.flatnonzero(np.diff(frames) != 1) + 1)
    words = [
        (f'{run[0]} to {run[-1]}' if len(run) > 2 else ', '.join(map(str, run)), len(run))
        for run in runs
    ]
    return f'frame{"s" * (len(frames) > 1)} {_join_first(words, most)}'


def _join_first(parts: Sequence[tuple[str, int]], most: int) -> str:
    """Return the first of some parts, how many frames the others are, and where these are."""
    more = sum(count for _, count in parts[most:])
    rest = f' and {more} more' if more else ''
    return ', '.join(words for words, _ in parts[:most]) + rest


def _first_frames(flaw: Flaw) -> str:
    """Return those of the frames that differ most."""
    return frame_list(sorted(flaw.groups[0][:_MAX_FRAMES]), _names(flaw)[0][:_MAX_FRAMES])


def _noise(flaw: Flaw) -> str:
    """Return what noise alone would leave, as the rms of both coordinates."""
    return f'noise alone {2**0.5 * flaw.beside:.2g} px'


def _names(flaw: Flaw) -> tuple[tuple[str, ...], ...]:
    return flaw.names or ((),) * len(flaw.groups)
