"""Who reaches a node, and what a node is allowed to do."""

from __future__ import annotations

import fnmatch
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from helpers.graph import Graph
from helpers.nodes import ROOT

from fisheye_svp_ros.io.rig_files import save_rig
from fisheye_svp_ros.nodes import NODES
from fisheye_svp_ros.scene.rigs import rig

OBSERVATIONS = 'frame,landmark,u,v,x,y,z,camera\n' + ''.join(
    f'0,{i},{100 + 7 * i},{200 - 3 * i},{0.1 * i},{0.01 * i * i},1,{camera}\n'
    for camera in ('left', 'right')
    for i in range(6)
)
SOLVERS = ('localizer', 'stereo_calibrator', 'stereo_depth', 'model_critic')


@pytest.fixture
def graph(ros_domain: int, tmp_path: Path) -> Iterator[Graph]:
    """Return a graph in which every node has what it needs, and answers to wait for."""
    path = tmp_path / 'observations.csv'
    path.write_text(OBSERVATIONS)
    save_rig(rig('parallel'), tmp_path / 'rig.yaml')
    solvers = [word for name in SOLVERS for word in ('-p', f'{name}:lens:=camera_info')]
    one = Graph(
        '-p',
        f'observations:={path}',
        '-p',
        'style:=parallel',
        '-p',
        'lock_step:=localizer/result',
        '-p',
        f'publish_tf:={find_spec("tf2_msgs") is not None}',
        *solvers,
        '-p',
        'guide:=e0',
        '-p',
        f'guide_output:={tmp_path / "guided"}',
        '-p',
        'detector:lens:=camera_info',
        '-p',
        f'rig_localizer:rig:={tmp_path}/rig.yaml',
    )
    yield one
    one.close()


def policy(name: str) -> dict[str, set[str]]:
    """Return the patterns of full names that a policy allows, by what for."""
    root = ElementTree.parse(ROOT / 'config' / 'sros2' / f'{name}.policy.xml').getroot()
    (enclave,) = root.iter('enclave')
    (profile,) = root.iter('profile')
    assert enclave.get('path') == f'/{name}' and profile.get('node') == name
    allowed: dict[str, set[str]] = {'publish': set(), 'subscribe': set(), 'reply': set()}
    for element in profile:
        for what in {*allowed} & {*element.attrib}:
            allowed[what] |= {
                text if text.startswith('/') else '/' + text.replace('~', name)
                for text in (str(child.text) for child in element)
            }
    return allowed


@pytest.mark.parametrize('name', NODES)
def test_a_policy_allows_all_that_a_node_does_and_not_more(name: str, graph: Graph) -> None:
    kind = ''.join(word.title() for word in name.split('_'))
    module = import_module(f'fisheye_svp_ros.nodes.{name}')
    node: Any = graph.start(getattr(module, kind))
    graph.idle(0.3)
    allowed = policy(name)
    space = node.get_name(), node.get_namespace()
    done = {
        'publish': {n for n, _ in node.get_publisher_names_and_types_by_node(*space)},
        'subscribe': {n for n, _ in node.get_subscriber_names_and_types_by_node(*space)},
        'reply': {n for n, _ in node.get_service_names_and_types_by_node(*space)},
    }
    for what, names in done.items():
        for one in names:
            assert any(fnmatch.fnmatchcase(one, p) for p in allowed[what]), (what, one)
    assert '/*' not in allowed['publish'] | allowed['subscribe'] | allowed['reply']
