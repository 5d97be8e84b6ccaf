"""What can be wrong with data, whatever lens and target are."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class FlawKind(Enum):
    """What is wrong with the data; of the first ones nothing is told of lens or target."""

    CAMERAS_MIXED = 1
    FOCAL_VARIES = 2
    CENTER_VARIES = 3
    FRAMES_DIFFER = 4
    NO_FIT = 5
    LENS_UNKNOWN = 6
    ANGLE_SHORT = 7
    OFF_CENTER = 8

    @property
    def is_misfit(self) -> bool:
        """Whether residuals are left that no camera explains."""
        return self.value <= FlawKind.NO_FIT.value


@dataclass(frozen=True)
class Flaw:
    """One thing that is wrong with the data.

    size, beside: of mixed cameras and other misfits, px rms that is left and noise; of a focal
    length, its relative range, of a center, its rms, px, and how many times noise that is; of rays
    the error, rad, and that of one image point; of an angle, rad, those that points and the lens
    reach; of a center, px off in u and v.
    groups: frames by number, those of each camera or state, or those that differ most; names: the
    photographs of these, as far as they are known.
    """

    kind: FlawKind
    size: float
    beside: float
    groups: tuple[tuple[int, ...], ...] = ()
    names: tuple[tuple[str, ...], ...] = ()
    camera: str = ''
