"""Rigid transforms, batch first.

A Pose holds the camera (or board, or rig) in its reference frame: x_ref = R x_body + p.  Small
changes are six-vectors (dp, dphi): p + dp, exp(dphi) R, both in the reference frame, in the order
of geometry_msgs/PoseWithCovariance.
"""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from fisheye_svp_ros.arrays import Array, Batch, Mask
from fisheye_svp_ros.errors import GeometryError

# Kita's camera at the origin gazes along -z with x right, y up; the optical frame has y down.
PAPER_FROM_OPTICAL: Array = np.diag([1.0, -1.0, -1.0])

_IDENTITY: Array = np.eye(3)
_ORTHONORMAL = 1e-3  # printed digits are forgiven, another convention is not
# [v]x, row by row, of the unit vectors
_CROSS: Array = np.array(
    [
        [0.0, 0, 0, 0, 0, -1, 0, 1, 0],
        [0.0, 0, 1, 0, 0, 0, -1, 0, 0],
        [0.0, -1, 0, 1, 0, 0, 0, 0, 0],
    ]
)


class _Pose(NamedTuple):
    rotation: Array
    position: Array


class Pose(_Pose, Batch):
    """Rotation (..., 3, 3) and position (..., 3), m, of a body in its reference frame."""

    __slots__ = ()

    def __new__(cls, rotation: ArrayLike, position: ArrayLike) -> Self:
        """Check the arrays; raise GeometryError for other shapes, and for one that is no rotation.

        NaN stands for a pose that is not known.  Poses made of poses, `_make`, are not checked.
        """
        turn, place = np.asarray(rotation, dtype=float), np.asarray(position, dtype=float)
        if turn.shape[-2:] != (3, 3) or place.shape[-1:] != (3,):
            raise GeometryError(
                f'a pose has a rotation (..., 3, 3) and a position (..., 3), not {turn.shape} '
                f'and {place.shape}'
            )
        if turn.ndim > 2:  # solvers begin batches anywhere, and refuse what comes of it
            return super().__new__(cls, turn, place)
        gram = turn @ np.swapaxes(turn, -1, -2)
        with np.errstate(invalid='ignore'):  # of unknown poses
            turned = np.linalg.det(turn) < 0
        if (np.abs(gram - _IDENTITY) > _ORTHONORMAL).any() or turned.any():
            raise GeometryError(
                'the rotation of a pose is not a rotation matrix; R RT = 1 and det R = 1 are '
                'needed'
            )
        return super().__new__(cls, turn, place)

    def __repr__(self) -> str:
        if self.position.ndim > 1:
            return f'Pose{self.position.shape[:-1]}'
        x, y, z = self.position
        turn = ', '.join(f'{part:.4g}' for part in np.degrees(vector_from_rotation(self.rotation)))
        return f'Pose({x:.6g}, {y:.6g}, {z:.6g} m; rotation vector {turn} degree)'

    def inverse(self) -> Pose:
        """Return the reference frame in the body."""
        rotation = np.swapaxes(self.rotation, -1, -2)
        return Pose._make((rotation, -(rotation @ self.position[..., None])[..., 0]))

    def compose(self, other: Pose) -> Pose:
        """Return the pose of `other`'s body, given in this body's frame, in this reference."""
        return Pose._make((self.rotation @ other.rotation, self.transform(other.position)))

    def transform(self, points: Array) -> Array:
        """Map points (..., 3) from the body to the reference frame, one a pose."""
        return (self.rotation @ points[..., None])[..., 0] + self.position

    def into_body(self, points: Array) -> Array:
        """Map points (..., N, 3) from the reference to the body frame, N a pose."""
        return (points - self.position[..., None, :]) @ self.rotation

    def retract(self, change: Array) -> Pose:
        """Apply small changes (..., 6): m, rad."""
        rotation = rotation_from_vector(change[..., 3:]) @ self.rotation
        return Pose._make((rotation, self.position + change[..., :3]))

    def difference(self, true: Pose) -> Array:
        """Return the change (..., 6) that leads from `true` to this pose."""
        turn = vector_from_rotation(self.rotation @ np.swapaxes(true.rotation, -1, -2))
        return np.concatenate([self.position - true.position, turn], axis=-1)

    @property
    def shape(self) -> tuple[int, ...]:
        """The leading axes."""
        return self.position.shape[:-1]

    def reshape(self, *shape: int) -> Pose:
        """Return the same poses with other leading axes."""
        return Pose._make((self.rotation.reshape(*shape, 3, 3), self.position.reshape(*shape, 3)))

    def broadcast_to(self, *shape: int) -> Pose:
        """Return the poses repeated along leading axes; not to be written to."""
        return Pose._make(
            (
                np.broadcast_to(self.rotation, (*shape, 3, 3)),
                np.broadcast_to(self.position, (*shape, 3)),
            )
        )

    def where(self, chosen: Mask, other: Pose) -> Pose:
        """Return these poses where chosen (...), and others where not."""
        return Pose._make(
            (
                np.where(chosen[..., None, None], self.rotation, other.rotation),
                np.where(chosen[..., None], self.position, other.position),
            )
        )


def identity(*shape: int) -> Pose:
    """Return identity poses of the given batch shape."""
    return Pose._make((np.tile(_IDENTITY, (*shape, 1, 1)), np.zeros((*shape, 3))))


def rotation_from_vector(vector: Array) -> Array:
    """Exponential map: rotation vectors (..., 3), rad, to matrices (..., 3, 3)."""
    half = 0.5 * np.sqrt(np.sum(vector * vector, axis=-1))[..., None, None]
    half = np.maximum(half, 1e-100)  # sin(x) / x is 1 there
    ratio = np.sin(half) / half
    k = cross_matrix(vector)
    rotation: Array = _IDENTITY + ratio * (np.cos(half) * k + (0.5 * ratio) * (k @ k))
    return rotation


def vector_from_rotation(rotation: Array) -> Array:
    """Logarithm: rotation matrices (..., 3, 3) to rotation vectors (..., 3), rad."""
    quaternion = quaternion_from_rotation(rotation)
    sine = np.linalg.norm(quaternion[..., :3], axis=-1, keepdims=True)
    # With strides, the last digit of NumPy 1.26's arctan2 depends on where the arrays lie.
    angle = 2 * np.arctan2(sine, np.ascontiguousarray(quaternion[..., 3:]))
    scale = np.where(sine < 1e-9, 2.0, angle / np.where(sine < 1e-9, 1.0, sine))
    vector: Array = quaternion[..., :3] * scale
    return vector


def cross_matrix(vector: Array) -> Array:
    """Return [v]x (..., 3, 3) of vectors (..., 3)."""
    cross: Array = (vector @ _CROSS).reshape(*vector.shape, 3)
    return cross


def log_derivative(vector: Array) -> Array:
    """Return d log(exp(e) exp(v)) / de (..., 3, 3) of rotation vectors v (..., 3), at e = 0.

    The inverse of the left Jacobian of SO(3): Barfoot, State Estimation for Robotics, (7.76).
    """
    half = np.maximum(np.linalg.norm(vector, axis=-1) / 2, 1e-6)[..., None, None]
    k = cross_matrix(vector)
    return np.asarray(np.eye(3) - k / 2 + (1 - half / np.tan(half)) / (4 * half**2) * (k @ k))


def rotation_from_quaternion(quaternion: ArrayLike) -> Array:
    """Unit quaternions (..., 4) in ROS order x, y, z, w to matrices; the norm is divided out."""
    q = np.asarray(quaternion, dtype=float)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    k = cross_matrix(q[..., :3])
    w = q[..., 3, None, None]
    rotation: Array = _IDENTITY + 2 * w * k + 2 * (k @ k)
    return rotation


def quaternion_from_rotation(rotation: Array) -> Array:
    """Matrices (..., 3, 3) to unit quaternions (..., 4), x, y, z, w with w >= 0."""
    # 4 q qT, which is linear in the rotation; its row of the largest diagonal term, one of the
    # four candidates of Shepperd (1978), is the best conditioned multiple of q.
    outer = rotation.reshape(-1, 9) @ _QUATERNION_PRODUCT + _UNIT
    best = outer[:, ::5].argmax(axis=1)
    chosen: Array = outer.reshape(-1, 4, 4)[np.arange(len(outer)), best]
    chosen /= np.copysign(np.sqrt((chosen * chosen).sum(axis=1)), chosen[:, 3])[:, None]
    return chosen.reshape(*rotation.shape[:-2], 4)


def _quaternion_product_matrix() -> Array:
    """Return the matrix (9, 16) that makes 4 q qT, but for the identity, of a rotation matrix."""
    outer = np.zeros((3, 3, 4, 4))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        outer[i, i, range(4), range(4)] = -1.0
        outer[i, i, i, i] = outer[i, i, 3, 3] = 1.0
        outer[i, j, i, j] = outer[i, j, j, i] = outer[j, i, i, j] = outer[j, i, j, i] = 1.0
        outer[k, j, i, 3] = outer[k, j, 3, i] = 1.0
        outer[j, k, i, 3] = outer[j, k, 3, i] = -1.0
    return outer.reshape(9, 16)


_QUATERNION_PRODUCT = _quaternion_product_matrix()
_UNIT = np.eye(4).ravel()


def nearest_rotation(matrix: Array) -> Array:
    """Project matrices (..., 3, 3) onto the rotations, in the Frobenius norm."""
    u, _, vt = np.linalg.svd(matrix)
    sign = np.ones(matrix.shape[:-1])
    sign[..., 2] = np.linalg.det(u @ vt)
    rotation: Array = (u * sign[..., None, :]) @ vt
    return rotation


def axis_angle_between(a: Pose, b: Pose) -> Array:
    """Angle between the viewing axes (z) of two poses, rad, (...)."""
    first, second = a.rotation[..., 2], b.rotation[..., 2]
    cross = np.linalg.norm(np.cross(first, second), axis=-1)
    angle: Array = np.arctan2(cross, np.sum(first * second, axis=-1))
    return angle


def carried_pose(pose: Pose, covariance: Array, mount: Pose) -> tuple[Pose, Array]:
    """Return the pose of a frame that stands at `mount` in a body, and its covariance (6, 6).

    Of the change in `Pose.retract`: a turn of the body about its origin moves the frame along
    (the adjoint of SE(3), both changes in the axes of the world).
    """
    carried = pose.compose(mount)
    adjoint = np.eye(6)
    adjoint[:3, 3:] = -cross_matrix(carried.position - pose.position)
    return carried, np.asarray(adjoint @ covariance @ adjoint.T)
