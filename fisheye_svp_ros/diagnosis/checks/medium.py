"""Another medium: a camera that was calibrated in air looks through a flat port into water.

It changes the image by a third, which no linear test from air would find: its place is fitted
from several starts before the search, the intrinsics held as they were in air, and it is named
where that explains as well what a free lens curve would need a dozen numbers for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis.cross_validation import HeldOut, predict_other_data
from fisheye_svp_ros.diagnosis.model_errors import LensErrors, calibrated_covariance
from fisheye_svp_ros.diagnosis.null_model import NullModel
from fisheye_svp_ros.diagnosis.problem import Problem, Progress
from fisheye_svp_ros.diagnosis.uncertainty import standard_errors
from fisheye_svp_ros.diagnosis.variance_budget import Component
from fisheye_svp_ros.effects.ray_effects import FlatPortEffect
from fisheye_svp_ros.effects.recording_effects import SessionStepEffect
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.optics.lens import (
    INTRINSICS,
    Lens,
    field_of_view,
    intrinsic_names,
    parameter_values,
)
from fisheye_svp_ros.optics.ports import MEDIA
from fisheye_svp_ros.solve.bundle_adjustment import Prior, adjust
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.outliers import Outliers, find_outliers, without_points
from fisheye_svp_ros.solve.port_fit import (
    CURVE_TERMS,
    LOST_PX,
    MEDIUM_INDEX,
    PORT_PLACE,
    THICKNESS,
    fit_free_curve,
    fit_port,
    is_glass,
    start_port,
)
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, RigViews, is_shared

_SUSPICIOUS_PX = 1.0  # px: less than this is no third of the image
_MIN_MAGNIFICATION = 1.1  # than in air: what looks so much larger may be seen through a flat port
_FOLDS = 5
_CURVE_SHARE = 0.5  # of the squares in air, at most, are left by a curve behind a port
_EXPLAINED_SHARE = 0.98  # of what a free lens curve explains
_MAX_COST_RATIO = 1.5  # times as much misfit as a free lens curve leaves; lenses are not rigid
_THICKNESS_SIGMAS = 3.0  # standard errors of its thickness
_KNOWN_SHARE = 0.01  # of an image height, beside what the focal length is off by
_SAMPLES = 200
_REACH_GROWTH = 1.25  # from fit to fit: the field whose points are taken in
_MIN_VIEW_POINTS = 8  # points of a view
_MIN_EIGENVALUE = 1e-8  # eigenvalue of correlations, beside what numbers hold
_MEDIAN_SIZE = 0.6745  # of the size of a normal number
_MAX_SIGMAS = 4.0  # standard deviations, rms, that no intrinsics are off
_INDEX_SIGMA = 0.1  # standard deviation of an index before anything is known of the medium


@dataclass(frozen=True)
class Medium:
    """A port with another medium behind it, and the simulation in air that it takes the place of.

    state, names: the fit, and what of the port was fitted; outliers: found beside it; air: the
    simulation as it was, fitted to the same data; p_value, share: of the misfit in air; alike:
    whether a free lens curve describes it as well; criterion: by how much less likely than one
    (BIC); moved: whether the intrinsics are no longer as they were in air, within what the
    calibration there left open; focal_error: relative standard error of the focal length in air.
    """

    state: RigState
    names: tuple[str, ...]
    outliers: Outliers
    air: Linearization
    p_value: float
    share: float
    alike: bool
    criterion: float
    moved: bool
    focal_error: float = 0.0

    def without_glass(self, null: NullModel) -> Medium | None:
        """Return the medium with its glass counted as part of the distance.

        null: once all causes are found; None where it still tells of the glass.
        """
        if THICKNESS not in self.names:
            return None
        thickness = null.linear.state.lens.parameters[THICKNESS]
        error = standard_errors(null)[null.linear.free.index(THICKNESS)]
        if is_glass(thickness) and thickness > _THICKNESS_SIGMAS * error:
            return None
        names = tuple(name for name in self.names if name != THICKNESS)
        lens = self.state.lens.with_parameters([THICKNESS], [0.0])
        state = adjust(self.air.data, replace(self.state, lens=lens), names)
        return replace(self, state=state, names=names)

    def cross_validate(self) -> HeldOut:
        """Predict parts of the frames in turn, in air."""
        data, state = self.air.data, self.air.state
        if not self.air.free:
            return predict_other_data(data, state)
        part = np.arange(data.frames) % min(_FOLDS, data.frames)
        squares, counts = np.zeros(data.frames), np.zeros(data.frames)
        for fold in range(int(part.max()) + 1):
            mine = part == fold
            kept = data.select(~mine[data.frame_of])
            trained = adjust(kept, replace(state, pose=state.pose.take(~mine)), self.air.free)
            test = data.select(mine[data.frame_of])
            near = replace(trained, pose=state.pose.take(mine))
            squares[mine], counts[mine] = predict_other_data(test, near)
        return HeldOut(squares, counts)

    def budget(self, parts: Sequence[Component]) -> list[Component]:
        """Return the variance budget of the simulation in air from that behind the port."""
        square = float(np.mean(self.air.residual[self.air.row_mask] ** 2)) * self.share
        square *= float(np.mean(1 / self.air.weight[self.air.weight > 0] ** 2))
        remaining = 1 - self.share
        parts = [
            p._replace(share=remaining * p.share, named_share=remaining * p.named_share)
            for p in parts
        ]
        own = Component(
            'named_lens', 'lens', float(np.sqrt(square)), self.share, self.share, self.p_value
        )
        for part in parts:
            if part.name == own.name:
                own = own._replace(
                    sd_px=float(np.hypot(part.sd_px, own.sd_px)),
                    share=part.share + own.share,
                    named_share=part.named_share + own.share,
                    p_value=0.0,
                )
        return [own, *(part for part in parts if part.name != own.name)]


@dataclass(frozen=True)
class InAir:
    """How sure the intrinsics of a lens are: names, covariance (K, K) of their values."""

    lens: Lens
    names: tuple[str, ...]
    covariance: Array

    @classmethod
    def from_lens(cls, lens: Lens) -> InAir | None:
        """Return what a lens file from `calibrate` or `diagnose` tells; None if it is nothing.

        Raises LensError for half of it, or what cannot be.
        """
        if lens.uncertainty is not None:
            errors = LensErrors.from_lens(lens)
            known, whole = errors.model.names, errors.model.covariance
        elif (stated := calibrated_covariance(lens)) is None:
            return None
        else:
            known, whole = stated
        at = [i for i, name in enumerate(known) if name in ('f', *intrinsic_names(lens))]
        names = tuple(known[i] for i in at)
        return cls(lens, names, whole[np.ix_(at, at)]) if {'f', 'fx'} & set(names) else None

    @property
    def focal(self) -> float:
        """Relative standard error of the focal length."""
        at = next(i for i, name in enumerate(self.names) if name in ('f', 'fx'))
        return float(np.sqrt(self.covariance[at, at])) / self.lens.fx

    @property
    def reach(self) -> float:
        """Distance from the principal point, px, up to which the curve is known."""
        lens = self.lens
        theta = np.linspace(0.0, lens.max_incidence, _SAMPLES)[1:]
        height = lens.image_height.value_and_slope(theta)[0]
        by = {
            'f': height,
            'fx': height,
            **dict(
                zip(
                    lens.image_height.coefficient_names,
                    lens.fx * lens.image_height.columns(theta).T,
                    strict=True,
                )
            ),
        }
        columns = np.stack([by.get(name, np.zeros_like(theta)) for name in self.names], axis=-1)
        spread = np.sqrt(np.einsum('tk,kl,tl->t', columns, self.covariance, columns))
        open_ = spread > (self.focal + _KNOWN_SHARE) * lens.fx * height
        return float(lens.fx * height[np.argmax(open_)]) if open_.any() else np.inf

    def fit_behind_port(
        self, everything: RigViews, lens: Lens, place: tuple[str, ...], index: str
    ) -> Lens | None:
        """Return the lens with the intrinsics that photographs behind its port call for.

        They move within what is known of them, beside the port's `place` and the medium's `index`;
        the field whose points are taken in grows, for beyond it nothing is known of the curve.
        None if they are far from what is known.  Raises GeometryError where a view cannot be
        posed.
        """
        names, reach = (*place, index, *self.names), self.reach
        while near := self.select_points(everything, reach):
            data, _ = find_outliers(near, initial_state(near, lens))
            state = adjust(data, initial_state(data, lens), place)
            state = adjust(data, state, names, self._prior(data, state, index))
            lens = replace(state.lens, max_incidence=field_of_view(state.lens))
            if near.views.used.sum() == everything.views.used.sum():
                break
            reach *= _REACH_GROWTH
        return lens if self.squared_distance(lens) < _MAX_SIGMAS**2 * len(self.names) else None

    def select_points(self, data: RigViews, reach: float) -> RigViews | None:
        """Return the points up to a distance from the principal point, px; None if too few."""
        off = np.linalg.norm(data.views.uv - [self.lens.cx, self.lens.cy], axis=-1)
        inside = data.views.used & (off <= reach)
        whole = (inside | ~data.views.used).all(axis=1, keepdims=True)
        inside &= whole | (inside.sum(axis=1, keepdims=True) >= _MIN_VIEW_POINTS)
        return without_points(data, ~inside) if inside.any() else None

    def squared_distance(self, lens: Lens) -> float:
        """Return how unlikely the intrinsics of a lens are: squares of standard deviations."""
        found, own = (np.array(parameter_values(known, self.names)) for known in (lens, self.lens))
        return float(((self._root @ (found - own)) ** 2).sum())

    @property
    def _root(self) -> Array:
        """What values are off, times this (K, K), is of unit covariance."""
        size = np.sqrt(np.maximum(np.diag(self.covariance), 1e-300))
        values, vectors = np.linalg.eigh(self.covariance / np.outer(size, size))
        return np.asarray((vectors / np.sqrt(np.maximum(values, _MIN_EIGENVALUE))).T / size)

    def _prior(self, data: RigViews, state: RigState, index: str) -> Prior:
        """Return what is known of index and intrinsics, beside rows as noisy as a fit's."""
        linear = Linearization(data, state, ())
        noise = float(np.median(np.abs(linear.residual[linear.row_mask]))) / _MEDIAN_SIZE
        others = sum(len(term.values) for term in state.terms if is_shared(term.effect))
        mean = np.concatenate(
            [
                [state.lens.parameters[index]],
                parameter_values(self.lens, self.names),
                np.zeros(others),
            ]
        )
        root = np.zeros((1 + len(self.names), len(mean)))
        root[0, 0] = 1 / _INDEX_SIGMA
        root[1:, 1 : 1 + len(self.names)] = self._root
        return Prior(mean, noise * root)


def stated_parameters(lenses: Mapping[str, Lens]) -> dict[str, tuple[float, float]]:
    """Return the parameters of lenses as given, each with the error that its file states."""
    stated = {}
    for camera, lens in lenses.items():
        air = InAir.from_lens(lens)
        errors = (
            {}
            if air is None
            else dict(zip(air.names, np.sqrt(np.diag(air.covariance)).tolist(), strict=True))
        )
        for name, value in lens.parameters.items():
            error = errors.get('f' if name in ('fx', 'fy') and 'f' in errors else name, 0.0)
            stated[f'{camera}.{name}' if camera else name] = value, error
    return stated


def find_medium(problem: Problem, progress: Progress) -> Medium | None:
    """Ask whether the camera looks through a flat port into another medium than air."""
    table, data, base, free = problem.table, problem.data, problem.base, problem.free
    lens = next(iter(problem.inputs.lenses.values()))
    if (
        lens.port is not None
        or data.cameras > 1
        or (FlatPortEffect.name in problem.options.left_out)
    ):
        return None
    air = problem.linear
    if not (_is_magnified(air, lens, air) if free else air.rms_px > _SUSPICIOUS_PX):
        return None
    progress('testing for another medium in front of the camera', 0.02)
    curve = Linearization(data, fit_free_curve(data, base), ())
    if not (_is_magnified(air, lens, curve) or _leaves_room_for_port(air, curve)):
        return None
    known = InAir.from_lens(lens)
    media = [_assess_port(table, lens, start_port(data, lens), free, 0.0)]
    if known is not None:
        progress('computing the uncertainty of the calibration in air', 0.03)
        wet = _correct_lens(table, lens, known)
        distance = 0.0 if wet is None else known.squared_distance(wet)
        media.append(_assess_port(table, lens, wet, free, distance))
    return min(filter(None, media), key=lambda fit: fit.criterion, default=None)


def behind_port(problem: Problem, medium: Medium) -> Problem:
    """Return the problem with the simulation behind its port.

    Index and lens curve look alike: the intrinsics stay as they were in air.  Where they were off,
    a step after the first few frames would stand in for them.
    """
    options, step = problem.options, SessionStepEffect.name
    if step not in options.included and step not in options.left_out:
        options = options.leave_out(step)
    return replace(
        problem,
        data=medium.air.data,
        outliers=medium.outliers,
        base=medium.state,
        start=medium.state,
        free=medium.names,
        options=options,
    )


def _correct_lens(everything: RigViews, lens: Lens, known: InAir) -> Lens | None:
    """Return a lens behind its port, moved within what photographs in air had left open of it."""
    near = known.select_points(everything, known.reach)
    wet = None if near is None else start_port(near, lens)
    if wet is None:
        return None
    try:
        found = known.fit_behind_port(everything, wet, PORT_PLACE, MEDIUM_INDEX)
    except GeometryError:
        return None
    # What index the lens is found beside need not be that of a liquid: it is asked for anew.
    return found and found.with_parameters([MEDIUM_INDEX], [MEDIA['water']])


def _assess_port(
    everything: RigViews, lens: Lens, wet: Lens | None, free: Sequence[str], moved: float
) -> Medium | None:
    """Return the medium if a port explains as well as a free lens curve would.

    wet: the lens with its port about where it is and the intrinsics that it is held to; moved: how
    unlikely these are by the calibration in air, as `InAir.squared_distance` says.
    """
    found = None if wet is None else fit_port(everything, wet)
    if found is None:
        return None
    data, outliers, state, names = found
    base = adjust(data, initial_state(data, lens), free)
    air, curve = Linearization(data, base, free), fit_free_curve(data, base)
    plain = replace(base, lens=replace(state.lens, port=None))
    before, after, least = (
        Linearization(data, fitted, ()).sum_of_squares
        for fitted in (adjust(data, plain, ()), state, curve)
    )
    rows = int(air.row_mask.sum())
    square = min(after, least) / rows
    criteria = (
        after / square + len(names) * np.log(rows) + moved,
        least / square + (len(INTRINSICS) + CURVE_TERMS) * np.log(rows),
    )
    near = before - after > _EXPLAINED_SHARE * (before - least) and after < _MAX_COST_RATIO * least
    if not (criteria[0] < criteria[1] or near):
        return None
    mine = air.sum_of_squares
    p_value = float(special.chdtrc(len(names), max(before - after, 0.0) / square))
    return Medium(
        state,
        names,
        outliers,
        air,
        p_value,
        max(0.0, 1 - after / mine),
        bool(criteria[1] < criteria[0]),
        criteria[0] - criteria[1],
        moved > 0,
        _focal_error(lens),
    )


def _leaves_room_for_port(air: Linearization, curve: Linearization) -> bool:
    """Return whether what a free lens curve explains, or cannot fit, leaves room for a port.

    Where the curve explains little of a misfit in air, that is noise or lies elsewhere.
    """
    rms = curve.rms_px
    explains = curve.sum_of_squares < _CURVE_SHARE * air.sum_of_squares
    return rms > LOST_PX or (rms > _SUSPICIOUS_PX and (explains or bool(air.free)))


def _focal_error(lens: Lens) -> float:
    """Return the relative standard error of a focal length, 0 where a lens says nothing of it."""
    if known := InAir.from_lens(lens):
        return known.focal
    match (lens.calibration or {}).get('stderr'):
        case {'fx': float(error)} | {'f': float(error)} if error > 0:
            return error / lens.fx
    return 0.0


def _is_magnified(air: Linearization, lens: Lens, fitted: Linearization) -> bool:
    """Whether a fitted lens sees things larger than in air, as a port makes them."""
    theta = np.array(0.5 * air.scene.theta_max)
    model = fitted.model.camera(0).lens
    height, known = (
        given.focal * float(given.image_height.value_and_slope(theta)[0])
        for given in (model, lens)
    )
    return height > _MIN_MAGNIFICATION * known
