"""Every parameter of every node, with the values that break it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.graph import Graph, set_parameter

from fisheye_svp_ros.errors import FisheyeSvpError, ParameterError
from fisheye_svp_ros.io.parameters import Row, read_parameter_file, rows, sweep_of, with_values
from fisheye_svp_ros.io.rig_files import save_rig
from fisheye_svp_ros.nodes import NODES
from fisheye_svp_ros.scene.rigs import rig
from fisheye_svp_ros.simulate.scenario import Scenario
from fisheye_svp_ros.study.settings import SolverSettings

ROOT = Path(__file__).resolve().parents[2]
OBSERVATIONS = 'frame,landmark,u,v,x,y,z\n' + ''.join(
    f'0,{i},{100 + 7 * i},{200 - 3 * i},{0.1 * i},{0.01 * i * i},1\n' for i in range(6)
)


def node_class(name: str) -> Any:
    module = import_module(f'fisheye_svp_ros.nodes.{name}')
    return getattr(module, ''.join(word.title() for word in name.split('_')))


TABLES = {
    name: rows(node_class(name).SETTINGS)
    for name in NODES
    if (ROOT / f'fisheye_svp_ros/nodes/{name}.py').exists()
}


@pytest.fixture
def start(ros_domain: int, tmp_path: Path) -> Iterator[Callable[..., Any]]:
    """Return a function that starts a node with parameters."""
    graphs = []
    measured = tmp_path / 'observations.csv'
    measured.write_text(OBSERVATIONS)
    save_rig(rig('parallel'), tmp_path / 'rig.yaml')

    def run(name: str, *arguments: str) -> Any:
        graph = Graph(
            '-p',
            f'measured_camera:observations:={measured}',
            '-p',
            f'rig_localizer:rig:={tmp_path}/rig.yaml',
            *arguments,
        )
        graphs.append(graph)
        return graph.start(node_class(name))

    yield run
    for graph in graphs:
        graph.close()


def wrong_type(row: Row) -> Any:
    return 'text' if not isinstance(row.default, str) else 3


def outside(row: Row) -> list[Any]:
    if row.choices:
        return [word for word in ('nonsense', '') if word not in row.choices]
    if row.low is None or row.high is None:
        return []
    kind = type(row.default)
    step = 1 if kind is int else 0.01 * (row.high - row.low)
    numbers = [kind(row.low - step), kind(row.high + step)]
    return numbers if kind is int else [*numbers, math.nan, math.inf, -math.inf]


@pytest.mark.parametrize('name', TABLES)
def test_every_parameter_is_described_and_refuses_what_breaks_it(
    name: str, start: Callable[..., Any]
) -> None:
    node = start(name)
    for row in TABLES[name]:
        described = node.describe_parameter(row.name)
        assert described.description.startswith(row.description)
        assert described.description.endswith(f' [{row.unit}]') or not row.unit
        ranges = [*described.integer_range, *described.floating_point_range]
        assert [(r.from_value, r.to_value) for r in ranges] == (
            [] if row.low is None else [(row.low, row.high)]
        )
        assert described.additional_constraints == (row.constraint() if row.choices else '')
        before = node.get_parameter(row.name).value
        for value in (wrong_type(row), *outside(row)):
            result = set_parameter(node, row.name, value)
            assert not result.successful, (row.name, value)
            assert row.name in result.reason or 'type' in result.reason
            assert node.get_parameter(row.name).value == before
        assert described.read_only == row.fixed


@pytest.mark.parametrize(
    ('name', 'parameter', 'value', 'reason'),
    [
        ('synthetic_camera', 'lens', 'nothere', "'nothere' is neither a file"),
        ('synthetic_camera', 'environment', 'cellar', "environment 'cellar' is unknown"),
        ('synthetic_camera', 'environment', 'nothere.csv', 'start it with folder:=DIR'),
        ('synthetic_camera', 'poses', [0.0] * 6, 'poses holds 6 numbers; seven a pose are needed'),
        ('synthetic_camera', 'poses', [0.0] * 7, 'the quaternion of pose 0 has norm 0, not 1'),
        ('synthetic_camera', 'poses', [math.nan] * 7, 'poses is nan; a finite number is needed'),
        ('synthetic_camera', 'poses_file', 'nothere.csv', 'start it with folder:=DIR'),
        ('measured_camera', 'observations', '', 'observations is empty; name the file to replay'),
        ('measured_camera', 'observations', 'nothere.csv', 'start it with folder:=DIR'),
        ('measured_camera', 'true_poses', 'nothere.csv', 'start it with folder:=DIR'),
        ('measured_camera', 'lens', 'nothere', "'nothere' is neither a file"),
        ('localizer', 'lens', 'nothere', "'nothere' is neither a file"),
        ('stereo_calibrator', 'lens', 'nothere', "'nothere' is neither a file"),
        ('stereo_depth', 'lens', 'nothere', "'nothere' is neither a file"),
        (
            'stereo_depth',
            'rig',
            'fals',
            "rig is 'fals'; true, topic or the file of a rig is needed",
        ),
        (
            'rectifier',
            'rig',
            'x',
            "rig is 'x', but stereo is false; start the node with stereo:=true",
        ),
        (
            'detector',
            'board_frame',
            '/board',
            "board_frame is '/board'; a frame id begins without a",
        ),
    ],
)
def test_a_value_that_cannot_be_used_is_refused_with_the_reason(
    name: str, parameter: str, value: Any, reason: str, start: Callable[..., Any]
) -> None:
    node = start(name)
    before = node.get_parameter(parameter).value
    result = set_parameter(node, parameter, value)
    assert not result.successful and reason in result.reason and '\n' not in result.reason
    assert node.get_parameter(parameter).value == before
    assert set_parameter(node, 'wait_for_subscribers', 3).successful
    assert node.settings.wait_for_subscribers == 3


def test_a_good_value_is_taken_into_use(start: Callable[..., Any]) -> None:
    node = start('localizer')
    assert set_parameter(node, 'lens', 'fish180').successful
    assert set_parameter(node, 'svp', True).successful
    assert node.settings.lens == 'fish180' and node.settings.svp == 'true'


def test_a_whole_number_is_taken_for_a_floating_point_parameter(start: Callable[..., Any]) -> None:
    node = start('synthetic_camera')
    for name, value in (('rate', 1), ('poses', [0, 0, 0, 1, 0, 0, 0])):
        assert set_parameter(node, name, value).successful, name
    assert (node.settings.rate, node.settings.poses) == (1.0, (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    assert isinstance(node.get_parameter('rate').value, float)
    assert not set_parameter(node, 'rate', -1).successful
    assert not set_parameter(node, 'seed', 1.5).successful


def test_a_parameter_of_ros_itself_starts_nothing_over(start: Callable[..., Any]) -> None:
    camera = start('synthetic_camera')
    steps = camera._steps
    assert set_parameter(camera, 'use_sim_time', False).successful
    assert camera._steps is steps
    assert set_parameter(camera, 'noise_px', 0.1).successful
    assert camera._steps is not steps


@pytest.mark.parametrize(
    ('arguments', 'solves_svp', 'said'),
    [
        ((), True, 'the lens that scenario names without its viewpoint shift (svp: auto)'),
        (('lens:=fish180',), False, 'the lens fish180 with its viewpoint shift (svp: auto)'),
        (
            ('lens:=fish180', 'svp:=true'),
            True,
            'lens fish180 without its viewpoint shift (svp: true)',
        ),
        (('lens:=fish180', "svp:='true'"), True, 'without its viewpoint shift (svp: true)'),
        (
            ('svp:=false',),
            False,
            'the lens that scenario names with its viewpoint shift (svp: false)',
        ),
    ],
)
def test_a_node_says_which_lens_it_solves_with(
    arguments: tuple[str, ...],
    solves_svp: bool,
    said: str,
    start: Callable[..., Any],
    capfd: pytest.CaptureFixture[str],
) -> None:
    node = start('localizer', *(word for one in arguments for word in ('-p', one)))
    assert node.settings.solves_svp is solves_svp
    if node.settings.lens:
        points = SimpleNamespace(
            xyz=np.zeros((1, 3)), uv=np.full((1, 2), 500.0), landmark=np.zeros(1, int), tag=None
        )
        shift = node.model(0, {'image_points': points}).lens.viewpoint_shift
        assert (shift is None) is solves_svp
    assert said in ' '.join(capfd.readouterr().err.split())


@pytest.mark.parametrize(
    ('name', 'argument', 'reason'),
    [
        (
            'localizer',
            'camera_frame:=/a',
            "camera_frame is '/a'; a frame id begins without a slash",
        ),
        (
            'localizer',
            'camera_frame:=a b',
            "camera_frame is 'a b'; a frame id begins without a slash",
        ),
        (
            'measured_camera',
            'world_frame:=/map',
            "world_frame is '/map'; a frame id begins without",
        ),
        ('model_critic', 'output:=/tmp', "output is '/tmp', a folder; name a file"),
    ],
)
def test_a_node_does_not_start_with_a_wrong_name(
    name: str, argument: str, reason: str, start: Callable[..., Any]
) -> None:
    with pytest.raises(ParameterError, match=f'^{reason}'):
        start(name, '-p', argument)


@pytest.mark.parametrize(
    ('argument', 'reason'),
    [
        ('rate:=0.0', 'rate'),
        ('style:=triple', 'style'),
        ('poses:=[1.0]', 'seven a pose'),
        ('sweep.rate:=[1.0]', 'no such parameter to sweep'),
        ('sweep.poses:=[1.0]', 'no such parameter to sweep'),
        ('sweep.radius:=[1.0, -1.0]', 'radius is -1.0; allowed is 0.001 to 1e+06'),
        ('sweep.radius:=[near]', "radius is 'near'; a number is needed"),
        ('sweep.radius:=2.0', 'a list of at least one value is needed'),
        ('sweep.lens:=[fish180, fish999]', "'fish999' is neither a file"),
        ('sweep.environment:=[whole, cellar]', "environment 'cellar' is unknown"),
        ('sweep.style:=[mono, triple]', "style is 'triple'"),
    ],
)
def test_a_node_does_not_start_with_what_it_cannot_use(
    argument: str, reason: str, start: Callable[..., Any]
) -> None:
    from rclpy.exceptions import ParameterException

    with pytest.raises((FisheyeSvpError, ParameterException)) as caught:
        start('synthetic_camera', '-p', argument)
    assert reason in str(caught.value)


def test_svp_is_one_of_three_words(start: Callable[..., Any]) -> None:
    with pytest.raises(ParameterError, match=r"^svp is 'maybe'; allowed is one of auto, true"):
        start('localizer', '-p', 'svp:=maybe')
    table = SolverSettings()
    assert [with_values(table, {'svp': value}).svp for value in (True, False, 'auto')] == [
        'true',
        'false',
        'auto',
    ]
    with pytest.raises(ParameterError, match='lens is True; text is needed'):
        with_values(table, {'lens': True})


def test_the_true_rig_may_be_named_without_quotes(start: Callable[..., Any]) -> None:
    node = start('stereo_depth', '-p', 'rig:=true')
    assert node.settings.rig == 'true'
    assert set_parameter(node, 'rig', 'topic').successful
    assert set_parameter(node, 'rig', True).successful and node.settings.rig == 'true'
    assert not set_parameter(node, 'rig', False).successful


def test_an_empty_list_to_sweep_is_refused() -> None:
    with pytest.raises(ParameterError, match=r'sweep.radius is \[\]; a list of at least one'):
        sweep_of(Scenario, {'sweep.radius': []})


def test_a_sweep_is_the_product_of_its_lists_the_last_fastest() -> None:
    sweep = sweep_of(Scenario, {'sweep.radius': [2, 0.5], 'sweep.seed': [1, 2, 3], 'radius': 7.0})
    assert len(sweep) == 6
    assert [(p['radius'], p['seed']) for p in sweep] == [
        (2.0, 1),
        (2.0, 2),
        (2.0, 3),
        (0.5, 1),
        (0.5, 2),
        (0.5, 3),
    ]
    assert with_values(Scenario(), next(iter(sweep))).seed == 1


def test_a_parameter_that_means_nothing_is_named(
    start: Callable[..., Any], capfd: pytest.CaptureFixture[str]
) -> None:
    start('localizer', '-p', 'lenz:=fish180', '-p', 'noise_px:=1.0')
    said = capfd.readouterr().err
    assert "parameter 'lenz' is unknown to this node; did you mean 'lens'?" in said
    assert "parameter 'noise_px' is unknown to this node; choose from " in said


def test_what_a_file_says_of_all_nodes_may_be_for_others(
    start: Callable[..., Any],
    capfd: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    file = tmp_path / 'all.yaml'
    file.write_text(
        '/**: {ros__parameters: {noise_px: 1.0, camera.exposure: 7, patence: 1.0}}\n'
        'localizer: {ros__parameters: {radius: 1.0}}\n'
    )
    monkeypatch.setattr('sys.argv', ['localizer', '--ros-args', '--params-file', str(file)])
    start('localizer', '--params-file', str(file))
    said = capfd.readouterr().err
    assert 'noise_px' not in said and 'exposure' not in said
    assert "'patence' is unknown to this node; did you mean 'patience'?" in said
    assert "'radius' is unknown to this node; choose from" in said


@pytest.mark.parametrize(
    ('node', 'words', 'wanted'),
    [
        (
            'synthetic_camera',
            ('noise_px:=1', 'radius:=2', 'rate:=50'),
            {'noise_px': 1.0, 'radius': 2.0, 'rate': 50.0},
        ),
        (
            'synthetic_camera',
            ('poses:=[0, 0, 0, 1, 0, 0, 0]',),
            {'poses': [0.0, 0, 0, 1, 0, 0, 0]},
        ),
        ('synthetic_camera', ('sweep.radius:=[2, 1]',), {'sweep.radius': [2.0, 1.0]}),
        ('localizer', ('patience:=3',), {'patience': 3.0}),
    ],
)
def test_whole_numbers_are_taken_where_others_are_asked_for(
    start: Callable[..., Any], node: str, words: tuple[str, ...], wanted: dict[str, Any]
) -> None:
    one = start(node, *(word for pair in words for word in ('-p', pair)))
    for name, value in wanted.items():
        found = one.get_parameter(name).value
        assert found == pytest.approx(value)
        assert all(type(v) is float for v in (found if isinstance(value, list) else [found]))


def test_overrides_of_qos_do_not_bury_those_of_the_node(start: Callable[..., Any]) -> None:
    node = start('localizer', '-p', 'qos_overrides./image_points.subscription.depth:=7')
    names = {*node.list_parameters([], 0).names}
    assert {name for name in names if name.startswith('qos_overrides')} == {
        'qos_overrides./image_points.subscription.depth'
    }


def test_the_lens_is_said_when_it_changes(
    start: Callable[..., Any], capfd: pytest.CaptureFixture[str]
) -> None:
    node = start('localizer', '-p', 'lens:=fish180')
    for name, value in (('patience', 1.0), ('sigma_px', 0.5), ('lens', 'fish214')):
        assert set_parameter(node, name, value).successful
    assert capfd.readouterr().err.count('solving with the lens') == 2


def test_the_documentation_lists_the_parameters_of_the_code() -> None:
    folder = ROOT / 'docs'
    space: dict[str, Any] = {'__file__': str(folder / 'parameters.py'), '__name__': 'parameters'}
    exec((folder / 'parameters.py').read_text(encoding='utf-8'), space)
    page = folder / 'reference' / 'nodes.md'
    assert page.read_text(encoding='utf-8') == space['nodes_page'](), (
        f'{page.name} is stale; run: python docs/parameters.py'
    )


@pytest.mark.parametrize('name', TABLES)
def test_a_parameter_file_holds_defaults_of_its_node(name: str) -> None:
    by_node = read_parameter_file(ROOT / 'config' / f'{name}.yaml')
    assert [*by_node] == ['/**']
    defaults = {row.name: row.default for row in TABLES[name]}
    for parameter, value in by_node['/**'].items():
        default = defaults[parameter]
        plain = [*default] if isinstance(default, tuple) else default
        assert (type(value), value) == (type(plain), plain), parameter
