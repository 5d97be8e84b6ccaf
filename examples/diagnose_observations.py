"""Find the model error in a table of image points, and measure the gain of the extended lens.

    python examples/diagnose_observations.py [OBSERVATIONS.csv LENS.yaml] [-o extended.yaml]

Without arguments it simulates a lens with a viewpoint shift and diagnoses it as an SVP lens.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

import fisheye_svp_ros as fsvp


def simulated(seed: int) -> Any:
    """Return ten views of a lens with a viewpoint shift, 0.2 px of noise."""
    return fsvp.simulate_scenario(
        lens='fish214', radius=0.5, noise_px=0.2, seed=seed, poses_file='calibration'
    )


def position_error(lens: fsvp.Lens) -> float:
    """Return the rms position error of ten new frames, m, without its mean in the camera frame.

    A constant shift along the optical axis (s0) cannot be observed: it moves all poses alike.
    """
    scene = simulated(seed=1)
    error = fsvp.localize(scene.observations, lens).pose.position - scene.pose.position
    error = (error[:, None] @ scene.pose.rotation)[:, 0]
    return float(np.sqrt(error.var(axis=0).sum()))


def main() -> None:
    """Print causes, their parameters and the gain on held-out frames."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('observations', nargs='?')
    parser.add_argument('lens', nargs='?')
    parser.add_argument('-o', '--output', default='extended.yaml')
    args = parser.parse_args()
    if args.observations and not args.lens:
        parser.error('OBSERVATIONS.csv needs a LENS.yaml')

    lens = fsvp.load_lens(args.lens) if args.lens else fsvp.load_lens('fish214').svp()
    table = fsvp.read_observations(args.observations) if args.lens else simulated(0).observations
    diagnosis = fsvp.diagnose(table, lens)

    print(f'verdict: {diagnosis.verdict}')
    for cause in diagnosis.document['causes']:
        print(f'{cause["effect"]}: p = {cause["p_value"]:.1e}, gain {cause["gain"]:.0%}')
        for name, value in cause['parameters'].items():
            print(f'    {name} = {value["value"]:.6g} ± {value["stderr"]:.2g} {value["unit"]}')
    before, after = (diagnosis.document[part]['heldout_rms_px'] for part in ('base', 'extended'))
    print(f'held-out residual: {before:.3f} px as given, {after:.3f} px extended')
    fsvp.save_lens(diagnosis.lens, args.output)

    if not args.lens:
        for name, used in (('given', lens), ('extended', diagnosis.lens)):
            print(f'{name} lens: position error {1e3 * position_error(used):.2f} mm')


if __name__ == '__main__':
    main()
