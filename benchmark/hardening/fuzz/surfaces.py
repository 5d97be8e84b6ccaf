"""What is attacked: every reader, every table of parameters; a surface is a function of chance.

It returns what is wrong with something that was accepted, empty for nothing, and raises
FisheyeSvpError where input is refused; anything else is a crash.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

import cv2
import numpy as np

from benchmark.hardening.fuzz.mutations import mutated, nasty
from fisheye_svp_ros.commands.node_sweeps import read_sweep
from fisheye_svp_ros.commands.processes import missing_rclpy
from fisheye_svp_ros.detect.patterns import parse_pattern
from fisheye_svp_ros.detect.photographs import decode_image, exif_turned
from fisheye_svp_ros.io.bags import Bag, BagWriter
from fisheye_svp_ros.io.columns import (
    TableParts,
    arrow,
    make_table,
    plain_columns,
    read_table,
    write_table,
)
from fisheye_svp_ros.io.landmark_files import environment, load_landmarks
from fisheye_svp_ros.io.lens_files import load_lens, save_lens
from fisheye_svp_ros.io.lens_formats import WRITABLE, write_foreign
from fisheye_svp_ros.io.parameters import rows, sweep_of, with_values
from fisheye_svp_ros.io.readers import (
    read_observations,
    read_poses,
    write_observations,
    write_poses,
)
from fisheye_svp_ros.io.recording import is_tabulated, tabulate
from fisheye_svp_ros.io.recording import read as read_observations_bag
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.library import functions as library
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.optics.curves import KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.scene.observations import MOST_LANDMARK, Observations, group_views
from fisheye_svp_ros.simulate.scenario import Scenario, simulate_scenario
from fisheye_svp_ros.study.settings import (
    SolverSettings,
    StereoCalibratorSettings,
    StereoDepthSettings,
    SyntheticCameraSettings,
)
from fisheye_svp_ros.study.sweep import column_types

Trial = Callable[[Random], str]
Read = Callable[[Path], Any]
Files = Mapping[str, bytes]


class Surface(NamedTuple):
    """Its name; what makes it, given a folder of its own; how many inputs in a thousand."""

    name: str
    make: Callable[[Path], Trial]
    share: int


def of_files(
    files: Files, read: Callable[[Path], str], folder: Path, binary: bool = False
) -> Trial:
    """Return the trial that spoils one of a folder's files and reads the folder."""
    for name, data in files.items():
        (folder / name).write_bytes(data)
    spoilt: list[str] = []

    def trial(rng: Random) -> str:
        while spoilt:
            name = spoilt.pop()
            (folder / name).write_bytes(files[name])
        spoilt.append(rng.choice(list(files)))
        (folder / spoilt[0]).write_bytes(mutated(files[spoilt[0]], rng, binary))
        return read(folder)

    return trial


def _lens(path: Path) -> str:
    return lens_trouble(load_lens(path))


def lens_trouble(lens: Lens) -> str:
    """Say what is wrong with a lens that was taken."""
    if not np.isfinite([*lens.parameters.values(), lens.max_incidence]).all():
        return 'a parameter that is no number'
    with np.errstate(all='ignore'):
        seen = project(lens, _POINTS)
    return '' if np.isfinite(seen.uv[seen.valid]).all() else 'an image point that is no number'


_POINTS = np.array([[0.0, 0, 1], [0.1, 0.2, 1], [-1, 0.3, 0.4], [0.01, 0, 5], [1, 1, -0.2]])


def _observations(path: Path) -> str:
    return table_trouble(read_observations(path))


def table_trouble(table: Observations) -> str:
    """Say what is wrong with observations that were taken."""
    group_views(table)
    for name in ('uv', 'xyz'):
        if not np.isfinite(getattr(table, name)).all():
            return f'{name} holds what is no number'
    ids = table.landmark
    return '' if len(ids) and 0 <= ids.min() <= ids.max() <= MOST_LANDMARK else 'impossible ids'


def _poses(path: Path) -> str:
    turn = read_poses(path).pose.rotation
    square = np.abs(turn @ np.swapaxes(turn, -1, -2) - np.eye(3)).max()
    return '' if square < 1e-9 else 'a pose without a rotation'


def _unchanged(read: Callable[[Path], tuple[Any, bool]], files: Files, folder: Path) -> Trial:
    """Return a trial of files with checksums: what is read is the same, or damage is told."""
    name = next(iter(files))
    (folder / name).write_bytes(files[name])
    good, _ = read(folder / name)

    def look(folder: Path) -> str:
        found, told = read(folder / name)
        return '' if told or found == good else 'a table has changed in silence'

    return of_files(files, look, folder, binary=True)


def _table(path: Path) -> tuple[Any, bool]:
    bag = Bag(path)
    return plain_columns(tabulate(bag.records(is_tabulated))), bool(bag.damage)


def _written(folder: Path, name: str, write: Callable[[Path], Any]) -> Files:
    path = folder / f'written_{name}'
    write(path)
    data = path.read_bytes()
    path.unlink()
    return {name: data}


def _file(
    name: str, write: Callable[[Path], Any], read: Callable[[Path], str], binary: bool = False
) -> Callable[[Path], Trial]:
    """Return what makes the surface of one file, which `write` writes at first."""

    def make(folder: Path) -> Trial:
        return of_files(
            _written(folder, name, write), lambda where: read(where / name), folder, binary
        )

    return make


def _quietly(read: Read) -> Callable[[Path], str]:
    def look(path: Path) -> str:
        read(path)
        return ''

    return look


def _recording(folder: Path) -> bytes:
    """Return a small recording, MCAP, of the nodes' topics."""
    from rclpy.serialization import serialize_message

    from fisheye_svp_ros.nodes import messages

    seen = simulate_scenario(Scenario()).observations
    with BagWriter(folder / 'bag') as bag:
        world = messages.landmarks_message(environment('whole', 2.0), 0, 'world')
        bag.write('/landmarks', 'sensor_msgs/msg/PointCloud2', serialize_message(world))
        for n in range(1, 4):
            points = messages.image_points_message(seen.landmark, seen.uv, n, 'camera')
            tag = messages.key_values_message('s', {'radius': n, 'lens': 'fish214'}, n)
            result = messages.key_values_message('n', {'rms_px': n / 3}, n)
            for topic, kind, message in (
                ('/image_points', 'sensor_msgs/msg/PointCloud2', points),
                ('/scenario', 'diagnostic_msgs/msg/DiagnosticArray', tag),
                ('/localizer/result', 'diagnostic_msgs/msg/DiagnosticArray', result),
            ):
                bag.write(topic, kind, serialize_message(message))
            bag.flush()
    return next((folder / 'bag').glob('*.mcap')).read_bytes()


def _orpc(folder: Path) -> Trial:
    corners = '\n'.join(f'0,{i},1,{10.5 + 7 * i},{20.5 + 3 * i}' for i in range(6))
    description = '\n'.join(f'-1,{i % 3},{i // 3},{i % 3},{i // 3},0' for i in range(6))
    files = {
        'cam-2020-05-07-13-08-27.orpc': f'version: 1\nnum_corners: 6\nencoding: [x]\n{corners}\n',
        'a.dsc': f'0,3,2,1.0\nt25h7,2.0\n{description}\n',
        'a.tp': '0\n1 0 0 0\n0 1 0 0\n0 0 1 0\n',
    }
    return of_files({k: v.encode() for k, v in files.items()}, _observations, folder)


def _sweeps(folder: Path) -> Trial:
    text = (
        '/**:\n  ros__parameters:\n    sweep.radius: [2.0, 0.3]\n    noise_px: 0.3\n'
        'synthetic_camera:\n  ros__parameters:\n    lens: fish214\n    sweep.seed: [1, 2]\n'
        'localizer: {ros__parameters: {svp: true, sigma_px: 0.5}}\n'
    )

    def read(folder: Path) -> str:
        plan = read_sweep(folder / 'a.yaml')
        return '' if column_types(plan) and len(plan.sweep) else 'an empty sweep'

    return of_files({'a.yaml': text.encode()}, read, folder)


def _boards(folder: Path) -> Trial:
    target = folder / 'target.yaml'
    text = b"target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 6\ntagSize: 0.088\ntagSpacing: 0.3\n"
    specs = (
        b'chessboard:9x6:24mm',
        b'charuco:7x5:30mm:22mm:DICT_5X5_100',
        b'squares:3x4:3cm:3cm',
        b'circles:4x11:20mm:asymmetric',
        f'aprilgrid:{target}'.encode(),
    )

    def trial(rng: Random) -> str:
        target.write_bytes(mutated(text, rng))
        spec = rng.choice(specs)
        if not spec.startswith(b'aprilgrid'):
            spec = mutated(spec, rng)
        points = parse_pattern(spec.decode('utf-8', 'replace')).points
        return '' if len(points) and np.isfinite(points).all() else 'no points'

    return trial


def _photographs(folder: Path) -> Trial:
    image = (np.add.outer(np.arange(48), np.arange(64)) * 2 % 256).astype(np.uint8)
    seeds = [
        cv2.imencode(kind, image)[1].tobytes()
        for kind in ('.png', '.jpg', '.bmp', '.tiff', '.pgm', '.webp')
    ]

    def trial(rng: Random) -> str:
        data = mutated(rng.choice(seeds), rng, binary=True)
        exif_turned(data)
        return '' if decode_image(data, 'photograph').size < 1 << 27 else 'a huge image'

    return trial


def _settings(folder: Path) -> Trial:
    tables: tuple[Any, ...] = (
        Scenario,
        SyntheticCameraSettings,
        SolverSettings,
        StereoCalibratorSettings,
        StereoDepthSettings,
    )

    def trial(rng: Random) -> str:
        table = rng.choice(tables)
        known = rows(table)
        chosen = {row.name: row for row in rng.sample(known, rng.randrange(1, 4))}
        values = {name: _value(row.default, rng) for name, row in chosen.items()}
        if rng.random() < 0.3:
            swept = {
                f'sweep.{name}': rng.choice(([value], [value, value], value, []))
                for name, value in values.items()
            }
            sweep = sweep_of(table, swept)
            last = sweep.point(len(sweep) - 1)
            return 'no value' if None in last.values() else ''
        new = with_values(table(), values)
        for name, row in chosen.items():
            value = getattr(new, name)
            if type(value) is not type(row.default) or row.check(value) != value:
                return f'{name} is {value!r}'
        return ''

    return trial


def _value(default: Any, rng: Random) -> Any:
    if isinstance(default, tuple):
        return [nasty(rng, type(default[0])) for _ in range(rng.randrange(9))]
    return nasty(rng, type(default))


def _parts(folder: Path) -> Trial:
    parts = TableParts(folder, {'n': int, 'x': float, 'name': str})
    parts.write(0, make_table({'n': [1, 2], 'x': [0.5, None], 'name': ['a', None]}))
    data = (folder / '000000000.csv').read_bytes()

    def read(folder: Path) -> str:
        parts.join(folder / 'all')
        return '' if len(read_table(folder / 'all.csv')) else 'no row'

    return of_files({'000000000.csv': data}, read, folder)


def _foreign(folder: Path) -> Trial:
    """Return the surface of the lens models that are read, but not written."""
    files = {
        'omni.yaml': b"""cam0:
  camera_model: omni
  intrinsics: [0.8, 833.0, 830.3, 373.8, 253.7]
  distortion_model: radtan
  distortion_coeffs: [-0.33, 0.13, 0.0, 0.0]
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, 0.1]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  resolution: [752, 480]
""",
        'ds.yaml': b'cam0: {camera_model: ds, intrinsics: [-0.2, 0.59, 158.0, 158.0, 255.0, 257.0]'
        b', distortion_model: none, distortion_coeffs: [], resolution: [512, 512]}\n',
        'fisheye.xml': b'<?xml version="1.0"?><opencv_storage><K type_id="opencv-matrix"><rows>3'
        b'</rows><cols>3</cols><dt>d</dt><data>300. 0. 320. 0. 301. 240. 0. 0. 1.'
        b'</data></K><D type_id="opencv-matrix"><rows>4</rows><cols>1</cols><dt>d'
        b'</dt><data>0.01 0.002 0. -0.001</data></D><image_width>640'
        b'</image_width><image_height>480</image_height></opencv_storage>\n',
        'cahvore.cameramodel': b"{'lensmodel': 'LENSMODEL_CAHVORE_linearity=0.37', 'imagersize': "
        b"[800, 800], 'intrinsics': [300.0, 300.0, 400.0, 400.0, 0, 0, "
        b'0.01, -0.02, 0.003, 0.004, 0.001, 0]}',
        'boofcv.yaml': b'model: omnidirectional_universal\npinhole: {width: 640, height: 720, fx: '
        b'400.0, fy: 400.0, cx: 320.0, cy: 360.0}\nmirror_offset: 0.9\n'
        b'radial_tangential: {radial: [-0.1, 0.01], t1: 0.0, t2: 0.0}\n',
    }

    def trial(rng: Random) -> str:
        name = rng.choice(list(files))
        (folder / name).write_bytes(mutated(files[name], rng))
        return _lens(folder / name)

    return trial


_COLUMNS = {'n': [1, 2, 3], 'x': [0.1, None, 3.5], 'name': ['a', 'b', None]}


def surfaces() -> list[Surface]:
    """Return all surfaces of files and parameters."""
    lens = load_lens(lens_path('fish214'))
    short = replace(load_lens(lens_path('fish180')), image_height=KannalaBrandt(-0.011, 0.004))
    table = simulate_scenario(Scenario(style='parallel', noise_px=0.1)).observations
    few = table.take(np.arange(12))
    saved = library.localize(simulate_scenario(Scenario(noise_px=0.1)).observations, lens)
    made = [
        Surface('lens YAML', _file('a.yaml', partial(save_lens, lens), _lens), 90),
        *(
            Surface(
                f'lens, {form}',
                _file('a.txt', lambda p, f=form: p.write_text(write_foreign(short, f)), _lens),
                40,
            )
            for form in WRITABLE
        ),
        Surface('lens, other models', _foreign, 40),
        Surface(
            'observations CSV',
            _file('a.csv', lambda p: write_observations(p, few), _observations),
            100,
        ),
        Surface(
            'poses CSV',
            _file('a.csv', lambda p: write_poses(p, saved.frame, saved.pose), _poses),
            50,
        ),
        Surface(
            'landmarks CSV',
            _file(
                'a.csv',
                lambda p: p.write_text('landmark,x,y,z\n0,1,2,3\n1,0.5,2.25,-1e-3\n'),
                _quietly(load_landmarks),
            ),
            30,
        ),
        Surface('ORPC, target', _orpc, 70),
        Surface('sweep file', _sweeps, 40),
        Surface('parameter tables', _settings, 150),
        Surface('boards, target YAML', _boards, 50),
        Surface('photographs', _photographs, 50),
        *(
            []
            if missing_rclpy()
            else [  # which writes their messages
                Surface(
                    'recording, table',
                    lambda folder: _unchanged(_table, {'a.mcap': _recording(folder)}, folder),
                    12,
                ),
                Surface(
                    'recording, points',
                    lambda folder: of_files(
                        {'a.mcap': _recording(folder)},
                        lambda f: table_trouble(read_observations_bag(f / 'a.mcap')),
                        folder,
                        True,
                    ),
                    12,
                ),
            ]
        ),
        Surface(
            'table CSV',
            _file(
                'a.csv',
                lambda p: write_table(p.with_suffix(''), make_table(_COLUMNS)),
                _quietly(read_table),
            ),
            50,
        ),
        Surface('parts of a sweep', _parts, 20),
        Surface('result JSON', _file('a.json', saved.save, _quietly(library.Localized.load)), 40),
    ]
    if arrow()[0] is not None:
        made.append(
            Surface(
                'table Parquet',
                lambda folder: _unchanged(
                    lambda path: (plain_columns(read_table(path)), False),
                    _written(
                        folder,
                        'a.parquet',
                        lambda p: write_table(p.with_suffix(''), make_table(_COLUMNS)),
                    ),
                    folder,
                ),
                20,
            )
        )
    return made
