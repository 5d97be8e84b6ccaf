"""Hand-eye calibration: where a camera sits in the flange of a robot, and the target in its base.

Or, the other way round, where a fixed camera stands in the base, and the target on the flange:
that is the same with the inverses of the flange's poses.  Both are solved, the likelier is fitted.

The robot states poses of its flange in its base; the images state poses of the camera in the
target.  One transform each, one scale of lengths, and the noise of the robot's poses, in m and
rad, are fitted together with poses, intrinsics and effects; the two variances are those that the
data state (MacKay, Bayesian interpolation, 1992, eq. 4.10).  A camera whose own poses are known
is the same with both transforms near the identity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.pose import (
    Pose,
    cross_matrix,
    log_derivative,
    nearest_rotation,
    quaternion_from_rotation,
)
from fisheye_svp_ros.solve.bundle_adjustment import Adjustment, adjust_poses
from fisheye_svp_ros.solve.least_squares import (
    Arrays,
    ArrowEquations,
    arrow_covariance,
    arrow_information,
    levenberg_marquardt,
)
from fisheye_svp_ros.solve.reliability import noise_sigma
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, RigViews

PARAMETERS = 13  # camera in flange, target in base, scale
MIN_FRAMES = 4
_MIN_TURN = 1e-3  # second singular value of the turns relative to the first: two axes
_MAX_SHARE, _MAX_TURN = 0.03, 0.05  # of the camera's distance, and rad: more is no robot's noise
_MIN_ODDS = 20.0  # of an arrangement against the other
MAX_ODDS = 1e6  # what is more is as good as certain
_MIN_NOISE = 1e-7  # m, rad: what is written has no more digits
_ROUNDS = 40
_TOLERANCE = 1e-3  # relative, of the noise
_MIN_EIGENVALUE = 1e-9  # of the information of unit diagonal


class Transforms(NamedTuple):
    """Camera in flange, target in base, and what the robot's lengths are multiplied by."""

    camera: Pose
    target: Pose
    scale: float

    def flange(self, camera: Pose) -> Pose:
        """Return the flange in the base, in lengths of the target, of cameras (F,) in it."""
        rows = [0] * len(camera.position)
        return (
            self.target.reshape(1)
            .take(rows)
            .compose(camera)
            .compose(self.camera.reshape(1).take(rows).inverse())
        )


@dataclass(frozen=True)
class HandEye:
    """A hand-eye calibration.

    camera: in the flange; target: in the base; or, of a fixed camera, camera: in the base; target:
    in the flange; odds: of this arrangement against the other, MAX_ODDS at most; scale: of the
    robot's lengths to those of the target; covariance (13, 13): of the changes of the two in
    `Pose.retract` and of the scale; noise_m, noise_rad: standard deviations of the robot's poses,
    one axis; frame (F,): the frames that have a pose; residual (F, 6): flange by the images minus
    flange by the robot, m, rad.
    """

    camera: Pose
    target: Pose
    scale: float
    covariance: Array
    noise_m: float
    noise_rad: float
    frame: Index
    residual: Array
    fixed_camera: bool = False
    odds: float = MAX_ODDS

    @property
    def transform_names(self) -> tuple[str, str]:
        """What the two transforms are called."""
        if self.fixed_camera:
            return 'camera in base', 'target in flange'
        return 'camera in flange', 'target in base'

    @property
    def stderr(self) -> Array:
        """Standard errors (13,) of the parameters, m and rad."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def to_dict(self) -> dict[str, Any]:
        """Return what files hold: m, rad, quaternions x, y, z, w.

        covariance: of both transforms, each (dx, dy, dz, rotation about x, y, z) in its reference
        frame, and of the scale.
        """

        def entry(pose: Pose) -> dict[str, list[float]]:
            return {
                'position': pose.position.tolist(),
                'quaternion': quaternion_from_rotation(pose.rotation).tolist(),
            }

        camera, target = (place.replace(' ', '_') for place in self.transform_names)
        return {
            camera: entry(self.camera),
            target: entry(self.target),
            'odds': self.odds,
            'scale': self.scale,
            'covariance': self.covariance.tolist(),
            'noise_m': self.noise_m,
            'noise_rad': self.noise_rad,
            'frames': len(self.frame),
        }


def solve_hand_eye(camera: Pose, flange: Pose, scale: float | None = None) -> Transforms:
    """Solve both transforms and the scale from poses (F,) alone, without start values.

    camera: in the target; flange: in the base; scale: where it is known.  Rotations by the
    Kronecker product (Shah, Solving the robot-world/hand-eye calibration problem using the
    Kronecker product, 2013), then the rest, which is linear.
    Raises GeometryError where the flange does not turn about two axes.
    """
    _check_turns(flange)
    # R_flange R_mount = R_base R_camera: both rotations are of the first singular vectors of this.
    product = np.einsum('fij,fkl->ikjl', flange.rotation, camera.rotation).reshape(9, 9)
    left, _, right = np.linalg.svd(product)
    first, second = left[:, 0].reshape(3, 3), right[0].reshape(3, 3)
    sign = np.sign(np.linalg.det(first))
    base, mount = nearest_rotation(sign * first), nearest_rotation(sign * second)
    if np.linalg.det(second) * sign < 0:
        raise GeometryError('no hand-eye transform explains the rotations of the robot')
    return _solve_lengths(camera, flange, base, mount, scale)


def _solve_lengths(
    camera: Pose, flange: Pose, base: Array, mount: Array, scale: float | None
) -> Transforms:
    """Return the transforms of known rotations: scale p_f = R_b p_c + t_b - R_f t_m is linear."""
    frames = len(flange.position)
    columns = np.concatenate(
        [
            np.broadcast_to(np.eye(3), (frames, 3, 3)),
            -flange.rotation,
            -flange.position[..., None],
        ],
        axis=-1,
    ).reshape(-1, 7)
    right = -(camera.position @ base.T).ravel()
    if scale is not None:
        columns, right = columns[:, :6], right - scale * columns[:, 6]
    solved = np.linalg.lstsq(columns, right, rcond=None)[0]
    return Transforms(
        Pose(mount, solved[3:6]),
        Pose(base, solved[:3]),
        float(solved[6]) if scale is None else scale,
    )


def _check_turns(flange: Pose) -> None:
    if len(flange.position) < MIN_FRAMES:
        raise GeometryError(
            f'{len(flange.position)} of the frames have a pose of the robot; {MIN_FRAMES} or more '
            'are needed; check the frame numbers of the poses'
        )
    sizes = turn_sizes(flange)
    if not sizes[1] > max(_MIN_TURN, _MIN_TURN * sizes[0]):
        raise GeometryError(
            'the flange turns about one axis at most; turn it about two axes or '
            'more, by 20 degrees or more'
        )


def turn_sizes(poses: Pose) -> Array:
    """Return how far poses (F,) turn from the first about three axes, rad, largest first."""
    turns = poses.difference(poses.take([0] * len(poses.position)))[:, 3:]
    return np.asarray(np.linalg.svd(turns, compute_uv=False), dtype=float)


def fit_hand_eye(
    data: RigViews,
    state: RigState,
    free: Sequence[str],
    flange: Pose,
    known: Mask,
    lens_covariance: Array | None = None,
) -> tuple[RigState, HandEye]:
    """Fit hand-eye transform, noise of the robot, poses, intrinsics and effects together.

    state: to start from, fitted to the images; flange (F,): in the base, of the frames where
    `known` (F,), which have a pose of the robot; lens_covariance (K, K): of the free intrinsics
    in the state, where more than the noise of the images makes their errors.
    Raises GeometryError where the poses do not determine the transform, or fit none.
    """
    linear = Linearization(data, state, free)
    unknowns = 6 * data.frames + linear.shared_columns.shape[-1]
    sigma_stated = bool(np.isfinite(data.observations.sigma).all())
    sigma = (
        1.0
        if sigma_stated
        else noise_sigma(linear.sum_of_squares, int(linear.row_mask.sum()), unknowns)
    )
    start, robot, noise, odds = _likelier_arrangement(state.pose, flange, known, sigma)
    _check_noise(noise, state.pose.take(known), odds)
    lens = None
    if lens_covariance is not None:
        lens = _LensKnowledge.instead_of_images(data, state, free, lens_covariance / sigma**2)
    for _ in range(_ROUNDS):
        problem = _HandEyeAdjustment(data, state, free, robot, noise, lens)
        minimum = levenberg_marquardt(problem, problem.pack_all(state, start))
        state, start = problem.unpack(minimum.state), problem.transforms(minimum.state, 0)
        before, noise = noise, problem.estimate_noise(state, start)
        if np.abs(noise / before - 1).max() < _TOLERANCE or (noise <= _MIN_NOISE).all():
            break
    covariance = problem.covariance(state, start)
    return state, HandEye(
        start.camera,
        start.target,
        start.scale,
        covariance,
        float(noise[0]),
        float(noise[1]),
        data.frame_numbers[known],
        robot.residual(start, state.pose)[known],
        robot.fixed_camera,
        odds,
    )


def _likelier_arrangement(
    camera: Pose, flange: Pose, known: Mask, sigma: float
) -> tuple[Transforms, _Robot, Array, float]:
    """Return transforms, robot and noise (2,) with the camera on the flange, or with the target.

    And the odds of that arrangement against the other: both have as many parameters, so that they
    are those of the noise that each leaves.
    """
    starts: list[tuple[float, Transforms, _Robot, Array]] = []
    problem: GeometryError | None = None
    freedom = 3 * int(known.sum()) - PARAMETERS / 2  # of positions, and of turns
    for fixed in (False, True):
        stated = flange.inverse() if fixed else flange
        try:
            start = solve_hand_eye(camera.take(known), stated.take(known))
        except GeometryError as cause:
            problem = problem or cause
            continue
        robot = _Robot(flange, known, sigma, fixed)
        off = robot.residual(start, camera)[known].reshape(-1, 2, 3)
        noise = np.maximum(np.sqrt((off**2).mean(axis=(0, 2))), _MIN_NOISE)
        # Of the robot, in its own lengths: a scale near zero would explain any position.
        relative = noise / [max(abs(start.scale), _MIN_NOISE), 1.0]
        starts.append((-freedom * float(np.log(relative).sum()), start, robot, noise))
    if not starts:
        assert problem is not None
        raise problem
    likelihood, start, robot, noise = max(starts, key=lambda one: one[0])
    runner_up = min(start[0] for start in starts) if len(starts) > 1 else -np.inf
    odds = min(float(np.exp(min(likelihood - runner_up, 100.0))), MAX_ODDS)
    return start, robot, noise, odds


def _check_noise(noise: Array, camera: Pose, odds: float) -> None:
    distance = float(np.median(np.linalg.norm(camera.position, axis=1)))
    if noise[0] > _MAX_SHARE * distance or noise[1] > _MAX_TURN:
        raise GeometryError(
            'no hand-eye transform explains the poses of the robot, with camera or target on '
            f'the flange: {1000 * noise[0]:.0f} mm and {np.degrees(noise[1]):.1f} degrees are '
            'left. Check the frame numbers, the units, and the order of the quaternion (x, y, '
            'z, w)'
        )
    if odds < _MIN_ODDS:
        raise GeometryError(
            f'it is unclear whether the camera or the target is on the flange (odds {odds:.2g} '
            'to 1); turn the flange farther, and take more poses'
        )


class _Robot(NamedTuple):
    """Poses of the flange (F,), the frames that have one, and the noise of the images, px.

    fixed_camera: the target is on the flange, so that the transforms give the flange's inverse.
    """

    flange: Pose
    known: Mask
    sigma: float
    fixed_camera: bool = False

    def residual(self, transforms: Transforms, camera: Pose) -> Array:
        """Return flange by the images minus flange by the robot (F, 6), zero where unknown."""
        stated = Pose(self.flange.rotation, transforms.scale * self.flange.position)
        flange = transforms.flange(camera)
        off = (flange.inverse() if self.fixed_camera else flange).difference(stated)
        return np.where(self.known[:, None], off, 0.0)

    def columns(self, transforms: Transforms, camera: Pose) -> tuple[Array, Array]:
        """Return derivatives (F, 6, 6) by the camera's pose and (F, 6, 13) by what is shared."""
        flange = transforms.flange(camera)
        base = np.broadcast_to(transforms.target.rotation, flange.rotation.shape)
        lever = cross_matrix(flange.rotation @ transforms.camera.position)
        frame = np.zeros((len(base), 6, 6))
        frame[:, :3, :3], frame[:, :3, 3:], frame[:, 3:, 3:] = base, lever @ base, base
        shared = np.zeros((len(base), 6, PARAMETERS))
        shared[:, :3, :3] = -flange.rotation
        shared[:, :3, 3:6] = -flange.rotation @ cross_matrix(transforms.camera.position)
        shared[:, 3:, 3:6] = -flange.rotation
        shared[:, :3, 6:9] = np.eye(3)
        shared[:, :3, 9:12] = -cross_matrix(flange.position - transforms.target.position)
        shared[:, 3:, 9:12] = np.eye(3)
        if self.fixed_camera:
            inverse = _inverse_derivative(flange)
            frame, shared = inverse @ frame, inverse @ shared
        turned = log_derivative(self.residual(transforms, camera)[:, 3:])
        frame[:, 3:], shared[:, 3:] = turned @ frame[:, 3:], turned @ shared[:, 3:]
        shared[:, :3, 12] = -self.flange.position
        mask = self.known[:, None, None]
        return np.where(mask, frame, 0.0), np.where(mask, shared, 0.0)


def _inverse_derivative(pose: Pose) -> Array:
    """Return the change (F, 6, 6) of the inverses of poses (F,) by that of the poses."""
    inverse = pose.inverse()
    change = np.zeros((len(inverse.position), 6, 6))
    change[:, :3, :3] = change[:, 3:, 3:] = -inverse.rotation
    change[:, :3, 3:] = -inverse.rotation @ cross_matrix(pose.position)
    return change


class _LensKnowledge(NamedTuple):
    """What is to be added to the images' rows, so that they say of a lens what is known of it.

    An image counts each point as noise of its own.  A target or an image field that is off moves
    many points alike: generalized least squares knows less of the lens, and has it elsewhere.
    values (K,): the lens; information (K, K), gradient (K,): known minus the images' own.
    """

    values: Array
    information: Array
    gradient: Array

    @classmethod
    def instead_of_images(
        cls, data: RigViews, state: RigState, free: Sequence[str], covariance: Array
    ) -> _LensKnowledge:
        """Return it for a state that is known with a covariance (K, K), in squares of a row."""
        state = adjust_poses(data, state)
        images = Adjustment(data, state, free)
        normal = images.linearize(images.pack([state]), np.zeros(1, dtype=int))[1]
        size = np.sqrt(np.diag(covariance))
        known = np.linalg.pinv(covariance / np.outer(size, size), hermitian=True)
        return cls(
            state.shared_values(free),
            known / np.outer(size, size) - arrow_information(normal)[0],
            -ArrowEquations(*normal).shared_gradient[0],  # of the poses there is none left
        )

    def add(self, state: RigState, free: Sequence[str], shared: Array, gradient: Array) -> float:
        """Add to the normal equations of a state, in place; return what the cost is more."""
        count = len(self.values)
        change = state.shared_values(free) - self.values
        shared[:count, :count] += self.information
        gradient[:count] += self.information @ change + self.gradient
        return float(change @ self.information @ change + 2 * self.gradient @ change)


class _HandEyeAdjustment(Adjustment):
    """A bundle adjustment with the robot's poses: their rows, and 13 more shared parameters."""

    def __init__(
        self,
        data: RigViews,
        template: RigState,
        free: Sequence[str],
        robot: _Robot,
        noise: Array,
        lens: _LensKnowledge | None = None,
    ) -> None:
        super().__init__(data, template, free)
        self._robot, self._lens = robot, lens
        self._weight = robot.sigma / np.repeat(noise, 3)

    def pack_all(self, state: RigState, transforms: Transforms) -> Arrays:
        """Return a state and the transforms, which come last."""
        parts = (*transforms.camera, *transforms.target, np.array([transforms.scale]))
        return (*self.pack([state]), *(part[None] for part in parts))

    def unpack(self, packed: Arrays, system: int = 0) -> RigState:
        return super().unpack(packed[:5], system)

    def transforms(self, packed: Arrays, system: int) -> Transforms:
        """Return the transforms of one of the states."""
        *poses, scale = (part[system] for part in packed[5:])
        return Transforms(Pose(*poses[:2]), Pose(*poses[2:]), float(scale[0]))

    def retract(self, state: Arrays, step: Arrays) -> Arrays:
        frame, shared = step
        mount, target, scale = np.split(shared[:, -PARAMETERS:], (6, 12), axis=1)
        return (
            *super().retract(state[:5], (frame, shared[:, :-PARAMETERS])),
            *Pose(*state[5:7]).retract(mount),
            *Pose(*state[7:9]).retract(target),
            state[9] + scale,
        )

    def estimate_noise(self, state: RigState, transforms: Transforms) -> Array:
        """Return the noise (2,) of the robot, m and rad: of its residuals' own freedom."""
        equations = ArrowEquations(*self._joint(state, transforms)[1])
        frame, shared = self._robot.columns(transforms, state.pose)
        blocks = equations.blocks[0]
        inverse = np.linalg.inv(blocks)
        coupled = -frame @ inverse @ equations.cross[0]
        coupled[..., -PARAMETERS:] += shared
        whole = arrow_covariance(tuple(equations))[1][0]
        variance = frame @ inverse @ np.swapaxes(frame, -1, -2)
        variance = variance + coupled @ whole @ np.swapaxes(coupled, -1, -2)
        leverage = np.diagonal(variance, axis1=-2, axis2=-1) * self._weight**2
        residual = self._robot.residual(transforms, state.pose)
        has_flange = self._robot.known
        freedom = (1 - leverage[has_flange]).reshape(-1, 2, 3).sum(axis=(0, 2))
        squares = (residual[has_flange] ** 2).reshape(-1, 2, 3).sum(axis=(0, 2))
        return np.asarray(np.maximum(np.sqrt(squares / np.maximum(freedom, 1e-3)), _MIN_NOISE))

    def covariance(self, state: RigState, transforms: Transforms) -> Array:
        """Return the covariance (13, 13) of the transforms; raise where they are undetermined."""
        normal = self._joint(state, transforms)[1]
        information = arrow_information(normal)[0]
        scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
        relative = information[-PARAMETERS:, -PARAMETERS:] / np.outer(
            scale[-PARAMETERS:], scale[-PARAMETERS:]
        )
        if np.linalg.eigvalsh(relative)[0] < _MIN_EIGENVALUE:
            raise GeometryError(
                'the poses of the robot do not determine the hand-eye transform; '
                'turn the flange about two axes or more, and move it'
            )
        whole = arrow_covariance(normal)[1][0]
        return np.asarray(self._robot.sigma**2 * whole[-PARAMETERS:, -PARAMETERS:])

    def _equations(self, packed: Arrays, system: int) -> tuple[Array, Arrays]:
        return self._joint(self.unpack(packed, system), self.transforms(packed, system))

    def _joint(self, state: RigState, transforms: Transforms) -> tuple[Array, Arrays]:
        """Return cost (1,) and normal equations with those of the robot's poses."""
        cost, normal = self._system(state)
        blocks, cross, shared, block_gradient, shared_gradient = (part[0] for part in normal)
        off = self._robot.residual(transforms, state.pose) * self._weight
        frame, own = (
            part * self._weight[:, None] for part in self._robot.columns(transforms, state.pose)
        )
        transposed = np.swapaxes(frame, -1, -2)
        added = ArrowEquations(
            blocks + transposed @ frame,
            np.concatenate([cross, transposed @ own], axis=-1),
            np.pad(shared, (0, PARAMETERS)),
            block_gradient + (transposed @ off[..., None])[..., 0],
            np.concatenate([shared_gradient, np.einsum('fmk,fm->k', own, off)]),
        )
        added.shared[-PARAMETERS:, -PARAMETERS:] += np.einsum('fmk,fml->kl', own, own)
        cost = cost + (off**2).sum()
        if self._lens:
            cost = cost + self._lens.add(state, self._free, added.shared, added.shared_gradient)
        return cost, tuple(part[None] for part in added)


def flange_poses(data: RigViews, poses: dict[int, Pose]) -> tuple[Pose, Mask]:
    """Return poses (F,) of the flange by frame number, and which frames (F,) have one.

    A frame that the first camera did not see, of cameras that no rig holds together, has none.
    """
    numbers = data.frame_numbers.tolist()
    has_pose = np.array([number in poses for number in numbers])
    if data.frames > len(set(numbers)):
        has_pose &= np.isin(np.arange(data.frames), data.frame_of[data.camera_of == 0])
    missing = Pose(np.eye(3), np.zeros(3))
    return Pose.stack([poses.get(number, missing) for number in numbers]), has_pose
