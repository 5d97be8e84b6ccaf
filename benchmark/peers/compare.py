"""The same held-out corners through ours and others: `python -m benchmark.peers.compare DATA`.

DATA holds the folders ov_plane, ov_cube (train.csv, test.csv) and photos (chessboard,
square_grid); what is not there is left out.  Then halves of the frames of each set: what lenses of
one half predict in the other, and how far intrinsics are apart beside their standard errors, as
in simulated sets from the true ones.
Writes docs/results/compare.md.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from itertools import chain
from pathlib import Path
from typing import NamedTuple

# One core each: read when NumPy is imported.
for _name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'NUMBA_NUM_THREADS'):
    os.environ.setdefault(_name, '1')

import numpy as np  # noqa: E402

import fisheye_svp_ros as fsvp  # noqa: E402
from benchmark import study  # noqa: E402
from benchmark.peers.calibrations import PEERS, Fitted, NotHereError  # noqa: E402
from benchmark.peers.halves import (  # noqa: E402
    SIMULATED,
    Difference,
    all_pairs,
    differences,
    half_sets,
    honesty_table,
    simulated_errors,
)
from benchmark.peers.python_calibrations import PYTHON_PEERS  # noqa: E402
from benchmark.peers.sets import (  # noqa: E402
    BOARDS,
    Set,
    grid_of,
    photograph_set,
    residuals,
    rms,
    table_set,
)
from fisheye_svp_ros.arrays import Array, Mask  # noqa: E402
from fisheye_svp_ros.diagnosis import (  # noqa: E402
    Diagnosis,
    PredictedOffsets,
    diagnose,
    predict_other_data,
)
from fisheye_svp_ros.library.results import Localized  # noqa: E402
from fisheye_svp_ros.scene.observations import Observations  # noqa: E402
from fisheye_svp_ros.solve.initial_rig import localize_frames  # noqa: E402
from fisheye_svp_ros.solve.measured_poses import (  # noqa: E402
    posable_observations,
)
from fisheye_svp_ros.solve.rig_state import group_by_frame  # noqa: E402

_OV = (1280, 800)
TOOLS = {**PEERS, **PYTHON_PEERS}
# Not on halves: what needs minutes, or is far off on whole sets.
_WHOLE_ONLY = {
    'mrcal, OPENCV8',
    'mrcal, splined 30 x 18',
    'lensboy, 14 coefficients',
    'lensboy, splined 16 x 11',
}
SETS: dict[str, Callable[[Path], Set]] = {
    'ov_plane': lambda data: table_set(data / 'ov_plane', _OV),
    'ov_cube': lambda data: table_set(data / 'ov_cube', _OV),
    'photos/chessboard': lambda data: photograph_set(
        data / 'photos' / 'chessboard', 'chessboard:4x6:30mm'
    ),
    'photos/square_grid': lambda data: photograph_set(
        data / 'photos' / 'square_grid', 'squares:3x4:30mm:30mm'
    ),
}


class Row(NamedTuple):
    """A model on one set: held-out rms, px, of so many points; seconds of a core to fit.

    whole_px: the rms with outliers.  NaN: not known, or the row above has it.
    """

    model: str
    rms_px: float
    whole_px: float
    points: int
    seconds: float
    note: str = ''
    ours: bool = False


@dataclass
class Clock:
    """Seconds of processors, those of child processes among them."""

    seconds: float = np.nan


@contextmanager
def timed() -> Iterator[Clock]:
    """Time a block."""
    clock, before = Clock(), os.times()
    yield clock
    clock.seconds = sum(os.times()[:4]) - sum(before[:4])


def compared_half(data: Set) -> list[Row]:
    """Return the rows of a set whose held-out frames are the other half."""
    return compared(data, [name for name in TOOLS if name not in _WHOLE_ONLY])


def compared(data: Set, tools: Iterable[str] = tuple(TOOLS)) -> list[Row]:
    """Return the rows of a set."""
    with timed() as fitting:
        lens = fsvp.calibrate(data.train, 'kannala_brandt', data.size).lens
    data = replace(data, test=posable_observations(data.test, lens)[0])
    train, _ = posable_observations(data.train, lens)
    with timed() as naming:
        found = diagnose(train, lens, held_out=data.test)
    gross = {
        (row['frame'], row['landmark']) for row in found.gross if row['why'].startswith('held out')
    }
    places = zip(data.test.frame.tolist(), data.test.landmark.tolist(), strict=True)
    fair = np.array([place not in gross for place in places])
    start = fsvp.localize(data.test, lens)
    count, names = int(fair.sum()), ', '.join(cause.effect for cause in found.causes)
    figures = found.figures
    return [
        Row(
            'ours, `calibrate`',
            figures.base.heldout_rms_px,
            _nominal(lens, data.test, start),
            count,
            fitting.seconds,
            ours=True,
        ),
        Row(
            'ours, `diagnose`: lens',
            figures.lens_only.heldout_rms_px,
            np.nan,
            count,
            naming.seconds,
            names,
            True,
        ),
        Row(
            'ours, `diagnose`: named',
            figures.named.heldout_rms_px,
            _whole(found, data.test),
            count,
            np.nan,
            ours=True,
        ),
        Row(
            'ours, `diagnose`: extended',
            figures.extended.heldout_rms_px,
            _whole(found, data.test, found.evaluation.offsets),
            count,
            np.nan,
            ours=True,
        ),
        *(_row(name, data, fair, start, lens.fx) for name in tools),
    ]


def _nominal(lens: fsvp.Lens, test: Observations, start: Localized) -> float:
    return rms(
        residuals(
            lambda points: fsvp.project(lens, points).uv, test.frame, test.xyz, test.uv, start.pose
        )
    )


def _whole(found: Diagnosis, test: Observations, local: PredictedOffsets | None = None) -> float:
    """Return the rms of all held-out points, outliers among them."""
    data, fit = group_by_frame(test), found.evaluation.fixed_model
    known = fit.data.observations.t
    terms = tuple(t for t in fit.state.terms if t.effect.holds_for(test.t, known))
    solved = localize_frames(data, replace(fit.state, terms=terms))
    return predict_other_data(data, solved, local).rms


def _row(name: str, data: Set, fair: Mask, start: Localized, focal: float) -> Row:
    """Return the row of the best lens that a tool has found."""
    try:
        with timed() as clock:
            found = TOOLS[name](data, grid_of(data), focal)
    except NotHereError as reason:
        return Row(name, np.nan, np.nan, 0, np.nan, str(reason))
    rows = [
        _scored(name, one, data.test, fair, start)._replace(seconds=clock.seconds) for one in found
    ]
    return min(rows, key=lambda row: row.rms_px)


def _scored(name: str, fitted: Fitted, test: Observations, fair: Mask, start: Localized) -> Row:
    near = incidence_degrees(test, start) < fitted.before
    apart = residuals(
        fitted.project, test.frame[near], fitted.places(test)[near], test.uv[near], start.pose
    )
    note = f'without {(~near).sum()} points beyond {fitted.before:.0f}°' * bool((~near).any())
    mine = fair[near]
    return Row(
        name,
        rms(apart[mine]),
        rms(apart),
        int(mine.sum()),
        np.nan,
        '; '.join(filter(None, (fitted.note, note))),
    )


def incidence_degrees(test: Observations, start: Localized) -> Array:
    """Return incidence angles (N,), degrees."""
    angle = np.empty(len(test))
    for i, number in enumerate(start.frame):
        mine = test.frame == number
        points = start.pose.take(i).into_body(test.xyz[mine])
        angle[mine] = np.degrees(np.arctan2(np.hypot(*points[:, :2].T), points[:, 2]))
    return angle


def section(data: Set, rows: list[Row]) -> list[str]:
    """Return the part of docs/results/compare.md on one set."""
    best = min(
        (row.rms_px for row in rows if not row.ours and np.isfinite(row.rms_px)), default=np.nan
    )
    boards = len(np.unique(data.train.board))
    held_out = len(np.unique(data.test.frame // BOARDS))
    lines = [
        f'## {data.name}',
        '',
        f'{len(data.train)} points in {len(data.train.frames)} frames of '
        f'{boards} board{"s" * (boards > 1)} to fit; {len(data.test)} in {held_out} frames held '
        'out.',
        '',
        '| model | held-out rms, px | beside the best of the others | points | with outliers, '
        'px | s | causes, notes |',
        '|---|---:|---:|---:|---:|---:|---|',
    ]
    for row in rows:
        figures = (
            f'{row.rms_px:.3f}',
            f'{row.rms_px / best:.2f}',
            f'{row.points or ""}',
            f'{row.whole_px:.3f}',
            f'{row.seconds:.1f}',
        )
        cells = ' | '.join('' if cell == 'nan' else cell for cell in figures)
        lines.append(f'| {row.model} | {cells} | {row.note} |')
    return [*lines, '']


def halves_table(found: dict[str, list[list[Row]]]) -> list[str]:
    """Return what lenses of one half predict in the other; found: the rows of halves, by set."""
    lines = [f'| model | {" | ".join(found)} |', f'|---|{"---:|" * len(found)}']
    for i, row in enumerate(next(iter(found.values()))[0]):
        cells = []
        for many in found.values():
            mine = [rows[i] for rows in many if np.isfinite(rows[i].rms_px)]
            pooled = (
                np.sqrt(
                    np.average(
                        [one.rms_px**2 for one in mine], weights=[one.points for one in mine]
                    )
                )
                if mine
                else np.nan
            )
            missing = f' ({len(mine)} of {len(many)})' * (len(mine) < len(many))
            cells.append(f'{pooled:.3f}{missing}' if mine else '-')
        lines.append(f'| {row.model} | {" | ".join(cells)} |')
    return lines


def page(
    sets: list[tuple[Set, list[Row]]], halves: list[str], apart: list[str], simulated: list[str]
) -> str:
    """Return the generated part of docs/results/compare.md."""
    lines = [_versions(), '']
    for data, rows in sets:
        lines += section(data, rows)
    return '\n'.join(
        [
            *lines,
            '## Half against half',
            '',
            *halves,
            '',
            '## Standard errors, half against half',
            '',
            *apart,
            '',
            f'## Standard errors, {SIMULATED} simulated sets',
            '',
            *simulated,
            '',
        ]
    )


def main() -> None:
    """Compare on every set that is there, write the page."""
    parser = study.parser('compare', __doc__, study.RESULTS / 'compare.md', room='peers')
    parser.add_argument('data', type=Path)
    parser.add_argument('--only', nargs='+', choices=SETS, default=list(SETS))
    asked = parser.parse_args()
    sets = [SETS[name](asked.data) for name in asked.only if (asked.data / name).is_dir()]
    # Whole sets one by one: their seconds are compared.
    rows = study.in_processes('comparing', compared, sets, 1)
    halves, pairs = (
        {data.name: list(parts(data)) for data in sets} for parts in (half_sets, all_pairs)
    )
    scores = iter(
        study.in_processes('halves', compared_half, [*chain(*halves.values())], asked.workers)
    )
    apart = iter(
        study.in_processes('errors', differences, [*chain(*pairs.values())], asked.workers)
    )
    simulated: dict[str, list[Difference]] = {}
    for one in study.in_processes('simulated', simulated_errors, range(SIMULATED), asked.workers):
        for kind, many in one.items():
            simulated.setdefault(kind, []).extend(many)
    text = page(
        list(zip(sets, rows, strict=True)),
        halves_table({name: [next(scores) for _ in many] for name, many in halves.items()}),
        honesty_table(
            {name: [one for _ in many for one in next(apart)] for name, many in pairs.items()}
        ),
        honesty_table(dict(sorted(simulated.items()))),
    )
    print(text)
    if asked.only == list(SETS):
        study.write_figures(asked.output, ['', text.rstrip('\n')])


def _versions() -> str:
    found = []
    for name in (
        'mrcal',
        'lensboy',
        'calibsense',
        'ds-msp',
        'opencv-python-headless',
        'numpy',
        'scipy',
    ):
        try:
            found.append(f'{name} {version(name)}')
        except PackageNotFoundError:
            found.append(f'{name} not installed')
    return ', '.join(found) + '.'


if __name__ == '__main__':
    # By its full name: processes that are spawned find nothing that is in `__main__`.
    import_module('benchmark.peers.compare').main()
