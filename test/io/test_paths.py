"""Paths as ROS and shells write them: package://, file://, ~."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import pytest

from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.landmark_files import load_landmarks
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.parameters import with_values
from fisheye_svp_ros.io.share import config_path, expand_path, typed_lens_path
from fisheye_svp_ros.simulate.scenario import Scenario
from fisheye_svp_ros.study.settings import LocalizerSettings, SolverSettings


def test_a_package_is_where_ament_has_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    packages = ModuleType('ament_index_python.packages')

    def find(name: str) -> str:
        if name != 'my_robot':
            raise LookupError(name)
        return str(tmp_path)

    packages.get_package_share_directory = find  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, 'ament_index_python', ModuleType('ament_index_python'))
    monkeypatch.setitem(sys.modules, 'ament_index_python.packages', packages)
    assert expand_path('package://my_robot/lenses/a%20b.yaml') == f'{tmp_path}/lenses/a b.yaml'
    with pytest.raises(ParameterError, match="package 'other' is not found; source its workspace"):
        expand_path('package://other/a.yaml')


def test_lens_and_map_of_parameters_take_them(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv('HOME', str(tmp_path))
    lens = config_path('lenses/fish180.yaml')
    (tmp_path / 'mine.yaml').write_bytes(lens.read_bytes())
    (tmp_path / 'map.csv').write_text('landmark,x,y,z\n1,0,0,1\n')
    given = 'package://fisheye_svp_ros/config/lenses/fish180.yaml'
    for name in (given, f'file://{lens}', '~/mine.yaml'):
        settings = with_values(LocalizerSettings(), {'lens': name})
        assert load_lens(settings.lens).name == load_lens(lens).name
        assert load_lens(typed_lens_path(name)).name == load_lens(lens).name
    scenario = with_values(Scenario(), {'environment': '~/map.csv'})
    assert load_landmarks(scenario.environment).ids.tolist() == [1]
    assert with_values(SolverSettings(), {'lens': 'fish214'}).lens == 'fish214'
