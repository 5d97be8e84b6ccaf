"""`fisheye-svp calibrate`: a lens from measured observations."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fisheye_svp_ros.solve.lens_calibration import Calibration

_UNITS = {
    **dict.fromkeys(('f', 'fx', 'fy', 'cx', 'cy'), 'px'),
    **dict.fromkeys(('s0', 'e0', 'e1', 'e2', 'thickness'), 'm'),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    from fisheye_svp_ros.optics.curves import IMAGE_HEIGHTS

    parser.add_argument('observations', metavar='OBS',
                        help='observations: a CSV file or a folder of ORPC files')
    parser.add_argument('--model', required=True, choices=IMAGE_HEIGHTS, metavar='MODEL',
                        help='image-height curve: ' + ', '.join(IMAGE_HEIGHTS))
    parser.add_argument('--image-size', required=True, type=_image_size, metavar='WxH',
                        help='width and height of the image, px')
    parser.add_argument('--free', type=_names, metavar='NAME,...',
                        help='parameters to fit: f (or fx,fy), cx, cy, the coefficients of the '
                        'model, those of a viewpoint shift (e0,e1,e2 or '
                        'thickness,refractive_index); all but the shift by default')
    parser.add_argument('-o', '--output', type=Path, metavar='LENS.yaml',
                        help='lens file to write; covariances go beside it as .calibrate.json')


def run(args: argparse.Namespace) -> None:
    """Calibrate, print the parameters, write the lens."""
    from fisheye_svp_ros.commands.notes import note_left_out, say
    from fisheye_svp_ros.io.lens_files import save_lens
    from fisheye_svp_ros.io.readers import read_observations
    from fisheye_svp_ros.io.results import write_json
    from fisheye_svp_ros.reporting.progress import progress
    from fisheye_svp_ros.solve.lens_calibration import calibrate

    observations = read_observations(args.observations)
    name = args.output.stem if args.output else args.model
    with progress('calibrating'):
        result = calibrate(observations, args.model, args.image_size, args.free, name)
    # Written before a word is printed: nobody may be reading.
    if args.output:
        save_lens(result.adjusted.lens, args.output)
        write_json(args.output.with_suffix('.calibrate.json'), _document(result))
    _print(result)
    note_left_out(result.left_out)
    if not result.adjusted.converged:
        say('the adjustment has not converged; take the lens for a rough one')
    if result.beyond:
        say(f'{result.beyond} observations lie beyond max_incidence_deg, where the fitted curve '
            'turns back; another model may suit this lens')


def _print(result: Calibration) -> None:
    import numpy as np

    from fisheye_svp_ros.reporting.tables import noise_text, print_table, with_error

    lens, names = result.adjusted.lens, result.adjusted.names
    figures = lens.calibration or {}
    errors = dict(zip(names, np.sqrt(np.diag(result.adjusted.covariance)).tolist(), strict=True))
    if 'f' in errors:
        errors['fx'] = errors['fy'] = errors['f']
    print_table(
        f'{lens.name}: {figures["observations"]} points in {figures["frames"]} frames, '
        f'rms {figures["rms_px"]:.4f} px',
        ('parameter', 'value', 'std. error', 'unit'),
        [
            (name, *with_error(value, errors.get(name, 0.0)), _UNITS.get(name, '1'))
            for name, value in lens.parameters.items()
        ],
    )
    print(f'  max_incidence_deg {np.degrees(lens.max_incidence):.2f}; {noise_text(result.sigma)}')


def _document(result: Calibration) -> dict[str, Any]:
    """Return what scripts may want beside the lens itself."""
    from fisheye_svp_ros.solve.lens_adjustment import parameter_values

    adjusted = result.adjusted
    return {
        **(adjusted.lens.calibration or {}),
        'left_out': result.left_out,
        'beyond': result.beyond,
        'sigma_px': result.sigma,
        'parameters': dict(
            zip(adjusted.names, parameter_values(adjusted.lens, adjusted.names), strict=True)
        ),
        'covariance': adjusted.covariance.tolist(),
    }


def _image_size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition('x')
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise argparse.ArgumentTypeError(f'{text!r} is not of the form 1280x800')
    return int(width), int(height)


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(','))
