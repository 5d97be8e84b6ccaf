"""architecture.md: its files and rooms are there, and its walks are those that are run."""

from __future__ import annotations

import re
from importlib import import_module
from itertools import groupby
from pathlib import Path

import pytest
from helpers.walks import PACKAGE, PAGE, files_run, room_of, walk

import fisheye_svp_ros as fsvp
from fisheye_svp_ros.cli import main
from fisheye_svp_ros.io.readers import write_observations
from fisheye_svp_ros.optics import engines

ROOT = PACKAGE.parent
WALKS = 'an observation', 'an `image_points` message', 'a scenario'


@pytest.fixture(scope='module')
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a table and the lens to diagnose it by."""
    folder = tmp_path_factory.mktemp('scene')
    seen = fsvp.simulate_scenario(
        lens='fish214', radius=0.5, noise_px=0.2, poses_file='calibration'
    )
    write_observations(folder / 'seen.csv', seen.observations)
    fsvp.save_lens(seen.lens.svp(), folder / 'lens.yaml')
    return folder


def test_the_page_names_every_room_and_what_is_there() -> None:
    page = PAGE.read_text(encoding='utf-8')
    paths = re.findall(r'`([\w./]+/[\w./]*|\w+\.(?:py|toml))`', page)
    assert len(paths) > 40
    for path in paths:
        assert (ROOT / path).exists() or (PACKAGE / path).exists(), path
    for room in PACKAGE.iterdir():
        if (room / '__init__.py').exists():
            assert re.search(rf'\b{re.escape(room.name)}\b', page), room.name
    for registry, home in (
        ('READERS', 'io/readers.py'),
        ('COMMANDS', 'cli.py'),
        ('_picture_tasks', 'paper/report.py'),
        ('CATALOGUE', 'effects/catalogue.py'),
        ('IMAGE_HEIGHTS', 'optics/curves.py'),
    ):
        assert registry in (PACKAGE / home).read_text()


@pytest.mark.parametrize('start', WALKS)
def test_no_walk_enters_a_room_twice(start: str) -> None:
    rooms = [name for name, _ in groupby(walk(start), room_of)]
    assert len(rooms) > 2 and len(set(rooms)) == len(rooms)


def test_an_observation_goes_to_its_cause(scene: Path) -> None:
    files = walk('an observation')
    assert files_run(lambda: diagnose(scene), files) == files


def test_a_scenario_goes_to_its_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(engines.VARIABLE, 'numpy')
    sweep = tmp_path / 'sweep.yaml'
    sweep.write_text('synthetic_camera:\n  ros__parameters:\n    sweep.radius: [2.0]\n')
    files = walk('a scenario')
    act = lambda: main(['sweep', str(sweep), '-o', str(tmp_path / 'out')])  # noqa: E731
    assert files_run(act, files) == files


def test_the_stages_of_a_diagnosis_are_made_one_after_the_other(
    scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Up to the selection when first made; from there on the last ones, as it tries several."""
    page = PAGE.read_text(encoding='utf-8').partition('## From a table to a named cause')[2]
    stages = re.findall(r'^ ([A-Z]\w+) +(\w+)\.py ', page, re.MULTILINE)
    names, made = [name for name, _ in stages], []
    for name, module in stages:
        kind = getattr(import_module(f'fisheye_svp_ros.diagnosis.{module}'), name)

        def note(self, *args, _name=name, _make=kind.__init__, **values):
            made.append(_name)
            _make(self, *args, **values)

        monkeypatch.setattr(kind, '__init__', note)
    diagnose(scene)
    middle = names.index('Selection')
    assert [name for name in dict.fromkeys(made) if name in names[: middle + 1]] == names[
        : middle + 1
    ]
    last = [*dict.fromkeys(reversed(made))][::-1]
    assert [name for name in last if name in names[middle:]] == names[middle:]


def diagnose(folder: Path) -> None:
    """Diagnose the scene of a folder by the command."""
    arguments = [folder / 'seen.csv', '--lens', folder / 'lens.yaml', '-o', folder / 'out']
    assert main(['diagnose', *map(str, arguments)]) == 0
