"""An option that would have no effect is refused, from one table."""

from __future__ import annotations

import argparse
from importlib import import_module

import pytest
from helpers.commands import refused

from fisheye_svp_ros.cli import COMMANDS
from fisheye_svp_ros.commands.applicability import RULES, check_options
from fisheye_svp_ros.errors import ParameterError

LINES = {
    'calibrate a.csv --board chessboard:3x3:1mm': '--board has no effect on a CSV file',
    'localize a.CSV --lens l.yaml --board chessboard:3x3:1mm': '--board has no effect on a CSV',
    'calibrate a.csv --every 2': '--every has an effect only on photographs',
    'localize a.csv --lens l.yaml --sync 1ms': '--sync has an effect only on photographs',
    'diagnose a.csv --lens l.yaml --split 2': '--split has an effect only on photographs',
    'diagnose bag.mcap --lens l.yaml --detector sb': '--detector has an effect',
    'calibrate a.csv --lens air.yaml': '--lens needs --medium',
    'calibrate a.csv --lens air.yaml --medium water --model equisolid': '--model has no effect',
    'calibrate a.csv --lens l --port flat --image-size 9x9': '--image-size has no effect',
    'diagnose a.csv --lens l.yaml --for e0': '--for needs --next N',
    'diagnose a.csv --lens l.yaml --room 0.1 1': '--room needs --next N',
    'lens l.yaml --format ros': '--format needs -o FILE',
    'lens l.yaml --range 1': '--range needs --format',
    'localize a.csv --lens l.yaml --rig r.yaml --model-error': '--model-error works for one',
    'render --lens l --board chessboard:9x6:1mm -o r --poses p.csv --count 3': '--count is for',
    'render --lens l --board chessboard:9x6:1mm -o r --target room --ranges 1 2': '--ranges is',
    'localize p --lens l.yaml --board chessboard:3x3:1mm --tag-map t.yaml': '--tag-map belongs to',
    'undistort l.yaml -o u --as cubemap --rig r.yaml': '--rig has no effect on views',
    'undistort l.yaml -o u --as perspective:9,0,60 --fov 60': '--fov has no effect on --as persp',
    'undistort l.yaml -o u --split 2': '--split has an effect only on photographs',
}
APPLIED = (
    'calibrate photographs --board chessboard:3x3:1mm --every 2 --sync 1ms --split 2',
    'calibrate bag.mcap --board chessboard:3x3:1mm --detector sb',
    'calibrate a.csv --model equisolid --image-size 640x480',
    'calibrate a.csv --every 1',
    'diagnose a.csv --lens l.yaml --held-out photographs --board chessboard:3x3:1mm',
    'diagnose a.csv --lens l.yaml --next 3 --for e0 --room 0.1 1',
    'render --lens l --board chessboard:9x6:1mm -o r --target cube --ranges 1 2 --count 3',
    'localize photographs --lens l.yaml --board tags:36h11 --tag-map t.yaml',
    'localize a.csv --lens l.yaml --tag-map t.yaml',
    'undistort l.yaml -o u --as cubemap --fov 100',
    'undistort l.yaml photographs -o u --split 2',
    'undistort --lens left=l --lens right=l photographs -o u --split 2',
)


def check(line: str) -> None:
    command, *words = line.split()
    parser = argparse.ArgumentParser()
    import_module(f'fisheye_svp_ros.commands.{command}').add_arguments(parser)
    check_options(command, parser.parse_args(words), parser)


@pytest.mark.parametrize('line', LINES)
def test_an_option_without_effect_is_refused(line: str) -> None:
    with pytest.raises(ParameterError, match=LINES[line]):
        check(line)


@pytest.mark.parametrize('line', APPLIED)
def test_an_option_that_applies_is_taken(line: str) -> None:
    check(line)


def test_each_rule_is_of_options_that_are_there_and_tried() -> None:
    tried = {(line.split()[0], reason.split()[0]) for line, reason in LINES.items()}
    for rule in RULES:
        assert {*rule.commands} <= {*COMMANDS}
        for option in rule.options:
            assert any((command, option) in tried for command in rule.commands)


def test_before_anything_is_read(capsys: pytest.CaptureFixture[str]) -> None:
    said = refused(capsys, 'calibrate', 'none.csv', '--image-size', '640x480', '--every', '3')
    assert said == (
        'fisheye-svp: --every has an effect only on photographs, with --board; leave it out'
    )
