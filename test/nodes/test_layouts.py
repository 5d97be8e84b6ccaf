"""The layouts of RViz, Foxglove and PlotJuggler against a graph: topics, types and series."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from typing import Any

import pytest
import yaml
from helpers.graph import Graph
from helpers.nodes import ROOT

from diagnostic_msgs.msg import DiagnosticArray  # isort: skip

from fisheye_svp_ros.io.decoding import stamp_of
from fisheye_svp_ros.nodes.localizer import Localizer
from fisheye_svp_ros.nodes.synthetic_camera import SyntheticCamera

RVIZ = ('MarkerArray', 'PoseWithCovariance')
# A message path of Foxglove: the value of a key of the only status
PATH = re.compile(r'(/[\w/]+)\.status\[0\]\.values\[:\]\{key=="(\w+)"\}\.value')


@pytest.fixture(scope='module')
def layouts() -> tuple[Any, Any, Any]:
    """Return the layouts of RViz, Foxglove and PlotJuggler."""
    folder = ROOT / 'config' / 'layouts'
    return (
        yaml.safe_load((folder / 'fisheye_svp.rviz').read_text())['Visualization Manager'],
        json.loads((folder / 'foxglove.json').read_text()),
        ElementTree.parse(folder / 'plotjuggler.xml').getroot(),
    )


@pytest.fixture
def graph(ros_domain: int) -> Iterator[Graph]:
    one = Graph('-r', '__ns:=/localization', '-p', 'synthetic_camera:rate:=20.0')
    yield one
    one.close()


def series(topic: str, message: Any) -> dict[str, float]:
    """Return what PlotJuggler makes of a DiagnosticArray: TOPIC/NAME OF STATUS/KEY."""
    return {
        f'{topic}/{status.name}/{pair.key}': float(pair.value)
        for status in message.status
        for pair in status.values
    }


def test_layouts_show_what_the_nodes_publish(layouts: tuple[Any, Any, Any], graph: Graph) -> None:
    """Every metric of a set is under its stamp, on one topic that both programs draw.

    That each topic is in a recording of the demo is tested there.
    """
    _, foxglove, juggler = layouts
    topic = '/localization/localizer/result'
    results = graph.hear(DiagnosticArray, topic)
    points = graph.hear(DiagnosticArray, '/localization/scenario')
    for node in (Localizer, SyntheticCamera):
        graph.start(node)
    graph.until(lambda: results)
    known = series(topic, results[0])
    assert set(known) == {f'{topic}//localization/localizer/{name}' for name in Localizer.METRICS}
    assert {curve.attrib['name'] for curve in juggler.iter('curve')} <= set(known)
    panels = foxglove['configById']
    for path in (path for name in panels for path in panels[name].get('paths', ())):
        match = PATH.fullmatch(path['value'])
        assert match and match[1] == topic and match[2] in Localizer.METRICS
        assert path['timestampMethod'] == 'headerStamp'
    graph.until(lambda: stamp_of(results[0]) in {stamp_of(m) for m in points})


def test_layouts_are_built_as_the_programs_read_them(layouts: tuple[Any, Any, Any]) -> None:
    rviz, foxglove, juggler = layouts
    assert {display['Class'] for display in rviz['Displays']} == {
        f'rviz_default_plugins/{name}' for name in ('Grid', 'TF', *RVIZ)
    }
    for display in rviz['Displays']:
        latched = display['Class'].endswith('MarkerArray')
        if 'Topic' in display:
            assert display['Topic']['Durability Policy'] == (
                'Transient Local' if latched else 'Volatile'
            )
    # Foxglove: a binary tree whose leaves are the panels, each once.
    leaves, nodes = [], [foxglove['layout']]
    while nodes:
        node = nodes.pop()
        if isinstance(node, str):
            leaves.append(node)
        else:
            assert node['direction'] in ('row', 'column')
            nodes += [node['first'], node['second']]
    assert sorted(leaves) == sorted(foxglove['configById'])
    # PlotJuggler: a splitter has as many sizes and children as it counts, an area one plot.
    for splitter in juggler.iter('DockSplitter'):
        assert int(splitter.attrib['count']) == len(splitter)
        assert len(splitter.attrib['sizes'].split(';')) == len(splitter)
        assert splitter.attrib['orientation'] in ('|', '-')
    assert all([child.tag for child in area] == ['plot'] for area in juggler.iter('DockArea'))
    assert juggler.find('tabbed_widget').attrib['parent'] == 'main_window'


def test_layouts_of_a_robot_show_the_map_and_what_was_found() -> None:
    folder = ROOT / 'config' / 'layouts'
    rviz = yaml.safe_load((folder / 'robot.rviz').read_text())['Visualization Manager']
    topics = {one['Topic']['Value'] for one in rviz['Displays'] if 'Topic' in one}
    assert {'/localizer/tag_map', '/localizer/base_pose', '/detector/found'} <= topics
    for display in rviz['Displays']:
        latched = display['Class'].endswith('MarkerArray')
        if 'Topic' in display:
            durability = 'Transient Local' if latched else 'Volatile'
            assert display['Topic']['Durability Policy'] == durability
    foxglove = json.loads((folder / 'robot_foxglove.json').read_text())
    panels = foxglove['configById']
    assert '/localizer/tag_map' in panels['3D!scene']['topics']
    assert panels['Image!found']['imageMode']['imageTopic'] == '/detector/found'
    assert sorted(panels) == sorted(foxglove['layout'][side] for side in ('first', 'second'))
