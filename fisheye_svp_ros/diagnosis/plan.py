"""Which photographs to take of a board, before the first one: for a lens known by its type."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis.model import Data, Linearised, State, intrinsic_names
from fisheye_svp_ros.diagnosis.next_photographs import (
    Board,
    Design,
    Room,
    candidate_shots,
    furthest,
)
from fisheye_svp_ros.diagnosis.next_question import Next, answered, whole_lens
from fisheye_svp_ros.effects.viewpoint_shift import ViewpointShiftEffect
from fisheye_svp_ros.optics.curves import KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens, field_of_view
from fisheye_svp_ros.pose import identity
from fisheye_svp_ros.scene.observations import make_observations
from fisheye_svp_ros.simulate.simulation import blank_views


class Plan(NamedTuple):
    """Wanted photographs, and the standard errors of the lens to expect from them, by name."""

    wanted: Next
    stderr: dict[str, float]


def plan(
    lens: Lens, points: Array, room: Room, count: int, number: str | None, noise: float
) -> Plan:
    """Choose photographs of a board with points (N, 3), m, z into the board.

    number: whose error is to be small, the whole lens by default; a viewpoint shift is left open.
    Raises GeometryError where the lens does not see the board, ParameterError for a number that
    it does not have.
    """
    board = Board(np.arange(len(points)), points, np.zeros(len(points), int), np.eye(3))
    state = State(identity(1), identity(1), lens, ())
    if lens.reached is not None:
        room = room._replace(field=furthest(lens, lens.reached))
    shots = candidate_shots(state, board, room, np.random.default_rng(0))
    blank = make_observations(np.zeros(len(points), int), board.landmark, 0.0 * points[:, :2],
                              points)
    views = blank_views(board.landmark, points, len(shots.distance))
    data = Data(blank, views, np.arange(len(shots.distance)), np.zeros(len(shots.distance), int))
    posed = State(shots.camera, identity(1), lens, ())
    linear = Linearised(data, posed, intrinsic_names(lens))
    design = Design(linear, [ViewpointShiftEffect(1)], board, shots, noise, known=False)
    question = whole_lens(design) if number is None else design.question(number)
    chosen, answers = design.choose(question, count)
    information = design.known + design.added[chosen].sum(axis=0)
    errors = np.sqrt(np.diag(np.linalg.inv(information)))
    return Plan(
        answered(design, number or 'lens', (), question, chosen, answers),
        {name.rpartition('.')[2]: float(error)
         for name, error in zip(design.names, errors, strict=True)},
    )


def nominal_lens(image_size: tuple[int, int], field: float) -> Lens:
    """Return an equidistant lens of a type: its field over the width of the image, rad.

    Where its image is a circle, corners beyond that hold nothing.
    """
    width, height = image_size
    lens = Lens('lens', width, height, width / field, width / field, (width - 1) / 2,
                (height - 1) / 2, KannalaBrandt(), 1.0)
    return replace(lens, max_incidence=min(field / 2, field_of_view(lens)))
