"""What was diagnosed, as the user named it, and the command to go on with; draws nothing."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import NamedTuple

from fisheye_svp_ros.diagnosis import Diagnosis, FlawKind, LensErrors
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.reporting.wording.actions import views_to_take
from fisheye_svp_ros.reporting.wording.diagnosis import LENS_FILE, remaining_error


class ReportInputs(NamedTuple):
    """What was diagnosed, as the user named it; folder: where the report goes.

    search: options of a command that finds the board in the photographs, where these are some;
    settings: further options that say how it was diagnosed; planned: whether the photographs to
    take next are listed.
    """

    observations: str
    lens: tuple[str, ...]
    poses: str | None
    held_out: str | None
    folder: Path
    free_intrinsics: bool
    search: tuple[str, ...] = ()
    settings: tuple[str, ...] = ()
    planned: bool = False


class NextStep(NamedTuple):
    """A command to go on with, as a shell takes it, and what it is for.

    In capitals: what the user has to make first.
    """

    purpose: str
    command: str


def next_step(diagnosis: Diagnosis, inputs: ReportInputs) -> NextStep:
    """Return the command to go on with."""
    flaws = diagnosis.adequacy.flaws
    if diagnosis.adequacy.is_misfit or (flaws and flaws[0].kind.is_of_table):
        return _with_other_data(diagnosis, inputs)
    d, files = diagnosis, follow_up_files(diagnosis, inputs)
    observations, lenses = (
        files['observations'],
        [shlex.join(['--lens', lens]) for lens in inputs.lens],
    )
    is_open = d.decision['lens'].say == 'undecided' or d.decision['photographs'].say == 'more'
    if is_open and not inputs.planned:
        settings = filter(None, [*lenses, shlex.join(inputs.settings)])
        again = ' '.join(['fisheye-svp diagnose', observations, *settings])
        count = views_to_take(d)
        if d.evaluation.problem.plannable:
            return NextStep(
                f'to list {count} views to photograph', f'{again} --next {count} -o next'
            )
        table = observations if inputs.search else 'MORE.csv'
        return NextStep(
            'with more photographs', f'{again.replace(observations, table, 1)} -o more'
        )
    if d.is_lens_off and not d.offers_extended:
        target = f'{observations} {_image_sizes(d)} -o recalibrated'
        suffix = '' if len(d.lenses) > 1 else '.yaml'
        return NextStep('to calibrate again', f'fisheye-svp calibrate {target}{suffix}')
    used = files['options'] if d.offers_extended else ' '.join(lenses)
    option = _model_error_option(d)
    return NextStep(
        'to compute camera poses' + (' and their errors' if option else ''),
        f'fisheye-svp localize {observations} {used}{option} -o poses',
    )


def _model_error_option(d: Diagnosis) -> str:
    """Return the option that counts what remains in poses, where the lens states its errors."""
    if len(d.lenses) > 1 or remaining_error(d) is None:
        return ''
    if not d.offers_extended:
        try:
            LensErrors.from_lens(next(iter(d.lenses.values())))
        except LensError:
            return ''
    return ' --model-error'


def _with_other_data(d: Diagnosis, inputs: ReportInputs) -> NextStep:
    """Return the command for what replaces data that are no use."""
    kind = d.adequacy.flaws[0].kind
    if kind.is_unit:
        lenses = shlex.join(word for lens in inputs.lens for word in ('--lens', lens))
        return NextStep(
            'with lengths in m', f'fisheye-svp diagnose IN_METERS.csv {lenses} -o diagnosis'
        )
    table, purpose = {
        FlawKind.CAMERAS_MIXED: ('ONE_GROUP.csv', 'once for each group of frames'),
        FlawKind.FOCAL_VARIES: ('NEW.csv', 'with the new photographs'),
        FlawKind.CENTER_VARIES: ('NEW.csv', 'with the new photographs'),
        FlawKind.OFF_CENTER: (inputs.observations, 'with the right image size'),
    }.get(kind, ('CORRECTED.csv', 'with corrected points'))
    sizes = '--image-size WIDTHxHEIGHT' if kind is FlawKind.OFF_CENTER else _image_sizes(d)
    return NextStep(
        purpose,
        f'fisheye-svp calibrate {table} {sizes} -o new_lens'
        + ('' if len(d.lenses) > 1 else '.yaml'),
    )


def follow_up_files(diagnosis: Diagnosis, inputs: ReportInputs) -> dict[str, str]:
    """Return what commands need to go on: the observations, the extended lenses, the first one."""
    files = {camera: inputs.folder / camera / LENS_FILE for camera in diagnosis.lenses}
    options = [
        word
        for camera, path in files.items()
        for word in ('--lens', f'{camera}={path}' if camera else str(path))
    ]
    return {
        'observations': shlex.join([inputs.observations, *inputs.search]),
        'options': shlex.join(options),
        'search': shlex.join(inputs.search),
        'first': shlex.quote(str(next(iter(files.values())))),
    }


def _image_sizes(d: Diagnosis) -> str:
    """Return the option of `calibrate` that tells the image size of each camera."""
    sizes = {camera: f'{lens.width}x{lens.height}' for camera, lens in d.lenses.items()}
    if len({*sizes.values()}) == 1:
        return f'--image-size {next(iter(sizes.values()))}'
    return '--image-size ' + ','.join(f'{camera}={size}' for camera, size in sizes.items())
