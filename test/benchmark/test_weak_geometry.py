"""The study of weak geometry: six geometries, and a page of what was measured."""

from benchmark.studies import weak_geometry


def test_the_page_holds_a_row_of_each_geometry(tmp_path):
    page = tmp_path / 'page.md'
    weak_geometry.main(['--poses', '30', '-o', str(page)])
    text = page.read_text()
    assert all(f'| {one.name} |' in text for one in weak_geometry.geometries())
    assert 'ARGS="--poses 30"' in text


def test_ellipsoids_hold_in_every_geometry():
    for geometry in weak_geometry.geometries():
        row = weak_geometry.trial(geometry, 60)
        assert float(row[1].split('/')[1]) >= 95.0, row
