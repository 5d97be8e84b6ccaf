"""What to do about lens, target and photographs, each judged by itself, and how sure that is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from types import MappingProxyType
from typing import Literal, NamedTuple

from fisheye_svp_ros.diagnosis.findings import LIKELY_PROBABILITY, Flaw
from fisheye_svp_ros.solve.ray_errors import MAX_RAY_ERROR

LensAnswer = Literal['keep', 'use_extended', 'recalibrate', 'undecided']
TargetAnswer = Literal['keep', 'correct', 'measure_again', 'undecided']
PhotographsAnswer = Literal['enough', 'more', 'retake']

_INTRINSIC = ('focal_length', 'principal_point', 'aspect')
_OFF_P = 0.04  # of the offset by chance: below, the lens is another one
_OFF_PX = 0.2  # of the noise: a difference that matters
_MIN_OFFSET = 0.1  # mrad: a tenth of MAX_RAY_ERROR; less is no user's loss, however sure it is
RAY_RATIO = 2.0  # of expected ray errors: a lens so much better is worth the change
_HINT = 2.4  # standard errors: an effect that is not named, and may well be there
MIN_FRAMES = 8  # frames
_MAX_REJECTED_SHARE = 0.1  # of the frames
_TARGET_RATIO = 1.5  # times noise and scatter: a held-out error that needs a reason
_MIN_SURE = 0.8  # that held-out frames agree with rays that are expected to be better


class LensReason(Enum):
    """What a decision about the lens rests on."""

    FITTED_ERROR_RISES = 1
    LENS_IS_OFF = 2
    ONE_FRAME = 3
    INTRINSICS_WRONG = 4
    PREDICTS_BETTER = 5
    GAIN_UNCERTAIN = 6
    EFFECT_POSSIBLE = 7
    NO_CAUSE_CONFIRMED = 8
    RAYS_BETTER = 9


class TargetReason(Enum):
    """What a decision about the target rests on."""

    CAMERAS_CONTRADICT = 1
    CORRECTION_GAINS = 2
    CORRECTION_GAINS_NOTHING = 3
    CAUSE_AND_OFFSETS = 4
    ONE_FRAME = 5
    OFFSETS_COST = 6
    OFFSETS_HARMLESS = 7
    BELOW_NOISE = 8


class PhotographsReason(Enum):
    """What a decision about the photographs rests on."""

    SOME_ARE_WRONG = 1
    TOO_FEW_FRAMES = 2
    LENS_UNDECIDED = 3
    FRAMES_NOT_PREDICTED = 4
    FRAMES_PREDICTED = 5


class Figure(NamedTuple):
    """The number behind a decision."""

    name: str
    value: float
    unit: str


@dataclass(frozen=True)
class EffectBound:
    """The largest size of an effect that these data do not exclude (95 %).

    z: the estimate over its standard error; edge_px, edge_mrad: what that size costs at the edge
    of what was photographed, poses fitted anew; edge: incidence angles there, rad, from and to;
    ranges: those of the points, m, from and to.
    """

    effect: str
    value: float
    unit: str
    z: float
    edge_px: float
    edge_mrad: float
    edge: tuple[float, float] | None = None
    ranges: tuple[float, float] | None = None


@dataclass(frozen=True)
class Decision:
    """One answer: what to do, why, the figure behind it; confidence: 0 to 1, if measured.

    facts: what it was judged by, for the sentence that says why; flaws: what is wrong with the
    data, in place of a reason.
    """

    say: LensAnswer | TargetAnswer | PhotographsAnswer
    reason: LensReason | TargetReason | PhotographsReason
    facts: LensFacts | TargetFacts | PhotographsFacts
    figure: Figure
    confidence: float | None
    bound: list[EffectBound] = field(default_factory=list)
    flaws: tuple[Flaw, ...] = ()


class LensOffset(NamedTuple):
    """How far the lens as given is off what the data say.

    mrad: least rms of the errors of its rays at 1 m (95 % sure); ratio: of the distance over what
    the stated errors and those of the fit let expect, by their covariance; p_value: of so much by
    chance; px: mrad in the image; stated: whether the lens file states errors; camera: whose lens,
    of several; better: how probably a fresh calibration is at least twice as good.
    """

    mrad: float
    ratio: float
    p_value: float
    px: float
    stated: bool = True
    camera: str = ''
    better: float = 1.0

    @property
    def is_chance(self) -> bool:
        """Whether chance alone may set the lens off by so much."""
        return self.p_value >= _OFF_P

    @property
    def is_fresh_better(self) -> bool:
        """Whether a fresh calibration is more likely than not at least twice as good."""
        return self.better > LIKELY_PROBABILITY

    def matters(self, noise_px: float) -> bool:
        """Say whether the lens is another one, and a fresh calibration likely twice as good.

        Of a lens without errors only what costs counts.
        """
        least = _OFF_PX if self.stated else 1.0
        costs = self.px > least * noise_px and self.mrad > _MIN_OFFSET
        return not self.is_chance and costs and self.is_fresh_better


def least_likely_offset(offsets: Sequence[LensOffset]) -> LensOffset | None:
    """Return the offset that chance makes least, of the lenses of all cameras.

    The smallest of n p-values comes by chance n times as often (Bonferroni).
    """
    if not offsets:
        return None
    least = min(offsets, key=lambda offset: (offset.p_value, -offset.ratio))
    return least._replace(p_value=min(1.0, len(offsets) * least.p_value))


class FileFigure(NamedTuple):
    """Held-out rms, px, with the lens as given and the extended lens, the same target in both.

    gain, low, high: of the error above noise, with its 95 % interval; sure: how often it is above
    zero in the bootstrap over frames.
    """

    given_px: float
    extended_px: float
    gain: float
    low: float
    high: float
    sure: float


class LensFacts(NamedTuple):
    """What the lens is judged by.

    lens_causes, causes: confirmed ones of the lens, and all that move predictions;
    named_gain: value, low of what all causes gain held out; offset: None where intrinsics were
    not fitted; falling: whether no error rises with the causes on the fitted frames; frames: how
    many; refuted: effects that held-out data, or their size, refute;
    rays: expected errors, mrad, of the lens as given and the extended one, over all ranges,
    zeros where unknown; written: what the extended lens has without a confirmed cause;
    open: how probable each effect of the lens is that was tried, and is not confirmed.
    """

    lens_causes: Sequence[str]
    causes: Sequence[str]
    named_gain: tuple[float, float]
    file: FileFigure
    offset: LensOffset | None
    bounds: list[EffectBound]
    noise_px: float
    falling: bool
    frames: int
    refuted: Sequence[str] = ()
    rays: tuple[float, float] = (0.0, 0.0)
    written: Sequence[str] = ()
    open: Mapping[str, float] = MappingProxyType({})

    @property
    def is_better_held_out(self) -> bool:
        """Whether the extended lens predicts better, its confirmed causes (if any) likewise."""
        return self.file.low > 0 and not (self.causes and self.named_gain[0] <= 0)

    @property
    def has_better_rays(self) -> bool:
        """Whether the expected error of the rays halves, and held-out frames agree."""
        given, extended = self.rays
        agrees = self.file.gain > 0 and self.file.sure >= _MIN_SURE
        return extended > 0 and given >= RAY_RATIO * extended and agrees

    @property
    def wrong_intrinsics(self) -> list[str]:
        """Intrinsics that only a change of the lens explains, confirmed as causes."""
        return [name for name in self.causes if name in _INTRINSIC]

    @property
    def possible_effects(self) -> list[EffectBound]:
        """Effects that are not named and may well be there, the costliest first."""
        possible = (
            one
            for one in self.bounds
            if (one.z > _HINT or self.is_likely(one.effect))
            and one.edge_mrad > 1e3 * MAX_RAY_ERROR
            and one.effect not in self.refuted
        )
        return sorted(possible, key=lambda bound: -bound.edge_px)

    def is_likely(self, effect: str) -> bool:
        """Whether an effect that is not confirmed is more likely there than not."""
        return self.open.get(effect, 0.0) > LIKELY_PROBABILITY


def decide_lens(facts: LensFacts) -> Decision:
    """Return what to do about the lens."""
    file, off, sure = facts.file, facts.offset, facts.file.sure
    gained = Figure('file_gain', file.gain, '1')

    def decide(
        say: LensAnswer, reason: LensReason, confidence: float | None, bounded: bool = False
    ) -> Decision:
        return Decision(say, reason, facts, gained, confidence, facts.bounds * bounded)

    if not facts.falling:
        return decide('undecided', LensReason.FITTED_ERROR_RISES, 0.0, bounded=True)
    if off is not None and off.matters(facts.noise_px):
        figure = Figure('ray_error', off.mrad, 'mrad')
        return Decision('recalibrate', LensReason.LENS_IS_OFF, facts, figure, off.better)
    if facts.frames < 2 and not facts.causes:
        return decide('undecided', LensReason.ONE_FRAME, None)
    if facts.wrong_intrinsics:
        return decide('recalibrate', LensReason.INTRINSICS_WRONG, sure)
    if facts.is_better_held_out:
        return decide('use_extended', LensReason.PREDICTS_BETTER, sure)
    if facts.has_better_rays:
        return decide('use_extended', LensReason.RAYS_BETTER, None)
    if facts.lens_causes:
        return decide('undecided', LensReason.GAIN_UNCERTAIN, sure, bounded=True)
    if facts.possible_effects:
        probability = facts.open.get(facts.possible_effects[0].effect)
        return decide('undecided', LensReason.EFFECT_POSSIBLE, probability, bounded=True)
    return decide('keep', LensReason.NO_CAUSE_CONFIRMED, 0.95, bounded=True)


class TargetError(NamedTuple):
    """The largest error of the target, by the effect that names it.

    size: m, from peak to valley, of a bent board; the relative error of a scale; how many
    landmarks are displaced; 0 of others.  board: which one is bent, of several; stretched: whether
    a scale differs along and across the board.
    """

    effect: str
    size: float = 0.0
    board: int | None = None
    stretched: bool = False


class TargetFacts(NamedTuple):
    """What the target is judged by.

    largest: of its confirmed causes, None without; gain: what they take away of the held-out error
    above noise, the low end of that, its confidence; local_px: standard deviation of a coordinate
    by offsets without a name, local_m: their rms; local_p: p-value of the least sure of their
    components; pose_error: by how much of its distance a camera is placed wrongly for these
    offsets, rms over the frames, rad; contradicted: whether the cameras of a rig contradict each
    other about the target; frames: how many; bend_m: rms by which a board bends from frame to
    frame, bend_share: of the variance beside noise, 0 where it does not.
    """

    largest: TargetError | None
    gain: tuple[float, float, float]
    local_px: float
    local_m: float
    local_p: float
    pose_error: float
    contradicted: bool
    frames: int
    bend_m: float = 0.0
    bend_share: float = 0.0

    @property
    def is_harmless(self) -> bool:
        """Whether poses on this target lose little by its offsets without a name."""
        return self.pose_error <= MAX_RAY_ERROR


def decide_target(facts: TargetFacts) -> Decision:
    """Return what to do about the target."""
    gain, low, sure = facts.gain
    offsets = Figure('local_offsets', facts.local_px, 'px')

    def decide(
        say: TargetAnswer, reason: TargetReason, confidence: float | None, figure: Figure = offsets
    ) -> Decision:
        return Decision(say, reason, facts, figure, confidence)

    if facts.contradicted:
        return decide('measure_again', TargetReason.CAMERAS_CONTRADICT, None)
    if facts.largest is not None:
        gained = Figure('gain', gain, '1')
        if not facts.is_harmless:
            return decide('measure_again', TargetReason.CAUSE_AND_OFFSETS, sure, gained)
        if low > 0:
            return decide('correct', TargetReason.CORRECTION_GAINS, sure, gained)
        return decide('measure_again', TargetReason.CORRECTION_GAINS_NOTHING, None, gained)
    if facts.frames < 2:
        return decide('keep', TargetReason.ONE_FRAME, None)
    if not facts.is_harmless:
        return decide('measure_again', TargetReason.OFFSETS_COST, 1 - facts.local_p)
    if facts.local_px > 0:
        return decide('keep', TargetReason.OFFSETS_HARMLESS, 1 - facts.local_p)
    return decide('keep', TargetReason.BELOW_NOISE, 0.95)


class PhotographsFacts(NamedTuple):
    """What the photographs are judged by.

    frames: how many there are; bad: names of those that are wrong as a whole; unlike: that the
    others do not predict; heldout_px: by all causes; scatter_px: what noise leaves of it; lens:
    the answer about the lens; is_target_off: whether errors of the target remain in what is held
    out; plannable: whether `--next` can tell which photographs to take; unit: what is counted;
    known: whether the rays of the lens that is to be used are known to MAX_RAY_ERROR.
    """

    frames: int
    bad: Sequence[str]
    unlike: Sequence[str]
    heldout_px: float
    scatter_px: float
    lens: str
    is_target_off: bool = False
    plannable: bool = True
    unit: str = 'frame'
    known: bool = False

    @property
    def ratio(self) -> float:
        """The held-out error over what noise and scatter between frames leave."""
        return self.heldout_px / max(self.scatter_px, 1e-9)

    @property
    def target_causes_rest(self) -> bool:
        """Whether more than noise is held out, for which errors of the target are the reason."""
        return self.is_target_off and self.ratio > _TARGET_RATIO


def decide_photographs(facts: PhotographsFacts) -> Decision:
    """Return what to do about the photographs."""
    figure, many = Figure('held_out_over_noise', facts.ratio, '1'), _MAX_REJECTED_SHARE

    def decide(say: PhotographsAnswer, reason: PhotographsReason) -> Decision:
        return Decision(say, reason, facts, figure, None)

    if facts.bad and len(facts.bad) >= many * facts.frames and not facts.known:
        return decide('retake', PhotographsReason.SOME_ARE_WRONG)
    if facts.frames < MIN_FRAMES:
        return decide('more', PhotographsReason.TOO_FEW_FRAMES)
    if facts.lens == 'undecided':
        return decide('more', PhotographsReason.LENS_UNDECIDED)
    if len(facts.unlike) >= many * facts.frames:
        return decide('more', PhotographsReason.FRAMES_NOT_PREDICTED)
    return decide('enough', PhotographsReason.FRAMES_PREDICTED)
