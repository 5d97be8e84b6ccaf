"""Are rays as far off as is stated?  `python -m benchmark.studies.ray_halves`.

Each half of the frames of a set (every other one from the first and from the second, the first
and the last half) is calibrated and diagnosed by itself.  Stated: the ray error at 1 m, mrad, that
the diagnosis expects of the lens as calibrated and of the extended one, with its 95 % interval.
Found: the rms angle between their rays and those of the extended lens of all frames, a common
motion taken out; that lens has an error of its own, stated in the last row.

Writes docs/results/ray_halves.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmark import study
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.io.readers import read_observations
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.solve.ray_errors import RayError, typical_points

RANGE = 1.0  # m
PARTS = {
    'even frames': slice(0, None, 2),
    'odd frames': slice(1, None, 2),
    'first half': 0,
    'last half': 1,
    'all frames': slice(None),
}

Part = tuple[Path, tuple[int, int], str]
Found = tuple[Lens, Lens, list[RayError]]


def diagnosed(part: Part) -> Found:
    """Return the lens as calibrated, as extended, and the stated errors of both at 1 m."""
    path, size, name = part
    table = read_observations(path)
    chosen = PARTS[name]
    frames = (
        table.frames[chosen]
        if isinstance(chosen, slice)
        else np.array_split(table.frames, 2)[chosen]
    )
    given, found = study.calibrated_and_diagnosed(table.take(np.isin(table.frame, frames)), size)
    stated = found.ray_error['']
    at = [one.range_m for one in stated['given']].index(RANGE)
    assert found.lens is not None
    return given, found.lens, [stated[side][at] for side in ('given', 'extended')]


def set_rows(name: str, table: Observations, parts: dict[str, Found]) -> list[list[str]]:
    """Return the rows of one set."""
    truth, uv, rows = parts['all frames'][1], typical_points(table.uv), []
    for part, (given, extended, stated) in parts.items():
        row = [name, part]
        for lens, one in zip((given, extended), stated, strict=True):
            off = '-' if lens is truth else f'{study.ray_error(lens, truth, uv, (RANGE,)):.2f}'
            row += [f'{1e3 * one.value:.2f} ({1e3 * one.low:.2f} to {1e3 * one.high:.2f})', off]
        rows.append(row)
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Diagnose the halves and write what they state and what is found."""
    parser = study.parser('ray_halves', __doc__)
    study.add_sets(parser)
    asked = parser.parse_args(arguments)
    todo = [(path, asked.image_size, part) for path in asked.sets for part in PARTS]
    found = iter(study.in_processes('halves', diagnosed, todo, asked.workers))
    rows = []
    for path in asked.sets:
        parts = {part: next(found) for part in PARTS}
        rows += set_rows(path.parent.name, read_observations(path), parts)
    width, height = asked.image_size
    command = ' '.join([*map(str, asked.sets), '--image-size', f'{width}x{height}'])
    head = 'set | part | calibrated: stated, mrad | found | extended: stated, mrad | found'
    page = study.page(
        'Are rays as far off as is stated?',
        __doc__,
        f'python -m benchmark.studies.ray_halves {command}',
        study.table(head, rows),
    )
    write_text(asked.output / 'ray_halves.md', page)


if __name__ == '__main__':
    main()
