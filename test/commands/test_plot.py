"""Pictures of tables and sweeps, and the numbers behind them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread

from fisheye_svp_ros.cli import main
from fisheye_svp_ros.io.columns import arrow, make_table, write_table
from fisheye_svp_ros.io.decoding import RESIDUALS, structured_array
from fisheye_svp_ros.reporting.sweep_plots import draw_residuals, draw_table
from fisheye_svp_ros.study.dependence import curves, grid, noise_spreads, swept_parameters
from fisheye_svp_ros.study.solutions import DRAWN_METRICS
from fisheye_svp_ros.study.sweep import SOLVERS, plan_sweep, sweep_rows

TABLE = make_table(
    {
        'radius': [1.0, 1.0, 2.0, 2.0, 1.0, 2.0],
        'environment': ['a', 'a', 'a', 'a', 'b', 'b'],
        'seed': [0, 1, 0, 1, 0, 0],
        'shift_scale': [1.0] * 6,
        'localizer.rms_px': [1.0, 3.0, 5.0, None, -7.0, 8.0],
    }
)


def test_what_was_swept_is_what_differs_but_for_seeds() -> None:
    assert swept_parameters(TABLE) == ['environment', 'radius']


def test_curves_are_medians_over_the_rest() -> None:
    one, other = curves(TABLE, 'localizer.rms_px', 'radius', ['environment'])
    assert (one.key, one.x, one.median.tolist()) == (('a',), [1.0, 2.0], [2.0, 5.0])
    assert (other.key, other.median.tolist()) == (('b',), [-7.0, 8.0])
    assert one.low[0] == pytest.approx(1.1) and one.high[0] == pytest.approx(2.9)


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Return the figures that a test draws, in their order; no file is written."""
    drawn: list[Figure] = []

    @contextmanager
    def kept(path: Path, width: float, height: float) -> Iterator[Figure]:
        drawn.append(Figure())
        yield drawn[-1]

    monkeypatch.setattr('fisheye_svp_ros.reporting.sweep_plots.picture', kept)
    monkeypatch.setattr('fisheye_svp_ros.reporting.sweep_plots.legend_below', lambda *_: None)
    return drawn


def test_a_picture_shows_no_more_curves_than_can_be_told_apart(
    tmp_path: Path, figures: list[Figure]
) -> None:
    rows = list(product([1.0, 2.0], range(7), 'abc'))
    radius, scale, environment = (list(column) for column in zip(*rows, strict=True))
    draw_table(
        make_table(
            {
                'radius': radius,
                'shift_scale': scale,
                'environment': environment,
                'localizer.rms_px': [float(i) for i in range(len(rows))],
            }
        ),
        tmp_path,
    )
    figure = next(one for one in figures if one.axes[0].get_xlabel().startswith('range'))
    labels = [line.get_label() for line in figure.axes[0].lines]
    assert labels == [
        f'shift_scale {i}, environment {name}' for i in (0, 2, 4, 6) for name in 'ac'
    ]
    assert '4 of 7 values of shift_scale; 2 of 3 values of environment' in str(figure.texts)


def test_a_grid_holds_magnitudes() -> None:
    x, y, median = grid(TABLE, 'localizer.rms_px', 'environment', 'radius')
    assert (x, y) == (['a', 'b'], [1.0, 2.0])
    assert median.tolist() == [[2.0, 7.0], [5.0, 8.0]]


def test_of_calibrations_only_those_of_all_sets_count() -> None:
    table = make_table(
        {
            'radius': [1.0] * 3,
            'set': [0, 1, 2],
            'sets': [3, 3, 3],
            'stereo_calibrator.position_error_m': [9.0, 8.0, 1.0],
        }
    )
    (curve,) = curves(table, 'stereo_calibrator.position_error_m', 'radius', [])
    assert curve.median.tolist() == [1.0]


def test_noise_alone_leaves_what_is_predicted() -> None:
    plan = plan_sweep(
        {
            'synthetic_camera': {'noise_px': 0.2, 'sweep.seed': list(range(300))},
            'localizer': {'svp': False},
        }
    )
    (spread,) = noise_spreads(sweep_rows(plan, range(300)), None)
    step = spread.at[1] - spread.at[0]
    assert spread.density.sum() * step == pytest.approx(1.0, abs=1e-6)
    mean = (spread.at * spread.density).sum() * step
    deviation = np.sqrt(((spread.at - mean) ** 2 * spread.density).sum() * step)
    assert abs(spread.ratio.mean() - mean) < 4 * deviation / np.sqrt(300)
    assert spread.ratio.std() == pytest.approx(deviation, rel=0.2)


def test_a_sweep_is_drawn_against_everything_that_was_swept(tmp_path: Path, drawn: None) -> None:
    path = tmp_path / 'file.yaml'
    path.write_text(
        'synthetic_camera: {ros__parameters: {sweep.radius: [2.0, 0.5, 0.2], '
        'noise_px: 0.5, sweep.shift_scale: [0.0, 1.0], sweep.seed: [1, 2, 3]}}'
    )
    assert main(['sweep', str(path), '-o', str(tmp_path / 'out')]) == 0
    assert main(['plot', str(tmp_path / 'out'), '-o', str(tmp_path / 'plots')]) == 0
    names = [
        'error_against_radius.png',
        'error_against_shift_scale.png',
        'heat_map_shift_scale_radius.png',
        'residuals_and_noise.png',
    ]
    assert sorted(p.name for p in (tmp_path / 'plots').iterdir()) == names
    for name in names:
        image = imread(tmp_path / 'plots' / name)
        assert image.shape[1] > 500 and np.ptp(image) > 0.5


def test_a_table_is_found_in_its_folder(tmp_path: Path) -> None:
    write_table(tmp_path / 'table', TABLE)
    assert main(['plot', str(tmp_path), '-o', str(tmp_path / 'plots')]) == 0
    assert (tmp_path / 'plots' / 'error_against_radius.png').exists()


def test_a_rig_is_drawn(tmp_path: Path) -> None:
    plan = plan_sweep({'synthetic_camera': {'style': 'parallel', 'sweep.baseline': [0.1, 0.2]}})
    files = draw_table(sweep_rows(plan, range(2)), tmp_path)
    assert [p.name for p in files] == ['error_against_baseline.png']


def test_every_metric_that_is_to_be_drawn_has_its_curve(figures: list[Figure]) -> None:
    columns = [f'{node}.{name}' for node, solver in SOLVERS.items() for name in solver.metrics]
    table = make_table({'radius': [1.0, 2.0], **{name: [1.0, 2.0] for name in columns}})
    draw_table(table, Path())
    titles = [axis.get_title('left') for axis in figures[0].axes]
    drawn = [name for name in columns if name.partition('.')[2] in DRAWN_METRICS]
    assert len(titles) == len(drawn) and {*DRAWN_METRICS} <= {n.partition('.')[2] for n in drawn}
    assert 'Stereo depth: error2, px' in titles and 'Localizer: position error, mm' in titles


def test_residuals_are_drawn_against_angle_and_range(tmp_path: Path, drawn: None) -> None:
    columns = [np.linspace(0.1, 1.0, 50)] * 6
    cloud = structured_array(RESIDUALS, np.arange(50), *columns)
    pictures = []
    for lenses in (['', '', ''], ['a', 'b', 'b']):
        draw_residuals(tmp_path / 'a.png', [cloud] * 3, lenses)
        pictures.append(imread(tmp_path / 'a.png'))
    assert pictures[0].shape[1] > 500
    # Colors of their own and a legend tell lenses apart.
    assert len(np.unique(pictures[1].reshape(-1, 4), axis=0)) > (
        len(np.unique(pictures[0].reshape(-1, 4), axis=0))
    )


def test_a_table_in_which_nothing_differs_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_table(tmp_path / 'table', make_table({'radius': [1.0], 'localizer.rms_px': [0.5]}))
    for name in ('table.csv', *(['table.parquet'] if arrow()[0] else [])):
        assert main(['plot', str(tmp_path / name), '-o', str(tmp_path / 'out')]) == 2
        assert 'nothing to draw' in capsys.readouterr().err
    (tmp_path / 'bad.parquet').write_text('no')
    assert main(['plot', str(tmp_path / 'bad.parquet')]) == 2
    # Without pyarrow the reason is another one.
    assert ('not a table' if arrow()[0] else 'give the .csv') in capsys.readouterr().err
