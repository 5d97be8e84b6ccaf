"""Calibrate a stereo rig and measure depth with the full lens and with SVP.

    python examples/stereo_depth_error.py [LENS.yaml] [--baseline 0.15]

Both cameras have the same lens.  The printed errors are those of points in space, by range.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

import fisheye_svp_ros as fsvp

RANGES = (0.5, 1.0, 2.0)  # m


def depth_error(lens: fsvp.Lens, scene: Any, rig: fsvp.Pose) -> float:
    """Return the mean distance between measured and true points of one frame, m."""
    measured = fsvp.stereo_depth(scene.observations, lens, lens, rig)
    table = scene.observations
    landmarks, row = np.unique(table.landmark, return_index=True)
    world = table.xyz[row[np.searchsorted(landmarks, measured.landmark)]]
    true = scene.pose.take(0).into_body(world)  # in the right camera
    return float(np.nanmean(np.linalg.norm(measured.points - true, axis=1)))


def main() -> None:
    """Print the calibrated baseline and the error of points in space for both models."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('lens', nargs='?', default='fish214')
    parser.add_argument('--baseline', type=float, default=0.15, help='m')
    args = parser.parse_args()

    lens = fsvp.load_lens(args.lens)
    scenario = {'lens': args.lens, 'style': 'parallel', 'baseline': args.baseline, 'noise_px': 0.2}
    views = fsvp.simulate_scenario(**scenario, radius=0.5, poses_file='calibration')
    for name, model in (('full lens', lens), ('SVP', lens.svp())):
        found = fsvp.calibrate_stereo(views.observations, model, model)
        sigma = np.sqrt(np.diag(found.covariance))[0]
        print(
            f'{name}: baseline {1e3 * np.linalg.norm(found.rig.position):.2f} '
            f'± {1e3 * sigma:.2f} mm, rms {found.rms_px:.2f} px'
        )
        for distance in RANGES:
            scene = fsvp.simulate_scenario(**scenario, radius=distance)
            error = depth_error(model, scene, found.rig)
            print(f'    points at {distance} m: error {1e3 * error:.1f} mm')


if __name__ == '__main__':
    main()
