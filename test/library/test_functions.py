"""The library: lazy names, results that are kept, the page that shows them."""

from __future__ import annotations

import contextlib
import io
import pkgutil
import re
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.nodes import ROOT

import fisheye_svp_ros as fsvp
from fisheye_svp_ros.cli import main
from fisheye_svp_ros.errors import ObservationError, ParameterError
from fisheye_svp_ros.library.results import Columns, Localized, Result, Simulated

_BLOCK = re.compile(r'```python\n(.*?)```(?:\n\n```text\n(.*?)```)?', re.DOTALL)


@pytest.fixture(scope='module')
def seen() -> Simulated:
    """Return ten views of a lens with a shift."""
    return fsvp.simulate_scenario(
        lens='fish214', radius=0.5, noise_px=0.2, poses_file='calibration'
    )


@pytest.fixture(scope='module')
def pair() -> Simulated:
    """Return ten views of a rig."""
    return fsvp.simulate_scenario(
        lens='fish214', radius=0.5, style='vergent', noise_px=0.2, poses_file='calibration'
    )


RECORDINGS = ('rosbags', 'mcap', 'apsw', 'zstandard')


@pytest.mark.parametrize(
    ('statement', 'heavy'),
    [
        (
            'import fisheye_svp_ros as f; dir(f); f.__version__',
            ('numpy', 'scipy', 'matplotlib', 'numba', 'pyarrow', 'yaml', 'cv2', *RECORDINGS),
        ),
        ('import fisheye_svp_ros.commands.paper', ('numpy',)),
        (
            'import fisheye_svp_ros.library.functions, fisheye_svp_ros.commands.sweep',
            (*RECORDINGS, 'pandas'),
        ),
    ],
)
def test_what_is_not_needed_is_not_loaded(statement: str, heavy: tuple[str, ...]) -> None:
    code = f'import sys; {statement}; print(sorted({{m.partition(".")[0] for m in sys.modules}}))'
    loaded = subprocess.run(
        [sys.executable, '-c', code], cwd=ROOT, check=True, text=True, capture_output=True
    ).stdout
    for name in heavy:
        assert f"'{name}'" not in loaded


def test_names_are_there_and_typed_and_no_modules() -> None:
    modules = {module.name for module in pkgutil.iter_modules(fsvp.__path__)}
    stub = (ROOT / 'fisheye_svp_ros' / '__init__.pyi').read_text()
    # The room `detect` can be called: it is module and function in one, which no stub can say.
    assert set(re.findall(r' as (\w+)$', stub, re.MULTILINE)) == set(fsvp.__all__) - {'detect'}
    assert modules & set(fsvp.__all__) == {'detect'} and callable(fsvp.detect)
    assert set(fsvp.__all__) <= set(dir(fsvp))
    for name in fsvp.__all__:
        assert getattr(fsvp, name).__name__.rpartition('.')[2] == name
    with pytest.raises(AttributeError, match='nonsense'):
        _ = fsvp.nonsense


@pytest.mark.parametrize(
    ('page', 'blocks'), [('reference/library.md', 6), ('how_to/undistort.md', 1)]
)
def test_a_page_runs_as_printed(
    page: str, blocks: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    found = _BLOCK.findall((ROOT / 'docs' / page).read_text())
    assert len(found) == blocks
    for code, expected in found:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(code, names)
        assert printed.getvalue() == expected


def test_axes_viewpoint_rig_and_poses_are_those_of_the_conventions() -> None:
    lens = fsvp.load_lens('fish214')
    right_of_axis, below_axis = np.eye(3)[[0, 1]] + [0, 0, 1]
    u, v = fsvp.project(lens, np.array([right_of_axis, below_axis])).uv.T
    assert u[0] > lens.cx and v[1] > lens.cy  # u right, v down
    rays = fsvp.back_project(lens, np.array([[u[0], v[0]], [lens.cx, lens.cy]]))
    assert rays.origin[0, 2] > rays.origin[1, 2]  # the viewpoint moves towards the scene
    np.testing.assert_array_equal(fsvp.rig('parallel', 0.15).position, [-0.15, 0.0, 0.0])
    seen = fsvp.simulate_scenario(
        lens='fish214', radius=2.0, poses=(0.0, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0)
    )
    np.testing.assert_array_equal(seen.pose.position[0], [0.0, 0.0, 0.1])
    np.testing.assert_array_equal(seen.pose.rotation[0] @ [0, 0, 1], [0.0, 0.0, -1.0])
    found = fsvp.localize(seen.observations, lens)  # in the world, not its inverse
    np.testing.assert_allclose(found.pose.position, seen.pose.position, atol=1e-9)


def test_a_rig_is_as_uncertain_as_its_residuals_say(pair: Simulated) -> None:
    lens, table = fsvp.load_lens('fish214'), pair.observations
    assert pair.rig is not None
    found, known = (
        fsvp.calibrate_stereo(replace(table, sigma=np.full(len(table), sigma)), lens, lens)
        for sigma in (np.nan, 0.2)
    )
    np.testing.assert_allclose(found.covariance, known.covariance, rtol=0.1)
    off = found.rig.difference(pair.rig)
    assert 1 < off @ np.linalg.solve(found.covariance, off) < 20  # chi-square of 6


def _results(seen: Simulated, pair: Simulated) -> list[Result]:
    svp = seen.lens.svp()
    rig = pair.rig
    assert rig is not None
    return [
        seen,
        pair,
        fsvp.localize(seen.observations, svp),
        fsvp.calibrate(seen.observations, 'equidistant', (1536, 1536)),
        fsvp.calibrate_stereo(pair.observations, svp, svp),
        fsvp.stereo_depth(pair.observations, svp, svp, rig),
        fsvp.sweep({'radius': [0.5, 2.0]}),
        fsvp.budget('fish180'),
        fsvp.diagnose(seen.observations, seen.lens),
        fsvp.compare(seen.lens, svp),
    ]


def test_results_come_back(seen: Simulated, pair: Simulated, tmp_path: Path) -> None:
    results = _results(seen, pair)
    kinds = {kind for kind in Result.__subclasses__() if kind.__module__ == Simulated.__module__}
    assert {type(one) for one in results} == kinds
    for one in results:
        one.save(tmp_path / 'result.json')
        again = type(one).load(tmp_path / 'result.json')
        for field in fields(one):  # type: ignore[arg-type]
            kept, was = getattr(again, field.name), getattr(one, field.name)
            if isinstance(was, fsvp.Lens):  # its file holds degrees
                assert kept.max_incidence == pytest.approx(was.max_incidence, rel=1e-15)
                kept = replace(kept, max_incidence=was.max_incidence)
            assert repr(kept) == repr(was)
        assert list(map(repr, again.table().rows())) == list(map(repr, one.table().rows()))
        frame = one.table().to_dataframe()
        assert list(frame) == list(one.table()) and len(frame) == len(list(one.table().rows()))


def test_a_file_that_is_no_such_result(seen: Simulated, tmp_path: Path) -> None:
    seen.save(tmp_path / 'seen.json')
    for name in ('seen.json', 'none.json'):
        with pytest.raises(ObservationError, match=name):
            Localized.load(tmp_path / name)


def test_localize_says_what_the_command_says(seen: Simulated, tmp_path: Path) -> None:
    table = tmp_path / 'observations.csv'
    fsvp.write_observations(table, seen.observations)
    assert main(['localize', str(table), '--lens', 'fish214', '-o', str(tmp_path)]) == 0
    found = fsvp.localize(table, 'fish214')
    told = fsvp.read_poses(tmp_path / 'poses.csv')
    np.testing.assert_array_equal(told.frame, found.frame)
    np.testing.assert_allclose(told.pose.position, found.pose.position, atol=1e-12)
    assert found.residual.shape == seen.observations.uv.shape
    assert np.nanmax(np.abs(found.residual)) < 1.0


def test_calibrate_writes_the_lens_of_the_command(seen: Simulated, tmp_path: Path) -> None:
    table = tmp_path / 'observations.csv'
    fsvp.write_observations(table, seen.observations)
    said = ['--model', 'equidistant', '--image-size', '1536x1536', '-o', str(tmp_path / 'a.yaml')]
    assert main(['calibrate', str(table), *said]) == 0
    found = fsvp.calibrate(table, 'equidistant', (1536, 1536), name='a')
    fsvp.save_lens(found.lens, tmp_path / 'b.yaml')
    assert (tmp_path / 'b.yaml').read_text() == (tmp_path / 'a.yaml').read_text()
    errors = (found.lens.calibration or {})['stderr']
    assert list(found.table()['standard_error']) == pytest.approx([*errors.values()])


def test_an_unknown_parameter_is_refused() -> None:
    with pytest.raises(TypeError, match="unexpected keyword argument 'noise'"):
        fsvp.simulate_scenario(noise=0.1)
    with pytest.raises(ParameterError, match="'radii' is not a parameter"):
        fsvp.sweep({'radii': [1.0]})
    known = r"'lense' is not a parameter of localizer; choose from .*lens"
    with pytest.raises(ParameterError, match=known):
        fsvp.sweep({'radius': [1.0]}, localizer={'lense': 'fish180'})
    with pytest.raises(TypeError, match="unexpected keyword argument 'solver'"):
        fsvp.sweep({'radius': [1.0]}, solver={})


def test_points_of_another_shape_are_refused() -> None:
    with pytest.raises(ParameterError, match=r'points has the shape \(4, 2\)'):
        fsvp.project('fish180', np.zeros((4, 2)))
    with pytest.raises(ParameterError, match=r'uv has the shape \(3,\); \(\.\.\., 2\) is needed'):
        fsvp.back_project('fish180', np.zeros(3))


def test_columns(tmp_path: Path) -> None:
    columns = Columns({'frame': np.arange(2), 'x': [0.5, None]})
    assert columns == {'frame': [0, 1], 'x': [0.5, None]}
    assert list(columns.rows()) == [(0, 0.5), (1, None)]
    assert str(columns) == 'frame     x\n    0   0.5\n    1  None'
