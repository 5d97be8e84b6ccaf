"""What the user knows of the causes before a diagnosis."""

from __future__ import annotations

from dataclasses import dataclass

from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.effects.landmark_survey import LandmarkSurveyEffect
from fisheye_svp_ros.errors import ParameterError


def can_be_taken_in(name: str) -> bool:
    """Whether an effect can be fitted without a test: not those of noise, or single landmarks."""
    return CATALOGUE[name].stage != 'noise' and name != LandmarkSurveyEffect.name


@dataclass(frozen=True)
class Wanted:
    """Causes to take in without a test, effects to leave out, whether time matters most.

    Raises ParameterError for a name that is in no catalogue, or that cannot be taken in.
    """

    included: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    quick: bool = False

    def __post_init__(self) -> None:
        for name in (*self.included, *self.left_out):
            if name not in CATALOGUE:
                known = ', '.join(CATALOGUE)
                raise ParameterError(f'effect {name!r} is unknown; known are {known}')
        for name in self.included:
            if not can_be_taken_in(name):
                raise ParameterError(f'effect {name} cannot be taken in without a test; leave it '
                                     'to the diagnosis')
