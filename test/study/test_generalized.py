"""The lens that `calibrate` writes: not bent to the board where that errs, as before where not."""

import numpy as np
import pytest
from helpers.sagging import photographs
from helpers.water import AIR

import fisheye_svp_ros as fsvp
from benchmark.study import ray_error
from fisheye_svp_ros.cli import main
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.readers import write_observations
from fisheye_svp_ros.reporting.wording.calibration import estimate_sentence
from fisheye_svp_ros.solve.ray_errors import typical_points

SIZE = AIR.width, AIR.height


def both(table):
    """Return the lens of least squares, that of `calibrate`, and their ray errors, mrad."""
    found = [fsvp.calibrate(table, 'kannala_brandt', SIZE, plain=plain) for plain in (True, False)]
    uv = typical_points(table.uv)
    return found, [ray_error(one.lens, AIR, uv) for one in found]


@pytest.mark.parametrize('seed', [2, 5])
def test_a_bent_board_does_not_bend_the_lens(seed):
    found, (plain, general) = both(photographs(seed, 0.0, 2e-3))
    assert general < 0.5 * plain
    least, figures = (one.lens.calibration for one in found)
    assert figures['least_squares_rms_px'] == least['rms_px'] < figures['rms_px']
    assert 'least_squares_rms_px' not in least and not estimate_sentence(least)
    words = estimate_sentence(figures)
    assert f'{figures["rms_px"]:.4f} px' in words and f'{least["rms_px"]:.4f} px' in words


@pytest.mark.parametrize('seed', [2, 5])
def test_a_flat_board_costs_nothing(seed):
    found, (plain, general) = both(photographs(seed, 0.0))
    assert general < 1.25 * plain  # .02 mrad both
    moved = np.subtract(*(list(one.lens.parameters.values()) for one in found))
    errors = [found[1].lens.calibration['stderr'].get(n, np.inf) for n in found[1].lens.parameters]
    assert (np.abs(moved) < 0.5 * np.array(errors)).all()


def test_the_command_says_why_its_residual_is_larger_and_plain_keeps_least_squares(
    tmp_path, capsys
):
    table = photographs(2, 0.0, 2e-3)
    write_observations(tmp_path / 'seen.csv', table)
    lenses = []
    for name in ('general', 'plain'):
        asked = ['--plain'] if name == 'plain' else []
        path = tmp_path / f'{name}.yaml'
        size = f'{SIZE[0]}x{SIZE[1]}'
        seen = str(tmp_path / 'seen.csv')
        assert not main(['calibrate', seen, '--image-size', size, '-o', str(path), *asked])
        text, page = capsys.readouterr().out, path.with_suffix('.calibrate.html').read_text()
        told = 'absorbs board errors into the lens'
        assert (told in text) == (told in page) == (name == 'general')
        lenses.append(load_lens(path))
    least = fsvp.calibrate(table, 'kannala_brandt', SIZE, plain=True).lens
    assert lenses[1].parameters == pytest.approx(least.parameters, rel=1e-6)
    assert abs(lenses[0].fx - least.fx) > 1e-3
