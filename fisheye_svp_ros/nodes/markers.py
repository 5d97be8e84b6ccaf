"""What RViz and Foxglove draw: landmarks, cameras, rays; numbers only, in the world frame."""

from __future__ import annotations

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.nodes.messages import Segments
from fisheye_svp_ros.optics.camera import incidence
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose

_CAMERA_SIZE = 0.1  # m, of the viewing axis that is drawn
_HALF_BASE = 0.4 * _CAMERA_SIZE


def landmarks_shape(points: Array) -> Segments:
    """Return balls at landmarks (N, 3), m, of a size that suits their distance."""
    size = 0.02 * float(np.linalg.norm(points, axis=-1).mean())
    return Segments('landmarks', points, (0.1, 0.1, 0.1, 1.0), size, lines=False)


def camera_shape(pose: Pose, name: str, alpha: float) -> Segments:
    """Return a pyramid for a camera, its tip at the pose, opening along the viewing axis."""
    corners = np.array([[x, y, _CAMERA_SIZE] for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    corners[:, :2] *= _HALF_BASE
    edges = [
        edge for i in range(4)
        for edge in (np.zeros(3), corners[i], corners[i], corners[(i + 1) % 4])
    ]
    world = np.stack(edges) @ pose.rotation.T + pose.position
    return Segments(f'camera {name}', world, (0.1, 0.5, 0.9, alpha), 0.003)


def rays_shape(lens: Lens, pose: Pose, points: Array, name: str) -> Segments:
    """Return the rays from each landmark (N, 3), m, to the viewpoint it has in the lens."""
    rays = incidence(lens, pose.into_body(points))
    viewpoint = np.zeros((len(points), 3))
    viewpoint[:, 2] = lens.shift_at(rays.theta)
    start = viewpoint @ pose.rotation.T + pose.position
    both = np.stack([start, points], axis=1)[rays.valid].reshape(-1, 3)
    return Segments(f'rays {name}'.strip(), both, (0.9, 0.5, 0.1, 0.5), 0.001)


def epipolar_shapes(lens: Lens, pose: Pose, curves: Array, uv: Array) -> list[Segments]:
    """Return epipolar curves (N, K, 2) and image points (N, 2), px, on the base of the camera.

    The longer side of the image is the side of the base; curves are cut where they are NaN.
    """
    def to_frustum(pixels: Array) -> Array:
        size = np.array([lens.width, lens.height])
        sideways = (pixels - (size - 1) / 2) * 2 * _HALF_BASE / size.max()
        ahead = np.full((*sideways.shape[:-1], 1), _CAMERA_SIZE)
        return np.concatenate([sideways, ahead], axis=-1) @ pose.rotation.T + pose.position

    steps = np.stack([curves[:, :-1], curves[:, 1:]], axis=2).reshape(-1, 2, 2)
    known = steps[np.isfinite(steps).all(axis=(1, 2))].reshape(-1, 2)
    return [
        Segments('epipolar curves', to_frustum(known), (0.8, 0.2, 0.2, 0.8), 0.0003),
        Segments('image points', to_frustum(uv), (0.1, 0.1, 0.1, 1.0), 0.001, lines=False),
    ]
