"""Compare the position error of an SVP lens with that of the full lens, by range of the landmarks.

    python examples/svp_error_by_range.py [LENS.yaml] [-o error.png]

The lens must have a viewpoint shift.  Each range is solved for 20 draws of 0.3 px of noise.
"""

from __future__ import annotations

import argparse

import matplotlib.pyplot as plt
import numpy as np

import fisheye_svp_ros as fsvp

RANGES = (0.2, 0.5, 1.0, 2.0, 5.0)  # m
DRAWS = 20


def position_errors(lens: str, svp: bool) -> np.ndarray:
    """Return the median position error at each range, m."""
    table = fsvp.sweep(
        {'radius': RANGES, 'seed': range(DRAWS)},
        synthetic_camera={'lens': lens, 'noise_px': 0.3},
        localizer={'svp': svp},
    ).table()
    error = np.array(table['localizer.position_error_m'])
    return np.median(error.reshape(len(RANGES), DRAWS), axis=1)


def main() -> None:
    """Print the errors and draw them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('lens', nargs='?', default='fish214')
    parser.add_argument('-o', '--output', default='svp_error_by_range.png')
    args = parser.parse_args()

    full, svp = (1e3 * position_errors(args.lens, svp) for svp in (False, True))
    print('range [m]   full lens [mm]   SVP [mm]')
    for distance, *errors in zip(RANGES, full, svp, strict=True):
        print(f'{distance:9.1f}   {errors[0]:14.2f}   {errors[1]:8.2f}')

    figure, axes = plt.subplots(layout='constrained')
    axes.loglog(RANGES, full, 'o-', label='full lens: the noise alone')
    axes.loglog(RANGES, svp, 's-', label='SVP')
    axes.set_xticks(RANGES, map(str, RANGES))
    axes.set_xticks([], minor=True)
    axes.set(xlabel='range of the landmarks [m]', ylabel='median position error [mm]')
    axes.legend()
    figure.savefig(args.output)


if __name__ == '__main__':
    main()
