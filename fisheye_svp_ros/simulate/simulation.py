"""Simulation: landmarks, poses, a lens and its effects to the observations a camera would give."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.effects.base import noise_scale
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.optics.lens import inside_image
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import (
    STEREO,
    Landmarks,
    Observations,
    Views,
    make_observations,
    views_of,
)


def simulate(
    model: ForwardModel,
    landmarks: Landmarks,
    poses: Pose,
    sigma: float,
    rng: np.random.Generator,
    *,
    t: Array | None = None,
    board: Index | None = None,
) -> Observations:
    """Return the image points of landmarks (N,) from poses (S,) of the camera in the world.

    sigma: of Gaussian noise on u and on v, px, before the model's effects act on it; t (S,): time
    of each frame, s; board (N,): the rigid piece of the target that carries each landmark.  Frames
    count from 0; what lies outside the field of view or the image, or has no ray through the
    lens, is absent.
    Raises ParameterError for a sigma below 0.
    """
    views = blank_views(landmarks.ids, landmarks.points, len(poses.position), t, board)
    seen = add_noise(model, predict_points(model, poses, views), sigma, rng)
    return _make_table(seen[:, None], landmarks, sigma, t, board, ('',))


def simulate_stereo(
    left: ForwardModel,
    right: ForwardModel,
    landmarks: Landmarks,
    rig: Pose,
    poses: Pose,
    sigma: float,
    rng: np.random.Generator,
    *,
    t: Array | None = None,
) -> Observations:
    """Return the image points in both cameras of a rig, as `simulate` does, in one table.

    rig: left camera in the right one; poses (S,) of the right camera in the world.
    """
    return simulate_rig(
        (left, right), landmarks, (poses.compose(rig), poses), sigma, rng, STEREO, t=t
    )


def simulate_rig(
    models: Sequence[ForwardModel],
    landmarks: Landmarks,
    poses: Sequence[Pose],
    sigma: float,
    rng: np.random.Generator,
    cameras: tuple[str, ...],
    *,
    t: Array | None = None,
) -> Observations:
    """Return the image points in the C cameras of a rig, as `simulate` does, in one table.

    models, cameras: of each, and its poses (S,) in the world.
    """
    views = blank_views(landmarks.ids, landmarks.points, len(poses[0].position), t)
    seen = [
        add_noise(
            model,
            predict_points(model, place, views._replace(camera=views.camera + camera)),
            sigma,
            rng,
        )
        for camera, (model, place) in enumerate(zip(models, poses, strict=True))
    ]
    return _make_table(np.stack(seen, axis=1), landmarks, sigma, t, None, cameras)


def blank_views(
    ids: Index, points: Array, count: int, t: Array | None = None, board: Index | None = None
) -> Views:
    """Return `count` views to be filled of landmarks (N,) or (S, N) at points (..., N, 3), m."""
    shape = (count, ids.shape[-1])
    return views_of(points, np.zeros((*shape, 2)))._replace(
        landmark=np.broadcast_to(ids, shape),
        board=np.broadcast_to(0 if board is None else board, shape),
        t=np.broadcast_to(np.nan if t is None else t[:, None], shape),
    )


def predict_points(model: ForwardModel, poses: Pose, views: Views) -> tuple[Array, Array]:
    """Return what a camera at poses (S,) sees of views (S, N), and how noisy that is.

    Image points (S, N, 2), px, without noise, and the factor (S, N, 1) on the noise.
    """
    uv = model.predict(poses, views).uv
    if not model.noise_terms:
        return uv, np.ones((*uv.shape[:2], 1))
    scene = model.scene(poses, views, model.linearize(poses, views))
    return uv, np.broadcast_to(noise_scale(model.terms, scene), uv.shape[:2])[..., None]


def add_noise(
    model: ForwardModel, seen: tuple[Array, Array], sigma: float, rng: np.random.Generator
) -> Array:
    """Return image points (S, N, 2), px, of `predict_points` with noise; NaN where none is."""
    if not (np.isfinite(sigma) and sigma >= 0):
        raise ParameterError(f'noise is {sigma} px; 0 or more is needed')
    ideal, scale = seen
    uv = ideal + sigma * scale * rng.standard_normal(ideal.shape)
    uv = np.where(inside_image(model.lens, uv)[..., None], uv, np.nan)
    for effect, values in model.noise_terms:
        uv = effect.record_points(uv, values, rng)
    return uv


def _make_table(
    seen: Array,
    landmarks: Landmarks,
    sigma: float,
    t: Array | None,
    board: Index | None,
    cameras: tuple[str, ...],
) -> Observations:
    """Make the table of image points (S, C, N, 2) in the order of frame, camera, landmark."""
    frame, camera, slot = np.nonzero(np.isfinite(seen).all(axis=-1))
    return make_observations(
        frame,
        landmarks.ids[slot],
        seen[frame, camera, slot],
        landmarks.points[slot],
        camera=camera,
        board=None if board is None else board[slot],
        t=None if t is None else t[frame],
        sigma=np.full(len(frame), sigma) if sigma else None,
        cameras=cameras,
        source='simulation',
    )
