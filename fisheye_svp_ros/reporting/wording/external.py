"""External evidence in words: what the other camera, or another data set, says."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import isfinite
from pathlib import Path
from typing import NamedTuple

from fisheye_svp_ros.diagnosis import Comparison, Diagnosis, Transfer, TwoCameras, TwoDatasets
from fisheye_svp_ros.reporting.calibrated_camera import ROBOT_HEADER, hand_eye_rows
from fisheye_svp_ros.reporting.wording.calibration import hand_eye_sentence, hand_eye_warnings
from fisheye_svp_ros.reporting.wording.causes import pixels, quantity
from fisheye_svp_ros.reporting.wording.diagnosis import compared_row, join_names
from fisheye_svp_ros.solve.hand_eye import HandEye

CARRIED_HEADER = ('found in', 'tried on', 'what', 'rms px without', 'with', 'less by (95 %)')
_SIGNIFICANT_RATIO, _MAX_PARAMETERS = 3.0, 4
_MIN_HEIGHT = 1e-9  # m, rms: less is rounding
_NO_RIG_NOTE = (
    '. Their relative pose is not constant, their photographs are not simultaneous, or they '
    'see different boards. So each view has its own pose, and no result depends on the rig'
)
ROBOT_TITLE = 'Poses of the robot'
SETS_TITLE = 'Another data set of this camera'
CAMERAS_TITLE = 'Cross-camera validation'


class Section(NamedTuple):
    """One kind of external evidence: a sentence, what was carried over, and further rows."""

    title: str
    sentence: str
    carried: Sequence[tuple[str, ...]]
    header: Sequence[str]
    rows: Sequence[tuple[str, ...]]


def sections(diagnosis: Diagnosis) -> list[Section]:
    """Return the external evidence that a diagnosis has."""
    parts = [_of_cameras(pair) for pair in diagnosis.cameras]
    if diagnosis.hand_eye is not None:
        parts.append(_of_robot(diagnosis.hand_eye))
    return parts if diagnosis.against is None else [*parts, _of_sets(diagnosis.against)]


def carried_row(transfer: Transfer, what: str) -> tuple[str, ...]:
    """Return where something was found, tried, what it was, rms without and with it, and less."""
    less = transfer.less_px
    return (
        transfer.source,
        transfer.to,
        what,
        f'{transfer.without_px:.4f}',
        f'{transfer.with_px:.4f}',
        f'{less.value:.4f} ({less.low:.4f} to {less.high:.4f})',
    )


def _of_robot(hand_eye: HandEye) -> Section:
    x, y, z = 1e3 * hand_eye.camera.position
    sentence = (
        'The given poses are those of the flange, not of the camera, which is at '
        f'{x:.2f}, {y:.2f}, {z:.2f} mm in the flange. They were not used as camera poses: '
        f'{hand_eye_sentence(hand_eye)}.'
    )
    sentence += ''.join(
        f' {warning[0].upper()}{warning[1:]}.' for warning in hand_eye_warnings(hand_eye)
    )
    return Section(ROBOT_TITLE, sentence, [], ROBOT_HEADER, hand_eye_rows(hand_eye))


def _of_cameras(pair: TwoCameras) -> Section:
    rows = [] if not pair.rig else list(_rig_rows(pair.rig))
    if pair.maps is not None:
        first, second = (f'{1e3 * rms:.3f} mm rms' for rms in pair.maps.rms_m)
        whose = (
            f'of {pair.maps.landmarks} landmarks, from {pair.cameras[0]} alone and from '
            f'{pair.cameras[1]} alone'
        )
        if _has_height(pair):
            rows.append(
                (f'height {whose}', first, second, f'correlation {pair.maps.correlation:.2f}')
            )
        rows.append(
            (
                f'positions along the board {whose}',
                '',
                '',
                f'correlation {pair.maps.correlation_along:.2f}',
            )
        )
    return Section(
        CAMERAS_TITLE,
        f'{_agreement(pair)}{_rig(pair)}.',
        [carried_row(transfer, 'shape of the target') for transfer in pair.target],
        ('', 'before', 'after', ''),
        rows,
    )


def _agreement(pair: TwoCameras) -> str:
    both = join_names(pair.cameras)
    if pair.verdict == 'nothing':
        return f'Neither {join_names(pair.cameras, "nor")} needs another shape of the target'
    tried = join_names(
        [
            f'{transfer.to} from {pixels(transfer.without_px)} to {pixels(transfer.with_px)} px'
            for transfer in pair.target
        ]
    )
    carried = f'the shape estimated from one camera changes the held-out error of {tried}'
    alike = ''
    if pair.maps is not None:
        alike = '; their maps correlate by ' + (
            f'{pair.maps.correlation:.2f}'
            if _has_height(pair)
            else f'{pair.maps.correlation_along:.2f} along the board'
        )
    if pair.verdict == 'agree':
        return f'{both} agree: {carried}{alike}'
    if pair.verdict == 'undecided':
        return f'{both} are undecided: {carried}, not significant in both{alike}'
    gone = f', so that {join_names(pair.withdrawn)} is withdrawn' if pair.withdrawn else ''
    return f'{both} disagree about the target: {carried}{alike}{gone}'


def _has_height(pair: TwoCameras) -> bool:
    return pair.maps is not None and max(pair.maps.rms_m) > _MIN_HEIGHT


def _rig(pair: TwoCameras) -> str:
    if not pair.rig:
        return '. Too few frames are shared to estimate the scatter of the rig'
    if pair.posed_alone:
        return _NO_RIG_NOTE
    if pair.verdict in ('nothing', 'contradict'):
        return ''
    said = []
    rows = zip(_rig_rows(pair.rig), pair.rig.values(), strict=True)
    for (label, before, after, less), change in rows:
        how = f'reduced by {less}' if change.low > 0 else 'not significantly reduced'
        said.append(f'{label} {before} before, {after} after ({how})')
    return '. Estimated view by view, the rig scatters: ' + join_names(said)


def _rig_rows(rig: dict[str, Comparison]) -> Iterable[tuple[str, str, str, str]]:
    return (compared_row(f'rig_{name}', value) for name, value in rig.items())


def _of_sets(against: TwoDatasets) -> Section:
    carried = []
    for tried in filter(None, against.tried):
        carried.append(carried_row(tried.lens, 'causes of the lens'))
        carried += [
            carried_row(cause, f'{name}, added to the others')
            for name, cause in tried.causes.items()
        ]
        carried.append(carried_row(tried.whole, 'the whole lens, intrinsics too'))
        if tried.target is not None:
            carried.append(carried_row(tried.target, 'shape of the target'))
    rows = [
        (
            name,
            quantity({'value': both.value, 'stderr': both.stderr, 'unit': both.unit}),
            quantity({'value': both.other_value, 'stderr': both.other_stderr, 'unit': both.unit}),
            f'{both.standardized_difference:.1f} standard errors apart',
        )
        for name, both in against.parameters.items()
    ]
    return Section(
        SETS_TITLE,
        f'{_lens_holds(against)}{_difference_text(against)}{_follows(against)}.',
        carried,
        ('of the lens', 'here', Path(against.source).name, ''),
        rows,
    )


def _lens_holds(against: TwoDatasets) -> str:
    if against.verdict == 'nothing':
        return f'Neither these data nor {against.source} need a cause in the lens'
    tried = join_names(
        [
            f'{causes.lens.to} from {pixels(causes.lens.without_px)} to '
            f'{pixels(causes.lens.with_px)} px'
            for causes in against.tried
            if causes is not None
        ]
    )
    said = {
        'agree': 'The causes in the lens hold in both sets',
        'undecided': 'It is undecided whether the causes in the lens hold in both sets',
        'contradict': 'The two data sets disagree about the lens',
    }[against.verdict]
    gone = f'. {join_names(against.withdrawn)} is withdrawn' if against.withdrawn else ''
    return f'{said}: estimated from one set, they change the held-out error of {tried}{gone}'


def _difference_text(against: TwoDatasets) -> str:
    if not against.parameters:
        return ''
    said = ''
    for of_causes, meaning in (
        (
            False,
            'the intrinsics of the two sets differ ({}): the focus or the mount changed in '
            'between, or they absorb an unexplained error',
        ),
        (
            True,
            'sizes of causes differ by more than their errors ({}): the errors stated for one '
            'set are too small',
        ),
    ):
        sizes = [
            (abs(both.standardized_difference), name)
            for name, both in against.parameters.items()
            if ('.' in name) == of_causes
        ]
        far = sorted((entry for entry in sizes if entry[0] > _SIGNIFICANT_RATIO), reverse=True)
        each = [f'{name} by {apart:.1f} standard errors' for apart, name in far[:_MAX_PARAMETERS]]
        said += f'; {meaning.format(join_names(each))}' if each else ''
    if said or against.verdict == 'contradict':
        return said
    return '; its parameters agree within their errors'


def _follows(against: TwoDatasets) -> str:
    there = [
        transfer.target
        for transfer in against.tried
        if transfer is not None and transfer.target is not None
    ]
    if not there:
        return ''
    if any(transfer.improves for transfer in there):
        return (
            '. The correction of the target also holds in the other set: the target is the '
            'same, or the error belongs to the lens'
        )
    return '. The correction of the target does not transfer to the other target, as expected'


def travel_sentence(against: TwoDatasets) -> str:
    """Return how both lenses predict the other set; '' where it was not measured."""
    if against.travel is None:
        return ''
    given, extended = map(_error, against.travel)
    return (
        f'On {Path(against.source).name}, the lens as given leaves {given} and the extended lens '
        f'{extended}; poses and landmark offsets are refitted'
    )


def _error(px: float) -> str:
    return f'{pixels(px)} px' if isfinite(px) else 'some points out of sight'
