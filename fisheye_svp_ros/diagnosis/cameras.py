"""The forward models of all cameras: one lens for all of them, or one for each of a rig."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.effects.base import Effect, Scene, Term
from fisheye_svp_ros.effects.forward import ForwardModel, LinearViews
from fisheye_svp_ros.effects.of_cameras import OfCameras, camera_terms
from fisheye_svp_ros.optics.camera import Incidence, lens_columns
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, identity
from fisheye_svp_ros.scene.observations import Views
from fisheye_svp_ros.solve.localization import localize


class Part(NamedTuple):
    """The views (rows of all) of one model, linearised."""

    rows: Index
    camera: int
    linear: LinearViews


@dataclass(frozen=True)
class Seen:
    """Predicted image points of all views and their derivatives, as `LinearViews` has them."""

    parts: tuple[Part, ...]
    uv: Array
    d_pose: Array
    optical: Array

    @property
    def d_target(self) -> Array:
        """Derivatives (S, N, 2, 3) by the places of the points in the world, px/m."""
        return -self.d_pose[..., :3]


@dataclass
class RigScene(Scene):
    """What effects may look at: of all cameras at once, and camera by camera."""

    parts: tuple[tuple[Index, int, Scene], ...] = ()

    def normalised(self) -> Array:
        return _gathered((rows, scene.normalised()) for rows, _, scene in self.parts)


class Cameras:
    """Forward models by camera."""

    def __init__(self, lenses: Sequence[Lens], terms: Sequence[Term]) -> None:
        """One lens is that of every camera, and so are all effects; else each has its own."""
        if len(lenses) == 1:
            self.models = [ForwardModel(lenses[0], terms)]
        else:
            self.models = [
                ForwardModel(lens, camera_terms(terms, i)) for i, lens in enumerate(lenses)
            ]

    def model(self, camera: int) -> ForwardModel:
        """Return the model of a camera."""
        return self.models[camera if len(self.models) > 1 else 0]

    def linearise(self, pose: Pose, views: Views) -> Seen:
        """Predict and differentiate, each view by its camera's model."""
        parts = tuple(
            Part(rows, camera, model.linearise(pose.take(rows), views.take(rows)))
            for rows, camera, model in self._split(views)
        )
        uv, d_pose, optical = (
            _gathered((part.rows, getattr(part.linear, name)) for part in parts)
            for name in ('uv', 'd_pose', 'optical')
        )
        return Seen(parts, uv, d_pose, optical)

    def localize(self, views: Views, start: Pose | None = None) -> Pose:
        """Return the pose of every view; raises GeometryError as `localize` does."""
        found = identity(len(views.frame))
        for rows, _, model in self._split(views):
            near = None if start is None else start.take(rows)
            found.put(rows, localize(model, views.take(rows), near).pose)
        return found

    def offsets(self, pose: Pose, views: Views) -> Array:
        """Distances (S, N) of points from their predictions, px; NaN: padding; inf: unseen."""
        distance = np.linalg.norm(views.uv - self.linearise(pose, views).uv, axis=-1)
        return np.where(views.used, np.nan_to_num(distance, nan=np.inf), np.nan)

    def scene(self, pose: Pose, views: Views, seen: Seen) -> Scene:
        """Return what effects may look at once the views are linearised."""
        parts = tuple(
            (part.rows, part.camera, self.model(part.camera).scene(
                pose.take(part.rows), views.take(part.rows), part.linear
            )) for part in seen.parts
        )
        if len(self.models) == 1:
            return parts[0][2]
        rays = [(part.rows, part.linear.image.incidence) for part in seen.parts]
        unit = _gathered((rows, np.moveaxis(ray.unit, 0, -1)) for rows, ray in rays)
        incidence = Incidence(
            _gathered((rows, ray.theta) for rows, ray in rays), np.moveaxis(unit, -1, 0),
            _gathered((rows, ray.valid.astype(float)) for rows, ray in rays) > 0,
        )
        uv = _gathered((rows, scene.uv) for rows, _, scene in parts)
        return RigScene(views, self.models[0].lens, pose, uv, incidence, parts=parts)

    def effect_columns(self, effect: Effect, scene: Scene, seen: Seen) -> Array:
        """Derivatives (S, N, 2, P) of image points by the parameters of an effect."""
        if not isinstance(scene, RigScene):
            return self.models[0].effect_columns(effect, scene, seen.parts[0].linear)
        count = len(effect.parameters)
        columns = np.zeros((*seen.uv.shape, count))
        for part, (_, _, own) in zip(seen.parts, scene.parts, strict=True):
            model = self.model(part.camera)
            if not isinstance(effect, OfCameras):
                columns[part.rows] = model.effect_columns(effect, own, part.linear)
                continue
            term = effect.of_camera(part.camera, np.arange(float(count)))
            if term is not None:
                block = np.zeros((*part.linear.uv.shape, count))
                block[..., term[1].astype(int)] = model.effect_columns(term[0], own, part.linear)
                columns[part.rows] = block
        return columns

    def lens_columns(self, seen: Seen, names: Sequence[Sequence[str]]) -> Array:
        """Derivatives (S, N, 2, K) by parameters of each lens (K: of all lenses in turn)."""
        ends = np.cumsum([0, *map(len, names)])
        columns = np.zeros((*seen.uv.shape, ends[-1]))
        for part in seen.parts:
            i = part.camera if len(self.models) > 1 else 0
            block = np.zeros((*part.linear.uv.shape, ends[-1]))
            block[..., ends[i] : ends[i + 1]] = lens_columns(
                self.models[i].lens, part.linear.image, list(names[i])
            )
            columns[part.rows] = block
        return columns

    def _split(self, views: Views) -> Iterator[tuple[Index, int, ForwardModel]]:
        if len(self.models) == 1:
            yield np.arange(len(views.frame)), 0, self.models[0]
            return
        for camera in np.unique(views.camera).tolist():
            yield np.flatnonzero(views.camera == camera), camera, self.models[camera]


def _gathered(parts: Iterable[tuple[Index, Array]]) -> Array:
    """Return the rows of all parts in their order."""
    pairs = list(parts)
    if len(pairs) == 1:
        return pairs[0][1]
    found = np.empty((sum(len(rows) for rows, _ in pairs), *pairs[0][1].shape[1:]),
                     dtype=pairs[0][1].dtype)
    for rows, values in pairs:
        found[rows] = values
    return found
