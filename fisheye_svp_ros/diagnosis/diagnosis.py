"""Diagnosis: show, name, extend, measure, and say what is left (design, section 7)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from fisheye_svp_ros.diagnosis.adjustment import fit, start
from fisheye_svp_ros.diagnosis.advice import Advice, advise
from fisheye_svp_ros.diagnosis.budget import REPEATED, Component, found_components
from fisheye_svp_ros.diagnosis.causes import Cause
from fisheye_svp_ros.diagnosis.choice import TraceStep
from fisheye_svp_ros.diagnosis.in_air import InAir
from fisheye_svp_ros.diagnosis.inputs import (
    ROUNDING,
    check_cameras,
    check_other,
    dithered,
    free_names,
    of_rig,
    rig_lenses,
    right_first,
    thinned,
    without_copies,
)
from fisheye_svp_ros.diagnosis.lens_errors import with_uncertainty
from fisheye_svp_ros.diagnosis.measured import FitQuality, Intrinsic, Measured
from fisheye_svp_ros.diagnosis.medium import find_medium
from fisheye_svp_ros.diagnosis.model import Linearised, State, prepare
from fisheye_svp_ros.diagnosis.moments import (
    each_alone,
    few_shared,
    loose,
    unrelated,
    without_rig,
)
from fisheye_svp_ros.diagnosis.noise import (
    find_gross_errors,
    quantisation_step,
)
from fisheye_svp_ros.diagnosis.prediction import Gain
from fisheye_svp_ros.diagnosis.refit import Local
from fisheye_svp_ros.diagnosis.residuals import rms_px
from fisheye_svp_ros.diagnosis.search import Found, search
from fisheye_svp_ros.diagnosis.structure import Structure, remaining_structure
from fisheye_svp_ros.diagnosis.table import gross_rows, growth_cause, table_causes, with_outliers
from fisheye_svp_ros.diagnosis.two_cameras import TwoCameras, agreed
from fisheye_svp_ros.diagnosis.uncertainty import ModelError
from fisheye_svp_ros.diagnosis.wanted import Wanted
from fisheye_svp_ros.effects.extension import extend_lens
from fisheye_svp_ros.effects.of_cameras import camera_terms
from fisheye_svp_ros.effects.target import LANDMARKS, landmark_rows, on_boards
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Observations, rig_cameras

if TYPE_CHECKING:
    from fisheye_svp_ros.diagnosis.two_sets import TwoSets

# A step this small beside the noise is how numbers are written, not a cause.
_STEP_OVER_NOISE = 0.1


@dataclass
class Diagnosis:
    """The answer; `before` and `after` are the linearised states for whoever draws them.

    errors: of poses and image points by the extended lens; uncertainty: their summary; cameras:
    what each two cameras of a rig say of each other; against: what another data set of the camera
    says.
    """

    verdict: str
    noise_px: float
    frames: int
    observations: int
    base: FitQuality
    components: list[Component]
    causes: list[Cause]
    named: FitQuality
    lens_only: FitQuality
    extended: FitQuality
    gross: list[dict[str, Any]]
    advice: list[Advice]
    remaining: list[Structure]
    untestable: dict[str, str]
    trace: list[TraceStep]
    gain: Gain
    intrinsics: dict[str, Intrinsic]
    lenses: dict[str, Lens]
    local: Local
    errors: ModelError
    uncertainty: dict[str, dict[str, float]]
    cameras: list[TwoCameras]
    before: Linearised
    after: Linearised
    against: TwoSets | None = None

    @property
    def lens(self) -> Lens:
        """The extended lens, of the first camera of a rig."""
        return next(iter(self.lenses.values()))

    @property
    def rig(self) -> tuple[tuple[str, str], Pose] | None:
        """The two cameras of a rig and the first in the second, by the extended lenses."""
        data, place = self.after.data, self.after.state.rig
        names = rig_cameras(data.observations.cameras)
        if names is None or without_rig(data):
            return None
        first, second = (place.take(data.observations.cameras.index(name)) for name in names)
        return names, second.inverse().compose(first)

    @property
    def scatter_px(self) -> float:
        """Standard deviation of noise and what repeats in similar views, of one coordinate, px."""
        found = [part.sd_px for part in self.components if part.name in ('noise', REPEATED)]
        return float(np.hypot.reduce(found))

    def to_dict(self) -> dict[str, Any]:
        """Return what diagnosis.json holds (design, section 7)."""

        def plain(fit: FitQuality) -> dict[str, Any]:
            return {name: value for name, value in asdict(fit).items() if value is not None}

        external: dict[str, Any] = {}
        if self.cameras:
            external['cameras'] = [pair.to_dict() for pair in self.cameras]
        if self.against is not None:
            external['sets'] = self.against.to_dict()
        return {
            'verdict': self.verdict,
            'noise_px': self.noise_px,
            'frames': self.frames,
            'observations': self.observations,
            'base': plain(self.base),
            'components': [part._asdict() for part in self.components],
            'causes': [asdict(cause) for cause in self.causes],
            'named': plain(self.named),
            'lens': plain(self.lens_only),
            'extended': plain(self.extended),
            'gross': self.gross,
            'advice': [asdict(advice) for advice in self.advice],
            'remaining': {'structure': [s._asdict() for s in self.remaining]},
            'untestable': [{'effect': e, 'why': why} for e, why in self.untestable.items()],
            'gain': self.gain._asdict(),
            'intrinsics': {name: asdict(value) for name, value in self.intrinsics.items()},
            'uncertainty': self.uncertainty,
            'trace': [asdict(step) for step in self.trace],
            **({'external': external} if external else {}),
        }


def diagnose(
    observations: Observations, lens: Lens | Mapping[str, Lens], *,
    free_intrinsics: bool | None = None,
    poses: dict[int, Pose] | None = None, held_out: Observations | None = None,
    wanted: Wanted | None = None, progress: Callable[[str, float], None] = lambda *_: None,
) -> Diagnosis:
    """Find what a lens's simulation gets wrong about observations.

    lens: of every camera, or the lenses of a rig by camera.
    free_intrinsics: whether they were (or are to be) fitted; None asks the lens's `calibration`.
    poses: true poses by frame, of a rig's right camera; held_out: other frames of the same camera
    and target; wanted: causes to take in or leave out; progress: told what is being done, and
    which share is done.
    Raises GeometryError or ObservationError where the data cannot be solved at all.
    """
    observations, _ = without_copies(observations)
    observations.landmarks()  # each is in one place
    if poses is not None:
        observations = right_first(observations)
    check_cameras(observations)
    lenses = rig_lenses(observations, lens)
    free = free_names(lenses, free_intrinsics)
    first, *others = lenses.values()
    observations = on_boards(observations, first.target.get(LANDMARKS))
    if held_out is not None:
        held_out = of_rig(held_out, observations.cameras)
        held_out = on_boards(held_out, landmark_rows(observations))
        check_other(observations, held_out)
    wanted = wanted or Wanted()
    if wanted.quick:
        observations = thinned(observations)
    progress('fitting the simulation as it is', 0.0)
    everything = prepare(observations, poses)
    simulated = start(everything, first, others)
    if unrelated(everything, simulated):
        everything = each_alone(everything)
        simulated = start(everything, first, others)
    data, gross = find_gross_errors(everything, simulated)
    base = fit(data, start(data, first, others), free)
    if few_shared(data) or loose(data, (first, *others), base, free):
        data = each_alone(data)
        base = fit(data, start(data, first, others), free)
    step = quantisation_step(observations.uv)
    rounded = step / np.sqrt(6) > _STEP_OVER_NOISE * rms_px(Linearised(data, base, free))
    if rounded:
        # Values on a lattice repeat with the pixel by themselves.
        wanted = replace(wanted, left_out=(*wanted.left_out, 'detector_bias'))
    medium = None
    if 'flat_port' not in wanted.left_out:
        medium = find_medium(everything, data, first, base, free, progress)
    if medium is not None:
        # Index and lens curve look alike: the intrinsics stay as they were in air.  Where they
        # were off, a step after the first few frames would stand in for them.
        if 'session_step' not in wanted.included:
            wanted = replace(wanted, left_out=(*wanted.left_out, 'session_step'))
        data, gross, base, free = medium.air.data, medium.gross, medium.state, medium.names
    found = search(data, base, free, wanted, gross, progress)
    if medium is not None and (thinner := medium.glassless(found.evidence)) is not None:
        # What stood in for a cause was no glass.
        medium, base, free = thinner, thinner.state, thinner.names
        found = search(data, base, free, wanted, gross, progress)
    found, cameras = agreed(found, free, wanted, lambda less: search(
        data, base, free, less, gross, lambda stage, _: progress(stage, 0.79)), progress)
    noise_causes = growth_cause(found.growth)
    noise_causes += table_causes(observations, found.gross, step if rounded else 0.0)
    progress('measuring the gain on held-out data', 0.8)
    judged = _judged(
        observations, lenses, found,
        Measured(found, free, held_out, wanted.quick, _stated(simulated), medium),
        noise_causes, cameras, held_out,
    )
    if judged.noise_px > ROUNDING:
        return judged
    return diagnose(dithered(observations), lens, free_intrinsics=free_intrinsics, poses=poses,
                    held_out=held_out, wanted=wanted, progress=progress)


def _judged(
    observations: Observations, lenses: Mapping[str, Lens], found: Found, measured: Measured,
    noise_causes: list[Cause], cameras: list[TwoCameras], held_out: Observations | None,
) -> Diagnosis:
    evidence, errors = found.evidence, ModelError.of(found.evidence, found.fitted)
    uncertainty = errors.summary(evidence.linear)
    components = measured.components({c.effect: c.p_value for c in noise_causes})
    causes = measured.causes(components) + noise_causes
    # The weights are relative where the noise itself is a cause: sigma is no longer tested.
    stated = bool(np.isfinite(observations.sigma).all()) and not noise_causes
    remaining = remaining_structure(
        evidence, found.fitted, found_components(components), stated
    )
    remaining = with_outliers(remaining, found.gross, len(observations))
    if 'quantisation' in {cause.effect for cause in noise_causes}:
        # Values on a lattice depend on the place within a pixel by themselves.
        remaining = [one for one in remaining if one.variable != 'pixel_phase']
    gross = gross_rows(observations, found.gross)
    if held_out is not None:
        gross += gross_rows(held_out, measured.test_gross, 'held out: ')
    return Diagnosis(
        verdict=_verdict(causes, remaining),
        noise_px=measured.noise,
        frames=evidence.linear.data.frames,
        observations=len(observations),
        base=measured.base,
        components=components,
        causes=causes,
        named=measured.named,
        lens_only=measured.lens_only,
        extended=measured.extended,
        gross=gross,
        advice=advise(found, causes, measured, found_components(components)),
        remaining=remaining,
        untestable=found.base.untestable,
        trace=found.trace,
        gain=measured.gain,
        intrinsics=measured.intrinsics,
        lenses=with_uncertainty(
            errors, evidence.linear, measured.noise, uncertainty['image_px']['misfit'],
            lambda state: extended_lenses(lenses, state, observations)),
        local=measured.local,
        errors=errors,
        uncertainty=uncertainty,
        cameras=cameras,
        before=measured.before,
        after=evidence.linear,
    )


def _stated(given: State) -> dict[str, tuple[float, float]]:
    """Return the parameters of lenses as given, each with the error that its file states."""
    found = {}
    for label, lens in zip(given.labels, given.lenses, strict=True):
        said = InAir.of(lens)
        known = {} if said is None else dict(
            zip(said.names, np.sqrt(np.diag(said.covariance)).tolist(), strict=True))
        for name, value in lens.parameters.items():
            error = known.get('f' if name in ('fx', 'fy') and 'f' in known else name, 0.0)
            found[f'{label}.{name}' if label else name] = value, error
    return found


def _verdict(causes: Sequence[Cause], remaining: Sequence[Structure]) -> str:
    if causes:
        return 'partly_explained' if remaining else 'explained'
    return 'unexplained' if remaining else 'adequate'


def extended_lenses(
    lenses: Mapping[str, Lens], state: State, observations: Observations
) -> dict[str, Lens]:
    """Return the lenses that were fitted, with their effects, for every command and node."""
    # What happened to one recording is no part of the lens.
    lasting = [term for term in state.terms if not term[0].of_recording]
    found = {}
    for camera, (name, fitted) in enumerate(zip(lenses, state.lenses, strict=True)):
        # A fitted height curve may turn a little earlier than the one the lens came with.
        limit = min(lenses[name].max_incidence, fitted.image_height.limit * (1 - 1e-6))
        own = replace(fitted, calibration=lenses[name].calibration, max_incidence=limit)
        found[name] = extend_lens(own, camera_terms(lasting, camera), observations)
    return found
