"""What to do about lens, target and photographs, each judged by itself, and how sure that is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from math import erf
from typing import Any, Literal, NamedTuple

LensAnswer = Literal['keep', 'use_extended', 'recalibrate', 'undecided']
TargetAnswer = Literal['keep', 'correct', 'measure_again']
PhotographsAnswer = Literal['enough', 'more', 'retake']

_INTRINSIC = ('focal_length', 'principal_point', 'aspect')
_OFF_P = 0.04  # of the offset by chance: below, the lens is another one
_OFF_PX = 0.2  # of the noise: a difference that matters
_HINT = 2.4  # standard errors: an effect that is not named, and yet likely there
_MIN_FRAMES = 8  # frames
_ONE_FRAME = 'one frame does not tell errors of the lens from those of the target'
_MAX_REJECTED_SHARE = 0.1  # of the frames
_TARGET_RATIO = 1.5  # times noise and scatter: a held-out error that needs a reason


class Figure(NamedTuple):
    """The number behind a decision."""

    name: str
    value: float
    unit: str


@dataclass(frozen=True)
class EffectBound:
    """The largest size of an effect that these data do not exclude (95 %).

    z: the estimate over its standard error; edge_px, edge_mrad: what that size costs at the edge
    of what was photographed, poses fitted anew.
    """

    effect: str
    value: float
    unit: str
    z: float
    edge_px: float
    edge_mrad: float


@dataclass(frozen=True)
class Decision:
    """One answer: what to do, why, the figure behind it; confidence: 0 to 1, if measured."""

    say: LensAnswer | TargetAnswer | PhotographsAnswer
    why: str
    figure: Figure
    confidence: float | None
    bound: list[EffectBound] = field(default_factory=list)

    def to_dict(self) -> dict[str, Any]:
        """Return what diagnosis.json holds."""
        found = asdict(self) | {'figure': self.figure._asdict()}
        if not self.bound:
            del found['bound']
        return found


class LensOffset(NamedTuple):
    """How far the lens as given is off what the data say.

    mrad: rms of the rays at 1 m, of the fit with causes or of that without, whichever is nearer;
    ratio: of the distance over what the stated errors and those of the fit let expect, by their
    covariance; p_value: of so much by chance; px: mrad in the image; stated: whether the lens
    file states errors; camera: whose lens, of several.
    """

    mrad: float
    ratio: float
    p_value: float
    px: float
    stated: bool = True
    camera: str = ''

    def matters(self, noise_px: float) -> bool:
        """Say whether the lens is another one; of a lens without errors only what costs counts."""
        least = _OFF_PX if self.stated else 1.0
        return self.p_value < _OFF_P and self.px > least * noise_px


def least_likely_offset(offsets: Sequence[LensOffset]) -> LensOffset | None:
    """Return the offset that chance makes least, of the lenses of all cameras.

    The smallest of n p-values comes by chance n times as often (Bonferroni).
    """
    if not offsets:
        return None
    least = min(offsets, key=lambda one: (one.p_value, -one.ratio))
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
    has_likely_shift: whether the extended lens has a viewpoint shift that is likely and not named;
    named_gain: value, low of what all causes gain held out; offset: None where intrinsics were
    not fitted; falling: whether no error rises with the causes on the fitted frames; frames: how
    many.
    """

    lens_causes: Sequence[str]
    causes: Sequence[str]
    has_likely_shift: bool
    named_gain: tuple[float, float]
    file: FileFigure
    offset: LensOffset | None
    bounds: list[EffectBound]
    noise_px: float
    falling: bool
    frames: int

    @property
    def wrong_intrinsics(self) -> list[str]:
        """Intrinsics that only a change of the lens explains, confirmed as causes."""
        return [name for name in self.causes if name in _INTRINSIC]


def decide_lens(facts: LensFacts) -> Decision:
    """Return what to do about the lens."""
    file, bounds = facts.file, facts.bounds
    gained = Figure('file_gain', file.gain, '1')
    if not facts.falling:
        return Decision(
            'undecided',
            'the error on the fitted frames rises with the causes in the '
            'model, so nothing is recommended',
            gained,
            0.0,
            bounds,
        )
    if (off := facts.offset) is not None and off.matters(facts.noise_px):
        return Decision(
            'recalibrate',
            f'the lens{off.camera and f" of {off.camera}"} as given is off by at '
            f'least {off.mrad:.2g} mrad ({off.px:.2g} px) at 1 m, '
            f'{off.ratio:.1f} times the combined standard error',
            Figure('ray_error', off.mrad, 'mrad'),
            1 - off.p_value,
        )
    if facts.frames < 2 and not facts.causes:
        return Decision(
            'undecided', f'{_ONE_FRAME}; take {_MIN_FRAMES} frames or more', gained, None
        )
    if facts.wrong_intrinsics:
        return Decision(
            'recalibrate',
            f'the lens as given is wrong in {", ".join(facts.wrong_intrinsics)}',
            gained,
            file.sure,
        )
    borne_out = facts.named_gain[0] > 0 if facts.causes else facts.has_likely_shift
    if borne_out and file.low > 0:
        return Decision(
            'use_extended',
            'on the same corrected target it takes the held-out error from '
            f'{file.given_px:.3g} to {file.extended_px:.3g} px',
            gained,
            file.sure,
        )
    return _doubt(facts, gained) or Decision('keep', _keep_text(bounds, off), gained, 0.95, bounds)


def _doubt(facts: LensFacts, gained: Figure) -> Decision | None:
    """Return why nothing can be said of the lens; None where it can."""
    file, bounds = facts.file, facts.bounds
    hints = sorted(
        (one for one in bounds if one.z > _HINT and one.edge_px > facts.noise_px),
        key=lambda one: -one.edge_px,
    )
    if facts.causes and file.high < 0 < facts.named_gain[1]:
        why, sure = (
            (
                f'held-out error {file.extended_px:.3g} px with the extended lens alone, '
                f'{file.given_px:.3g} px with the lens as given; only all causes together '
                'reduce it'
            ),
            1 - file.sure,
        )
    elif facts.lens_causes:
        why, sure = (
            (
                f'it is not certain that {", ".join(facts.lens_causes)} in the lens reduces '
                f'the held-out error ({file.given_px:.3g} → {file.extended_px:.3g} px): its '
                f'probability is {100 * file.sure:.0f} %'
            ),
            file.sure,
        )
    elif hints:
        why, sure = (
            (
                f'likely but not confirmed: {" or ".join(one.effect for one in hints)}, '
                f'which may cause up to {hints[0].edge_px:.2g} px at the edge'
            ),
            erf(hints[0].z / 2**0.5),
        )
    else:
        return None
    return Decision('undecided', why, gained, sure, bounds)


def _keep_text(bounds: Sequence[EffectBound], off: LensOffset | None) -> str:
    worst = max(bounds, key=lambda one: one.edge_px, default=None)
    cost = (
        ''
        if worst is None
        else (
            f'; effects that these data do not exclude cause at most {worst.edge_px:.2g} px '
            f'({worst.edge_mrad:.2g} mrad) at the edge'
        )
    )
    fit = '' if off is None else ' and its parameters agree with these data within their errors'
    return f'no cause in the lens is confirmed{fit}{cost}'


class TargetFacts(NamedTuple):
    """What the target is judged by.

    causes: confirmed ones of the target; size: of the largest, in words; gain, low: what they take
    away of the held-out error above noise, and the low end of that; named_px, local_px, noise_px:
    standard deviations of a coordinate by causes, by offsets without a name, and of noise;
    local_m: rms of those offsets; local_p: p-value of the least sure of their components;
    contradicted: whether the cameras of a rig contradict each other about the target; frames: how
    many.
    """

    causes: Sequence[str]
    size: str
    gain: tuple[float, float, float]
    named_px: float
    local_px: float
    local_m: float
    local_p: float
    noise_px: float
    contradicted: bool
    frames: int


def decide_target(facts: TargetFacts) -> Decision:
    """Return what to do about the target."""
    gain, low, sure = facts.gain
    local = (
        f'landmarks are displaced by {1e3 * facts.local_m:.2g} mm rms, which causes '
        f'{facts.local_px:.2g} px'
        if facts.local_m
        else f'local offsets cause {facts.local_px:.2g} px'
    )
    if facts.contradicted:
        return Decision(
            'measure_again',
            'the cameras contradict each other about its shape',
            Figure('local_offsets', facts.local_px, 'px'),
            None,
        )
    if facts.causes:
        figure = Figure('gain', gain, '1')
        if low > 0 and facts.local_px <= facts.named_px:
            return Decision(
                'correct',
                f'{facts.size}; the correction removes {100 * gain:.0f} % '
                'of the squared held-out error',
                figure,
                sure,
            )
        if not facts.local_px:
            return Decision(
                'measure_again',
                f'{facts.size}; the correction does not lower the held-out error significantly',
                figure,
                None,
            )
        return Decision('measure_again', f'{facts.size}; in addition, {local}', figure, sure)
    figure = Figure('local_offsets', facts.local_px, 'px')
    if facts.frames < 2:
        return Decision('keep', f'its errors are unknown: {_ONE_FRAME}', figure, None)
    if facts.local_px > facts.noise_px:
        return Decision(
            'measure_again',
            f'{local}, more than the noise of {facts.noise_px:.2g} px',
            figure,
            1 - facts.local_p,
        )
    if facts.local_px > 0:
        return Decision('keep', f'{local}, less than the noise', figure, 1 - facts.local_p)
    return Decision('keep', 'its errors are below the noise', figure, 0.95)


class PhotographsFacts(NamedTuple):
    """What the photographs are judged by.

    frames: how many there are; bad: names of those that are wrong as a whole; unlike: that the
    others do not predict; heldout_px: by all causes; scatter_px: what noise leaves of it; lens:
    the answer about the lens; is_target_off: whether errors of the target remain in what is held
    out; plannable: whether `--next` can tell which photographs to take; unit: what is counted.
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


def decide_photographs(facts: PhotographsFacts) -> Decision:
    """Return what to do about the photographs."""
    times = facts.heldout_px / max(facts.scatter_px, 1e-9)
    figure = Figure('held_out_over_noise', times, '1')
    if facts.bad and len(facts.bad) >= _MAX_REJECTED_SHARE * facts.frames:
        what = (
            'scatter more than the others or are outliers'
            if len(facts.bad) > 1
            else 'scatters more than the others or is an outlier'
        )
        return Decision(
            'retake', f'{len(facts.bad)} of {facts.frames} {what} as a whole', figure, None
        )
    if facts.frames < _MIN_FRAMES:
        few = f'one {facts.unit} is' if facts.frames == 1 else f'{facts.frames} {facts.unit}s are'
        return Decision('more', f'{few} too few; take {_MIN_FRAMES} or more', figure, None)
    if facts.lens == 'undecided':
        how = '--next 6 lists the views that decide it'
        if not facts.plannable:
            how = 'cover the image to its edge, at different distances'
        return Decision('more', f'the lens is undecided; {how}', figure, None)
    if len(facts.unlike) >= _MAX_REJECTED_SHARE * facts.frames:
        are = 'are' if len(facts.unlike) > 1 else 'is'
        return Decision(
            'more',
            f'{len(facts.unlike)} of {facts.frames} {are} not predicted by the others',
            figure,
            None,
        )
    rest = ''
    if facts.is_target_off and times > _TARGET_RATIO:
        rest = '; the target causes the rest'
    return Decision(
        'enough',
        f'{facts.frames} {facts.unit}s, held-out error {times:.1f} times '
        f'what noise and scatter between frames leave{rest}',
        figure,
        None,
    )
