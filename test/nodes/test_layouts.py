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
from fisheye_svp_ros.nodes.stereo_depth import StereoDepth
from fisheye_svp_ros.nodes.synthetic_camera import SyntheticCamera

RVIZ = {
    'MarkerArray': 'visualization_msgs/msg/MarkerArray',
    'PoseWithCovariance': 'geometry_msgs/msg/PoseWithCovarianceStamped',
}
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
    one = Graph('-p', 'synthetic_camera:rate:=20.0')
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
    rviz, foxglove, juggler = layouts
    panels = foxglove['configById']
    plotted = [
        path
        for name, panel in panels.items()
        if name.startswith('Plot!')
        for path in panel['paths']
    ]
    wanted = {
        display['Topic']['Value']: RVIZ[display['Class'].rpartition('/')[2]]
        for display in rviz['Displays']
        if 'Topic' in display
    }
    assert set(panels['3D!scene']['topics']) <= set(wanted)
    wanted[panels['RawMessages!scenario']['topicPath']] = 'diagnostic_msgs/msg/DiagnosticArray'
    results = graph.hear(DiagnosticArray, '/localizer/result')
    points = graph.hear(DiagnosticArray, '/scenario')
    for node in (Localizer, StereoDepth, SyntheticCamera):
        graph.start(node)
    graph.until(
        lambda: results and set(wanted) <= set(dict(graph.probe.get_topic_names_and_types()))
    )
    types = dict(graph.probe.get_topic_names_and_types())
    assert {topic: types[topic] for topic in wanted} == {t: [k] for t, k in wanted.items()}
    # Every metric of a set under its stamp, on one topic that both programs draw.
    known = series('/localizer/result', results[0])
    assert set(known) == {f'/localizer/result//localizer/{name}' for name in Localizer.METRICS}
    assert {curve.attrib['name'] for curve in juggler.iter('curve')} <= set(known)
    for path in plotted:
        match = PATH.fullmatch(path['value'])
        assert match and match[1] == '/localizer/result' and match[2] in Localizer.METRICS
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
