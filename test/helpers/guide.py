"""A board held in front of a hidden camera, for the live guide."""

from __future__ import annotations

import numpy as np

from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.optics.curves import Gennery, KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.planning.guide import DetectedBoard, Session, SessionState, start_session
from fisheye_svp_ros.planning.plan import nominal_lens
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.simulate.render import Print

LENS = Lens(
    'hidden',
    848,
    800,
    270.0,
    270.0,
    428.0,
    396.0,
    KannalaBrandt(-0.01, 0.003),
    np.radians(92.0),
    Gennery(e0=-0.003),
)
SHEET = nominal_lens((848, 800), 3.15)
POINTS = Print(6, 5, 0.030).corners


def session() -> Session:
    """Return a session without photographs."""
    return start_session(SHEET, POINTS, (0.15, 0.6), 'e0', 3e-4)


def seen_from(lens: Lens, camera: Pose, rng: np.random.Generator) -> DetectedBoard:
    """Return the board as a camera sees it from a pose in the board's frame."""
    uv = project(lens, camera.into_body(POINTS)).uv
    ids = np.arange(len(POINTS))
    return DetectedBoard(0.0, ids, uv + 0.03 * rng.normal(size=uv.shape), np.full(len(ids), 0.03))


def present(lens: Lens, stand: SessionState, rng: np.random.Generator) -> DetectedBoard:
    """Return the wanted view as somebody presents it, a few degrees and millimetres off."""
    for i in range(len(stand.outline)):
        board = stand.wanted.shots.camera.take(i).inverse()
        turn = rotation_from_vector(rng.normal(scale=0.03, size=3))
        camera = Pose(
            turn @ board.rotation, board.position + rng.normal(scale=0.004, size=3)
        ).inverse()
        seen = seen_from(lens, camera, rng)
        if np.isfinite(seen.uv).all():
            return seen
    raise AssertionError('the lens sees none of the wanted views')
