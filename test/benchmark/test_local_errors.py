"""What is hidden in sets like real ones is found; rates are in docs/results/local_errors.md."""

from benchmark.studies.local_errors import draw_set, report, trial


def test_a_shift_is_found_beside_local_errors():
    found = trial(2)
    assert found['e0_mm'] == 7.0
    assert 'viewpoint_shift' in found['causes']
    assert abs(found['found_mm'] - 7.0) < 4 * found['stderr_mm'] < 6.0
    page = report([found])
    assert '| 7 | 0 | 1 | 1 |' in page
    assert '--trials 1`' in page


def test_a_set_is_what_it_says():
    (table, shift, bend, _), same = draw_set(4), draw_set(4)
    assert (shift, bend) == (3e-3, 4e-4)
    assert (table.uv == same.table.uv).all()
    assert 14 < len(table.frames) < 35
    assert len(table) < 54 * len(table.frames)
