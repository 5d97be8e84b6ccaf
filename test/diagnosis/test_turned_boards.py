"""Photographs whose board is numbered from the other end are found, named and put in order."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.data import DATA, NO_DATA
from helpers.targets import plane, poses_around

from fisheye_svp_ros import cli
from fisheye_svp_ros.diagnosis import TURNED, Diagnosis, DiagnosisOptions, diagnose
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.reporting.diagnosis_document import diagnosis_document
from fisheye_svp_ros.reporting.wording.diagnosis import verdict_sentences
from fisheye_svp_ros.reporting.wording.first_screen import first_screen, terminal_lines
from fisheye_svp_ros.scene.boards import board_turns
from fisheye_svp_ros.scene.observations import Observations, make_observations, views_of

HIDDEN = (3, 8, 9, 14)


def photographs(seed: int, offset_mm: float, hidden: tuple[int, ...] = ()) -> Observations:
    """Return a board with local offsets, in some frames numbered from the other end."""
    rng, landmarks, frames = np.random.default_rng(seed), plane(), 18
    real = landmarks.points + 1e-3 * offset_mm * rng.normal(size=landmarks.points.shape)
    pose = poses_around(landmarks, frames, rng, widest=0.9, distance=(0.25, 0.5))
    shape = frames, len(real), 2
    image = ForwardModel(load_lens(lens_path('fish180')).svp()).predict(
        pose, views_of(real, np.zeros(shape))
    )
    uv = image.uv + rng.normal(scale=0.05, size=shape)
    frame, point = np.nonzero(image.valid)
    names = tuple((i, '', f'left{i:02d}.png') for i in range(frames))
    table = replace(
        make_observations(frame, point, uv[frame, point], landmarks.points[point]),
        photographs=names,
    )
    (turn,) = board_turns(landmarks, np.zeros(len(real), dtype=np.int64))
    for one in hidden:
        table = turn.apply(table, table.frame == one)
    return table


def diagnosed(table: Observations) -> Diagnosis:
    """Return a quick diagnosis with the intrinsics free."""
    return diagnose(
        table,
        load_lens(lens_path('fish180')).svp(),
        free_intrinsics=True,
        options=DiagnosisOptions(quick=True),
    )


def test_reversed_photographs_are_named_and_put_in_order() -> None:
    found, right = (diagnosed(photographs(1, 0.2, hidden)) for hidden in (HIDDEN, ()))
    assert [one.frame for one in found.turned] == list(HIDDEN)
    for one in diagnosis_document(found)['turned']:
        assert one['photograph'] == f'left{one["frame"]:02d}.png'
        assert one['corrected'] and one['degrees'] == 180 and one['odds'] > 1e3
    assert not right.turned
    assert found.figures.extended.rms_px == pytest.approx(right.figures.extended.rms_px, rel=1e-6)
    (advice,) = (one for one in found.advice if one.kind == TURNED)
    assert 'left03.png' in advice.photographs
    assert 'left03.png' in verdict_sentences(found)[2]
    (told,) = (
        line
        for line in terminal_lines(first_screen(found, 'x'))
        if line.startswith('Photographs, why: ')
    )
    assert (
        'numbered from another end of the board, and reordered: left03.png, left08.png, '
        'left09.png, left14.png'
    ) in told


@pytest.mark.parametrize('seed', [2, 3])
def test_nothing_is_reported_where_offsets_are_too_small_to_tell(seed: int) -> None:
    assert not diagnosed(photographs(seed, 0.0, HIDDEN)).turned


def test_frames_that_show_several_boards_are_left_alone() -> None:
    """No frame shows one board alone: there is nothing to compare."""
    table = photographs(1, 0.2)
    two = replace(table, board=(table.landmark % 9 > 4).astype(np.int64))
    assert not diagnosed(two).turned


def test_turns_carry_a_board_onto_itself() -> None:
    """A board of 9 x 7 has one other order; with half of it missing it has none."""
    board = plane()
    (turn,) = board_turns(board, np.zeros(63, dtype=np.int64))
    assert turn.degrees == 180
    assert np.array_equal(turn.partner, np.arange(63)[::-1])
    partial = replace(board, ids=board.ids[1:], points=board.points[1:])
    (turn,) = board_turns(partial, np.zeros(62, dtype=np.int64))
    assert turn.landmark.tolist() == [*range(1, 62)] and turn.alone.tolist() == [62]
    table = make_observations(
        np.repeat([0, 1], 62),
        np.tile(partial.ids, 2),
        np.zeros((124, 2)),
        np.tile(partial.points, (2, 1)),
    )
    turned = turn.apply(table, table.frame == 1)
    assert turned.landmark.tolist() == [*range(1, 63), *range(61, 0, -1)]
    half = replace(board, ids=board.ids[:30], points=board.points[:30])
    assert not board_turns(half, np.zeros(30, dtype=np.int64))


def test_reversed_photographs_are_found_where_no_row_has_a_corner() -> None:
    hidden, right = photographs(1, 0.2, HIDDEN), photographs(1, 0.2)
    found, right = (diagnosed(one.take(one.landmark > 0)) for one in (hidden, right))
    assert [one.frame for one in found.turned] == list(HIDDEN)
    assert all(one.corrected for one in found.turned)
    assert found.figures.extended.rms_px == pytest.approx(right.figures.extended.rms_px, rel=0.02)


def test_photographs_of_a_real_board_are_found_by_where_its_clip_is(tmp_path: Path) -> None:
    """In 8.jpg and 9.jpg the clip of the clipboard is at the other end than in all others."""
    folder = DATA / 'photos' / 'chessboard'
    if not folder.exists():
        pytest.skip(NO_DATA)
    table, lens, out = tmp_path / 'corners.csv', tmp_path / 'lens.yaml', tmp_path / 'diagnosis'
    assert (
        cli.main(['detect', str(folder), '--board', 'chessboard:4x6:30mm', '-o', str(table)]) == 0
    )
    assert cli.main(['calibrate', str(table), '--image-size', '640x720', '-o', str(lens)]) == 0
    assert cli.main(['diagnose', str(table), '--lens', str(lens), '--quick', '-o', str(out)]) == 0
    turned = json.loads((out / 'diagnosis.json').read_text())['turned']
    assert '9.jpg' in {one['photograph'] for one in turned} <= {'8.jpg', '9.jpg'}
