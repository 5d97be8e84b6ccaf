"""What came of an effect that was tried, and why: a round of the selection, or the last word.

One probability and one status: of confirmed causes, of what is not confirmed, everywhere alike.
Flaws: what can be wrong with data, whatever lens and target are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from math import e, exp, log
from typing import Any, NamedTuple, Protocol

from fisheye_svp_ros.effects.base import ModelTerm
from fisheye_svp_ros.solve.mirrored_points import Mirror

CONFIRMED_PROBABILITY = 0.95
LIKELY_PROBABILITY = 0.5
_MAX_SQUARE = 200.0  # of z: beyond it, the probability is 0
MAX_SHIFT = 0.025  # m: no lens of a machine is known to move its viewpoint by more


class Status(Enum):
    """What a finding says of an effect."""

    CONFIRMED = 'confirmed'
    LIKELY = 'likely'
    REFUTED = 'refuted'
    NOT_NEEDED = 'not needed'


class Reason(Enum):
    """Why an effect has its status."""

    PREDICTS_BETTER = 1
    BEYOND_BULK = 2  # landmarks: further off than most
    NO_CONVINCING_GAIN = 3  # significant, and no gain beyond its error when it was tried
    EXPLAINED_BY_OTHER_CAUSES = 4
    NO_LASTING_GAIN = 5  # taken in for its gain, and none is left beside the other causes
    REFUTED_BY_FRAMES = 6
    REFUTED_BY_FILE = 7
    NO_GAIN = 8
    NO_OTHER_FRAME = 9
    NEEDLESS_BESIDE_RIVAL = 10  # not significant with another effect in place of a cause
    NO_GAIN_BESIDE_RIVAL = 11
    IMPLAUSIBLE = 12  # larger than in any real lens

    @property
    def refutes(self) -> bool:
        """Whether held-out data, or its size, are evidence against an effect."""
        return self in (Reason.REFUTED_BY_FRAMES, Reason.REFUTED_BY_FILE, Reason.IMPLAUSIBLE)

    @property
    def is_removal(self) -> bool:
        """Whether an effect was given up in the selection that had been taken in."""
        return self in (Reason.EXPLAINED_BY_OTHER_CAUSES, Reason.NO_LASTING_GAIN)


def probability_of(p_corrected: float) -> float:
    """Return the largest probability of an effect that a corrected p-value allows.

    The odds before the data are even: that many effects were tried is in the correction.
    Source: Sellke, Bayarri and Berger, Calibration of p values for testing precise null
    hypotheses, The American Statistician 55 (2001).
    """
    if p_corrected <= 0:
        return 1.0
    p = min(p_corrected, 1 / e)
    return 1 / (1 - e * p * log(p))


def status_of(probability: float, predicts_better: bool) -> Status:
    """Return what is to be thought of an effect that nothing refutes.

    predicts_better: whether frames that were left out are predicted better with it.
    """
    if predicts_better and probability >= CONFIRMED_PROBABILITY:
        return Status.CONFIRMED
    return Status.LIKELY if probability > LIKELY_PROBABILITY else Status.NOT_NEEDED


class Rival(NamedTuple):
    """An effect that makes another one needless where it stands in the place of a cause."""

    effect: str
    replaced: str


@dataclass(frozen=True)
class Finding:
    """One effect that was tried, its evidence, and what came of it.

    form: `Effect.key`; p_corrected: p_value times the numbers of effects and of this one's forms;
    held_out, held_out_stderr: what it adds to the log predictive density of frames left out, NaN
    where that was not asked; z: by how many of its errors over the frames the held-out sum of
    squares falls with it; parameters: value, stderr, unit by name, as far as it was fitted;
    posterior: how probable it is by all likely models, None where these do not ask for it.
    """

    form: str
    reason: Reason
    p_value: float
    p_corrected: float
    statistic: float = 0.0
    rank: int = 0
    held_out: float = float('nan')
    held_out_stderr: float = float('nan')
    parameters: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    rival: Rival | None = None
    z: float = 0.0
    posterior: float | None = None

    @property
    def effect(self) -> str:
        """The name of the effect, without that of its form."""
        return self.form.partition('(')[0]

    @property
    def status(self) -> Status:
        """What is to be thought of the effect."""
        if self.reason.refutes:
            return Status.REFUTED
        return status_of(self.probability, self.is_accepted)

    @property
    def probability(self) -> float:
        """How probable the effect is; where held-out data refute it, by their evidence alone."""
        if self.reason is Reason.IMPLAUSIBLE:
            return 0.0
        if self.reason.refutes:
            return 1 / (1 + exp(min(self.z**2, _MAX_SQUARE) / 2))
        return probability_of(self.p_corrected) if self.posterior is None else self.posterior

    @property
    def is_accepted(self) -> bool:
        """Whether it was taken into the model."""
        return self.reason in (Reason.PREDICTS_BETTER, Reason.BEYOND_BULK)


class Evidence(Protocol):
    """What is known of an effect in the model when it is to be confirmed; the methods take time.

    cause: the effect with its values; frames: how many can be predicted from the others; z: by
    how many of its errors over them the held-out sum of squares falls with the effect.
    """

    @property
    def cause(self) -> ModelTerm: ...

    @property
    def frames(self) -> int: ...

    @property
    def z(self) -> float: ...

    def z_of_file(self) -> float | None:
        """Return z over the frames of a file that was held out; None without one."""

    def adds_density(self) -> bool:
        """Say whether frames left out are likelier with it, by more than the error of that."""

    def find_rival(self) -> tuple[Reason | None, Rival | None]:
        """Return which effect in the place of another cause makes it needless, and how."""


class Doubt(NamedTuple):
    """Why an effect in the model is no confirmed cause; z: of the frames that decide it."""

    cause: ModelTerm
    reason: Reason
    z: float
    rival: Rival | None = None


def find_doubt(evidence: Evidence) -> Doubt | None:
    """Return why an effect is no confirmed cause; None: it is one."""
    cause, z = evidence.cause, evidence.z
    if evidence.frames < 2:
        return Doubt(cause, Reason.NO_OTHER_FRAME, z)
    if z < -1:
        return Doubt(cause, Reason.REFUTED_BY_FRAMES, z)
    if z <= 1 and not (z > 0 and evidence.adds_density()):
        return Doubt(cause, Reason.NO_GAIN, z)
    z_of_file = evidence.z_of_file()
    if z_of_file is not None and z_of_file < 0:
        reason = Reason.REFUTED_BY_FILE if z_of_file < -1 else Reason.NO_GAIN
        return Doubt(cause, reason, z_of_file)
    needless, rival = evidence.find_rival()
    if needless is not None:
        return Doubt(cause, needless, z, rival)
    return Doubt(cause, Reason.IMPLAUSIBLE, z) if is_implausible(cause) else None


def is_implausible(cause: ModelTerm) -> bool:
    """Say whether an effect is larger than in any real lens."""
    return cause.name == 'viewpoint_shift' and bool(abs(cause.values[0]) > MAX_SHIFT)


class FlawKind(Enum):
    """What is wrong with the data; of the first ones nothing is told of lens or target."""

    MIRRORED = 0
    TARGET_TOO_LARGE = 1
    SHIFT_TOO_LARGE = 2
    CAMERAS_MIXED = 3
    FOCAL_VARIES = 4
    CENTER_VARIES = 5
    FRAMES_DIFFER = 6
    NO_FIT = 7
    FEW_FRAMES = 8
    SIDES_DIFFER = 9
    NOISE_TOO_LARGE = 10
    LENS_UNKNOWN = 11
    ANGLE_SHORT = 12
    OFF_CENTER = 13

    @property
    def is_unit(self) -> bool:
        """Whether lengths are in another unit than m."""
        return self in (FlawKind.TARGET_TOO_LARGE, FlawKind.SHIFT_TOO_LARGE)

    @property
    def is_of_table(self) -> bool:
        """Whether the table or the image size is to be corrected, rather than more be taken."""
        return self in (FlawKind.SIDES_DIFFER, FlawKind.NOISE_TOO_LARGE, FlawKind.OFF_CENTER)

    @property
    def is_misfit(self) -> bool:
        """Whether lengths are in another unit, or residuals are left that no camera explains."""
        return self.value <= FlawKind.NO_FIT.value


@dataclass(frozen=True)
class Flaw:
    """One thing that is wrong with the data.

    size, beside: of a length, m, and the largest one that is possible; of mixed cameras and other
    misfits, px rms that is left and noise of a coordinate; of a focal length, its relative range,
    of a center, its rms, px, and the rms angle, rad, that rays of a frame are off for it; of few
    frames, how many there are and are needed; of a flat board that is seen from both sides, how
    many frames see the side that fewer see, and all; of noise, px of a coordinate, and the most
    that is plausible; of rays at 1 m, rad, the bound (97.5 %) and what is good enough; of an
    angle, rad, those that points and the lens reach; of a center, px off in u and v.
    groups: frames by number, those of each camera or state, or those that differ most; names: the
    photographs of these, as far as they are known; mirror: which one, of mirrored points.
    """

    kind: FlawKind
    size: float
    beside: float
    groups: tuple[tuple[int, ...], ...] = ()
    names: tuple[tuple[str, ...], ...] = ()
    camera: str = ''
    mirror: Mirror | None = None
