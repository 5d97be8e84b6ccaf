"""Poses, rig and intrinsics by Gauss-Newton steps, and what they leave of a displacement."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from benchmark.studies.independent.camera import (
    Array,
    Lens,
    intrinsic_jacobian,
    point_jacobian,
    project,
)
from benchmark.studies.independent.scene import Scene, in_camera


class Step(NamedTuple):
    """A step of every pose (F, 6), of rig and intrinsics (g,), and what is left (M, 2), px."""

    poses: Array
    common: Array
    left: Array


def _crossed(points: Array) -> Array:
    """Return d(ω × P)/dω, (M, 3, 3)."""
    zero, (x, y, z) = np.zeros(len(points)), points.T
    return np.array([[zero, z, -y], [-z, zero, x], [y, -x, zero]]).transpose(2, 0, 1)


def _columns(scene: Scene, lens: Lens, points: Array) -> tuple[Array, Array]:
    """Return columns of the frame's own pose (M, 2, 6) and of rig and intrinsics (M, 2, g)."""
    slope = point_jacobian(lens, points)
    pose = np.concatenate([slope @ _crossed(points), slope], axis=2)
    common = [intrinsic_jacobian(lens, points)] if scene.fitted else []
    if scene.rig is not None:
        right = scene.camera == 1
        common.append(np.where(right[:, None, None], pose, 0.0))
        left = scene.rig[0].inv().apply(points[right] - scene.rig[1])
        turned = slope[right] @ scene.rig[0].as_matrix()
        pose[right] = np.concatenate([turned @ _crossed(left), turned], axis=2)
    return pose, np.concatenate([np.zeros((len(points), 2, 0)), *common], axis=2)


@dataclass(frozen=True)
class Free:
    """What is legitimately free about a scene: its columns, poses eliminated frame by frame."""

    scene: Scene
    pose: Array
    common: Array

    @classmethod
    def of(cls, scene: Scene, lens: Lens | None = None, points: Array | None = None) -> Free:
        """Return the columns at points (M, 3) in the camera frames; the true ones by default."""
        if points is None:
            world = scene.target.points[scene.landmark]
            points = in_camera(scene, world, np.zeros(len(world)))
        return cls(scene, *_columns(scene, lens or scene.lens, points))

    def step(self, displacement: Array, weight: Array | None = None) -> Step:
        """Return the least-squares step that explains displacements (M, 2), px."""
        root = np.sqrt(np.ones(len(displacement)) if weight is None else weight)[:, None]
        g = self.common.shape[2]
        normal, right, solved = np.zeros((g, g)), np.zeros(g), []
        for frame in range(self.scene.frames):
            rows = self.scene.frame == frame
            w = np.repeat(root[rows], 2, axis=1).ravel()
            q, r = np.linalg.qr(self.pose[rows].reshape(-1, 6) * w[:, None])
            d = displacement[rows].ravel() * w
            c = self.common[rows].reshape(len(w), g) * w[:, None]
            solved.append((q, r, c, d))
            across = c - q @ (q.T @ c)
            normal += across.T @ across
            right += across.T @ d
        scale = 1 / np.sqrt(np.diag(normal))
        normal *= np.outer(scale, scale)
        common = scale * np.linalg.lstsq(normal, right * scale, rcond=None)[0]
        poses = np.array([np.linalg.solve(r, q.T @ (d - c @ common)) for q, r, c, d in solved])
        moved = np.einsum('mij,mj->mi', self.pose, poses[self.scene.frame]) + self.common @ common
        return Step(poses, common, displacement - moved)

    def size(self, displacement: Array) -> float:
        """Return what free parameters leave of displacements (M, 2): rms a coordinate, px."""
        return float(np.sqrt(np.mean(self.step(displacement).left ** 2)))


def fit_lens(scene: Scene, uv: Array, start: Lens) -> tuple[Lens, float]:
    """Return the lens fitted to observed image points (M, 2) of the frames that are not held out.

    Poses and rig, with the true ones as start values, are fitted along; far points lose weight
    (Huber).  Also returns the rms of the 2-D residual norm, px.
    """
    kept = ~scene.held[scene.frame]
    _, renumbered = np.unique(scene.frame[kept], return_inverse=True)
    used = replace(
        scene,
        frame=renumbered,
        camera=scene.camera[kept],
        fitted=True,
        landmark=scene.landmark[kept],
        held=scene.held[~scene.held],
    )
    world, uv = scene.target.points[used.landmark], uv[kept]
    centers = scene.track.centers[~scene.held]
    turns, rig, lens = scene.track.turns[~scene.held].inv(), scene.rig, start
    shifts = -turns.apply(centers)
    for _ in range(12):
        points = turns[renumbered].apply(world) + shifts[renumbered]
        if rig is not None:
            right = used.camera == 1
            points[right] = rig[0].apply(points[right]) + rig[1]
        used = replace(used, rig=rig)
        missing = uv - project(lens, points)
        norm = np.linalg.norm(missing, axis=1)
        weight = np.minimum(1.0, 3 * np.median(norm) / np.maximum(norm, 1e-9))
        step = Free.of(used, lens, points).step(missing, weight)
        turn = Rotation.from_rotvec(step.poses[:, :3])
        turns, shifts = turn * turns, turn.apply(shifts) + step.poses[:, 3:]
        lens = _moved(lens, step.common[: 4 + len(lens.k)])
        if rig is not None:
            turn = Rotation.from_rotvec(step.common[-6:-3])
            rig = (turn * rig[0], turn.apply(rig[1]) + step.common[-3:])
    return lens, float(np.sqrt(np.mean(norm**2)))


def _moved(lens: Lens, step: Array) -> Lens:
    fx, fy, cx, cy = (np.array([lens.fx, lens.fy, lens.cx, lens.cy]) + step[:4]).tolist()
    k = tuple((np.array(lens.k) + step[4:]).tolist())
    return replace(lens, fx=fx, fy=fy, cx=cx, cy=cy, k=k)
