"""Curves, effects and readers of a distribution of the user's own."""

import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
from helpers.nodes import need_ros

from fisheye_svp_ros.io.columns import read_table

ROOT = Path(__file__).parents[1]
MODULE = '''
"""A bent sensor: image points move in waves of threefold symmetry."""
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fisheye_svp_ros.effects.base import Effect, Parameter
from fisheye_svp_ros.io.readers import Reader
from fisheye_svp_ros.optics.curve_base import ImageHeight, ViewpointShift


@dataclass(frozen=True)
class Rational(ImageHeight):
    a: float = 0.0
    coefficient_names: ClassVar = ('a',)
    limit: ClassVar = 2.0

    def value_and_slope(self, theta):
        below = 1 + self.a * theta**2
        return theta / below, (1 - self.a * theta**2) / below**2

    def columns(self, theta):
        return -(theta**3 / (1 + self.a * theta**2) ** 2)[..., None]


@dataclass(frozen=True)
class Squared(ViewpointShift):
    b: float = 0.0
    coefficient_names: ClassVar = ('b',)

    def value_and_slope(self, theta, half_tan):
        return self.b * theta**2, 2 * self.b * theta

    def columns(self, theta):
        return (theta**2)[..., None]


@dataclass(frozen=True)
class Trefoil(Effect):
    name: ClassVar = 'trefoil'
    stage: ClassVar = 'image'
    signature: ClassVar = 'waves around the centre'
    to_separate: ClassVar = 'look at the sensor'

    @property
    def parameters(self):
        return Parameter('cosine', 'px', 1.0), Parameter('sine', 'px', 1.0)

    def columns(self, scene):
        x, y = np.moveaxis(scene.normalized_uv(), -1, 0)
        wave = (x + 1j * y) ** 3
        outward = np.stack([x, y], axis=-1)
        return np.stack([wave.real[..., None] * outward, wave.imag[..., None] * outward], axis=-1)


def read(path):
    from fisheye_svp_ros.io.csv_files import read as read_csv
    text = path.read_text().replace(';', ',')
    copy = path.with_suffix('.csv')
    copy.write_text(text)
    return read_csv(copy)


READER = Reader('a .semicolon file', lambda path: path.suffix == '.semicolon', __name__)
'''
ENTRY_POINTS = """
[fisheye_svp_ros.image_heights]
rational = my_optics:Rational
[fisheye_svp_ros.viewpoint_shifts]
squared = my_optics:Squared
[fisheye_svp_ros.effects]
trefoil = my_optics:Trefoil
[fisheye_svp_ros.readers]
semicolon = my_optics:READER
"""
LENS = """
image: {width: 1280, height: 960}
projection: {model: rational, f: 400.0, cx: 640.0, cy: 480.0, a: 0.05}
viewpoint_shift: {model: squared, b: 0.004}
corrections: {trefoil: {parameters: {cosine: 1.5, sine: -0.8}}}
"""
USE = """
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from helpers.targets import cube, poses_around

import fisheye_svp_ros as fsvp
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.csv_files import write_observations
from fisheye_svp_ros.optics import engines
from fisheye_svp_ros.scene.observations import Landmarks
from fisheye_svp_ros.simulate.scenario import model_of
from fisheye_svp_ros.simulate.simulation import simulate

engines.use(sys.argv[1])
lens = fsvp.load_lens('lens.yaml')
assert list(CATALOGUE)[-1] == 'trefoil'
fsvp.save_lens(lens, 'again.yaml')
assert replace(fsvp.load_lens('again.yaml'), name=lens.name) == lens
points = fsvp.back_project(lens, fsvp.project(lens, np.array([[0.3, 0.2, 0.5]])).uv)
across = np.cross([0.3, 0.2, 0.5] - points.origin, points.direction)
assert np.abs(across).max() < 1e-6

landmarks = cube()
rng = np.random.default_rng(2)
poses = poses_around(landmarks, 12, rng, widest=1.0)
seen = simulate(ForwardModel(lens), landmarks, poses, 0.05, rng)
write_observations('seen.csv', seen)
Path('seen.semicolon').write_text(Path('seen.csv').read_text().replace(',', ';'))
found = fsvp.localize('seen.semicolon', lens)
off = np.abs(found.pose.position - poses.position[found.frame]).max()
assert off < 5e-4, off
# Without what the user's package adds, nothing fits.
assert fsvp.localize(seen, replace(lens, corrections={})).rms_px.mean() > 0.3
assert fsvp.localize(seen, lens.svp()).rms_px.mean() > 1.2 * found.rms_px.mean()
half = model_of('lens.yaml', 0.5, svp=False).lens.viewpoint_shift
assert half.b == 0.002
fit = fsvp.calibrate(simulate(ForwardModel(replace(lens, corrections={})), landmarks, poses, 0.05,
                              rng), 'rational', (1280, 960),
                     free=['f', 'cx', 'cy', 'a', 'b'])
assert abs(fit.lens.image_height.a - 0.05) < 2e-3
assert abs(fit.lens.viewpoint_shift.b - 0.004) < 1e-3
if sys.argv[1] == 'numpy':
    named = fsvp.diagnose(seen, replace(lens, corrections={}))
    assert named.table()['effect'] == ['trefoil'], named.document['causes']
    assert abs(named.lens.corrections['trefoil']['parameters']['cosine'] - 1.5) < 0.2
print('done')
"""

NODES = """
import sys

from helpers.nodes import until
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

from diagnostic_msgs.msg import DiagnosticArray

from fisheye_svp_ros.io.decoding import read_key_values
from fisheye_svp_ros.nodes.localizer import Localizer
from fisheye_svp_ros.nodes.measured_camera import MeasuredCamera

context = Context()
context.init(args=[], domain_id=int(sys.argv[1]))
executor, results = SingleThreadedExecutor(context=context), []
listener = Node('listener', context=context)
listener.create_subscription(DiagnosticArray, '/localizer/result', results.append, 10)
for kind, values in ((Localizer, {'lens': 'lens.yaml'}),
                     (MeasuredCamera, {'observations': 'seen.semicolon', 'rate': 50.0})):
    given = [Parameter(name, value=value) for name, value in values.items()]
    executor.add_node(kind(context=context, parameter_overrides=given))
executor.add_node(listener)
until(lambda: executor.spin_once(0.02) or results)
assert float(read_key_values(results[0])['rms_px']) < 0.15
context.try_shutdown()
print('done')
"""
# In one process: imports are half of what the commands take.
RUN = """
import json
import sys

from fisheye_svp_ros import cli

for name, arguments in json.loads(sys.argv[1]).items():
    status = cli.main([name, *arguments.split()])
    assert status == 0, (name, status)
print('done')
"""
SEE = """
import numpy as np
from helpers.targets import cube, poses_around

import fisheye_svp_ros as fsvp
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.csv_files import write_observations
from fisheye_svp_ros.simulate.simulation import simulate

rng = np.random.default_rng(2)
model, landmarks = ForwardModel(fsvp.load_lens('lens.yaml')), cube()
seen = simulate(model, landmarks, poses_around(landmarks, 12, rng, widest=1.0), 0.05, rng)
write_observations('seen.csv', seen)
text = open('seen.csv').read()
open('seen.semicolon', 'w').write(text.replace(',', ';'))
"""
SWEEP = """
synthetic_camera: {ros__parameters: {lens: lens.yaml, sweep.radius: [2.0, 0.5]}}
localizer: {ros__parameters: {lens: lens.yaml, svp: false}}
"""
COMMANDS = {
    'localize': 'seen.semicolon --lens lens.yaml -o found',
    'calibrate': 'seen.semicolon --model rational --image-size 1280x960 -o fitted.yaml',
    'diagnose': 'seen.semicolon --lens lens.yaml --quick -o causes',
    'lens': 'lens.yaml',
    'budget': '--lens lens.yaml -o budget',
    'plan': '--lens lens.yaml --board chessboard:9x6:25mm --room 0.2 1 -o plan',
    'render': '--lens lens.yaml --board chessboard:9x6:30mm --count 1 -o photographs',
    'sweep': 'sweep.yaml -o sweep',
}


def run(folder, *arguments):
    path = os.pathsep.join(map(str, (folder, ROOT, ROOT / 'test')))
    environment = {**os.environ, 'PYTHONPATH': path}
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env=environment,
        text=True,
        capture_output=True,
        timeout=300,
    )


@pytest.fixture
def distribution(tmp_path):
    """Return a folder with a distribution that brings curves, an effect and a reader."""
    info = tmp_path / 'my_optics-1.0.dist-info'
    info.mkdir()
    (info / 'METADATA').write_text('Metadata-Version: 2.1\nName: my-optics\nVersion: 1.0\n')
    (info / 'entry_points.txt').write_text(ENTRY_POINTS)
    (tmp_path / 'my_optics.py').write_text(MODULE)
    (tmp_path / 'lens.yaml').write_text(LENS)
    (tmp_path / 'use.py').write_text(USE)
    return tmp_path


@pytest.mark.parametrize('engine', ['numpy', 'numba'])
def test_what_a_users_package_adds_is_used_like_the_packages_own(engine, distribution):
    if engine == 'numba' and find_spec('numba') is None:
        pytest.skip('numba is not installed')
    done = run(distribution, 'use.py', engine)
    assert done.stdout.splitlines()[-1:] == ['done'], done.stderr


@pytest.mark.parametrize(
    ('old', 'new', 'reason'),
    [
        ('my_optics:Trefoil', 'my_optics:Quatrefoil', "'trefoil' of my-optics cannot be loaded ("),
        (
            'my_optics:Trefoil',
            'my_optics:Rational',
            "'trefoil' of my-optics is not derived from E",
        ),
        ('trefoil =', 'skew =', "'skew' of my-optics: the name is taken, or"),
    ],
)
def test_a_broken_entry_point_is_named_in_one_line(old, new, reason, distribution):
    entries = distribution / 'my_optics-1.0.dist-info' / 'entry_points.txt'
    entries.write_text(entries.read_text().replace(old, new))
    done = run(distribution, '-m', 'fisheye_svp_ros.cli', 'budget', '--lens', 'lens.yaml')
    assert done.returncode == 2
    assert reason in done.stderr and done.stderr.count('\n') == 1


@pytest.fixture
def recorded(distribution):
    """Return the folder with observations in the form of the user's own reader, too."""
    (distribution / 'see.py').write_text(SEE)
    (distribution / 'sweep.yaml').write_text(SWEEP)
    done = run(distribution, 'see.py')
    assert done.returncode == 0, done.stderr
    return distribution


@pytest.mark.slow
def test_commands_take_what_a_users_package_adds(recorded):
    done = run(recorded, '-c', RUN, json.dumps(COMMANDS))
    assert done.stdout.splitlines()[-1:] == ['done'], done.stderr
    assert json.loads((recorded / 'found' / 'localize.json').read_text())['rms_px'] < 0.1
    assert 'model: rational' in (recorded / 'fitted.yaml').read_text()
    rows = read_table(recorded / 'sweep' / 'sweep.csv')
    assert rows['localizer.rms_px'].max() < 1e-6


def test_nodes_take_what_a_users_package_adds(recorded, ros_domain):
    need_ros()
    (recorded / 'nodes.py').write_text(NODES)
    done = run(recorded, 'nodes.py', str(ros_domain))
    assert done.stdout.splitlines()[-1:] == ['done'], done.stderr
