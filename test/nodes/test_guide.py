"""The detector's guide: a picture with the wanted view, photographs taken by themselves."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.graph import LATCHED, Graph, set_parameter
from helpers.photographs import BOARD, LENS, photograph, poses
from rclpy.qos import QoSProfile, ReliabilityPolicy

from diagnostic_msgs.msg import DiagnosticArray  # isort: skip
from geometry_msgs.msg import PoseStamped  # isort: skip
from sensor_msgs.msg import Image  # isort: skip
from std_msgs.msg import Float64  # isort: skip

from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.decoding import read_pose
from fisheye_svp_ros.io.lens_files import save_lens
from fisheye_svp_ros.io.readers import read_observations
from fisheye_svp_ros.nodes.detector import Detector
from fisheye_svp_ros.nodes.messages import image_message

SENSOR = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
GUIDED = (f'board:={BOARD}', 'guide:=e0', 'near:=0.1', 'far:=0.25')


def test_a_wanted_view_is_shown_and_taken(graph: Callable[..., Graph], tmp_path: Path) -> None:
    """From the data sheet; whoever holds the board puts it where `~/wanted` says."""
    lens, output = tmp_path / 'sheet.yaml', tmp_path / 'guided'
    save_lens(LENS.svp(), lens)
    g = graph(*GUIDED, f'lens:={lens}', f'guide_output:={output}')
    pictures = g.hear(Image, 'detector/guide')
    wanted = g.hear(PoseStamped, 'detector/wanted', LATCHED)
    scores = g.hear(Float64, 'detector/metrics/score')
    counts = g.hear(Float64, 'detector/metrics/photographs')
    diagnostics = g.hear(DiagnosticArray, '/diagnostics')
    g.start(Detector)
    images, stamp = g.tell(Image, 'image', SENSOR), 0

    def show(pixels: Any) -> None:
        nonlocal stamp
        stamp += 10**8
        images.publish(image_message(pixels, stamp, 'camera'))
        g.idle(0.05)

    away = photograph(poses(1, 4).take(0))
    g.until(lambda: (show(away), wanted)[1])
    assert (pictures[-1].encoding, pictures[-1].width, pictures[-1].height) == ('bgr8', 424, 400)
    assert len(pictures[-1].data) == 3 * 424 * 400 and pictures[-1].header.frame_id == 'camera'
    assert wanted[0].header.frame_id == 'camera'
    there = photograph(read_pose(wanted[0]).inverse())
    g.until(lambda: (show(there), max(s.data for s in scores) > 0.9)[1])
    g.until(lambda: (show(there), any(c.data == 1 for c in counts))[1])
    saved = read_observations(output / 'observations.csv')
    assert len(saved.frames) == 1 and np.isfinite(saved.sigma).all()
    assert [p.name for p in (output / 'photographs').iterdir()] == ['000.png']
    g.until(
        lambda: any(
            pair.key == 'guide: taken' and pair.value.startswith('1 photograph, e0')
            for m in diagnostics
            for pair in m.status[0].values
        )
    )


def test_an_image_that_the_lens_is_not_for_is_named(
    graph: Callable[..., Graph], tmp_path: Path
) -> None:
    g = graph(*GUIDED, 'lens:=fish214', f'guide_output:={tmp_path / "guided"}')
    diagnostics, _ = g.hear(DiagnosticArray, '/diagnostics'), g.hear(Image, 'detector/guide')
    node = g.start(Detector)
    images = g.tell(Image, 'image', SENSOR)
    blank = np.zeros((400, 424), np.uint8)
    g.until(
        lambda: (
            images.publish(image_message(blank, 5, 'camera')),
            any('424x400 px, but lens' in m.status[0].message for m in diagnostics),
        )[1]
    )
    assert not set_parameter(node, 'board', 'chessboard:9x6:25mm').successful


@pytest.mark.parametrize(
    ('arguments', 'reason'),
    [
        (('near:=0.5', 'far:=0.4'), 'near must be below far'),
        (('detections:=true',), 'must be an aprilgrid|cannot be used with detections'),
        ((), 'an empty, writable folder'),
        (('guide_output:=notes.txt/guided',), 'writable'),
    ],
)
def test_a_guide_that_cannot_work_is_refused(
    graph: Callable[..., Graph],
    tmp_path: Path,
    arguments: tuple[str, ...],
    reason: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr('fisheye_svp_ros.nodes.detector._tag_array', lambda: DiagnosticArray)
    monkeypatch.chdir(tmp_path)
    Path('notes.txt').write_text('mine')
    g = graph('guide:=e0', f'guide_output:={tmp_path}', *arguments)
    with pytest.raises(ParameterError, match=reason):
        g.start(Detector)
