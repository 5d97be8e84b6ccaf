"""The frozen runs: what counts as a difference, and a run against itself."""

import json

import pytest

from benchmark.hardening.frozen import Case, compare, differences, outcome
from fisheye_svp_ros.io.files import write_json
from fisheye_svp_ros.io.share import lens_path


def kinds(before, after):
    return [kind for kind, _ in differences(before, after)]


@pytest.mark.parametrize(
    ('before', 'after', 'found'),
    [
        ({'rms': 0.5}, {'rms': 0.5 * (1 + 5e-7)}, []),
        ({'rms': 0.5}, {'rms': 0.5 * (1 + 5e-6)}, ['value']),
        ({'e0': 1e-3}, {'e0': 1e-3 + 5e-10}, []),
        ({'verdict': 'explained'}, {'verdict': 'adequate'}, ['value']),
        ({'causes': ['skew']}, {'causes': []}, ['value']),
        ({'causes': ['skew', 'aspect']}, {'causes': ['aspect', 'skew']}, ['value', 'value']),
        ({'rms': 0.5}, {'rms': 0.5, 'photographs': []}, ['new']),
        ({'rms': 0.5, 'gain': 0.1}, {'rms': 0.5}, ['value']),
        ('off by 1.25 px', 'off by 1.26 px', []),
        ('off by 1.25 px', 'off by 1.27 px', ['value']),
        ('off by 1.25 px', 'astray by 1.25 px', ['words']),
        ('off by 1.25 px', 'off by 1.25 px in 3 frames', ['value']),
        (None, 0.5, ['value']),
    ],
)
def test_what_counts_as_a_difference(before, after, found):
    assert kinds(before, after) == found


def test_a_run_is_the_same_again_and_a_change_is_told(tmp_path, capsys):
    arguments = ['lens', str(lens_path('fish214')), '-o', '{output}/lens.yaml']
    case = Case('lens', arguments)
    (tmp_path / 'inputs').mkdir()
    kept = outcome((case, str(tmp_path / 'inputs')))
    assert kept['written']['lens.yaml']['projection']['f'] > 0
    assert len(kept['written']['printed']) > 3
    write_json(tmp_path / 'cases.json', [case._asdict()])
    write_json(tmp_path / 'outcomes/lens.json', kept)
    assert compare(tmp_path, [], 1) == 0
    kept['written']['lens.yaml']['projection']['f'] += 0.01
    (tmp_path / 'outcomes/lens.json').write_text(json.dumps(kept))
    assert compare(tmp_path, ['lens'], 1) == 1
    assert 'value /lens.yaml/projection/f' in capsys.readouterr().out
