"""What came of an effect that was tried, and why: a round of the selection, or the last word."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, NamedTuple


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
    EXPLAINED_BY_OTHERS = 4
    NO_LASTING_GAIN = 5  # taken in for its gain, and none is left beside the other causes
    REFUTED_BY_FRAMES = 6
    REFUTED_BY_FILE = 7
    NO_GAIN = 8
    NO_OTHER_FRAME = 9
    NEEDLESS_BESIDE_RIVAL = 10  # not significant with another effect in place of a cause
    NO_GAIN_BESIDE_RIVAL = 11
    IMPLAUSIBLE = 12  # larger than in any real lens

    @property
    def status(self) -> Status:
        """Return what follows from it."""
        return _STATUS.get(self, Status.NOT_NEEDED)

    @property
    def is_removal(self) -> bool:
        """Whether an effect was given up in the selection that had been taken in."""
        return self in (Reason.EXPLAINED_BY_OTHERS, Reason.NO_LASTING_GAIN)


_STATUS = {
    Reason.PREDICTS_BETTER: Status.CONFIRMED,
    Reason.BEYOND_BULK: Status.CONFIRMED,
    Reason.NO_CONVINCING_GAIN: Status.LIKELY,
    Reason.NO_GAIN: Status.LIKELY,
    Reason.NO_OTHER_FRAME: Status.LIKELY,
    Reason.REFUTED_BY_FRAMES: Status.REFUTED,
    Reason.REFUTED_BY_FILE: Status.REFUTED,
    Reason.IMPLAUSIBLE: Status.REFUTED,
}


class Rival(NamedTuple):
    """An effect that makes another one needless where it stands in the place of a cause."""

    effect: str
    replaced: str


@dataclass(frozen=True)
class Finding:
    """One effect that was tried, its evidence, and what came of it.

    form: `Effect.key`; p_corrected: p_value times the numbers of effects and of this one's forms;
    held_out, held_out_stderr: what it adds to the log predictive density of frames left out, NaN
    where that was not asked; parameters: value, stderr, unit by name, as far as it was fitted.
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

    @property
    def effect(self) -> str:
        """The name of the effect, without that of its form."""
        return self.form.partition('(')[0]

    @property
    def status(self) -> Status:
        """What is to be thought of the effect."""
        return self.reason.status

    @property
    def accepted(self) -> bool:
        """Whether it was taken into the model."""
        return self.status is Status.CONFIRMED

    @property
    def is_removal(self) -> bool:
        """Whether it was given up in the selection after it had been taken in."""
        return self.reason.is_removal
