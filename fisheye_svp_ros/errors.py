"""The errors of this package: one root, one subclass a kind of bad input; texts of one line."""

import re
from collections.abc import Callable
from functools import wraps
from inspect import signature
from typing import ParamSpec, TypeVar

_P = ParamSpec('_P')
_R = TypeVar('_R')
_MAX_LENGTH = 1500  # characters; what is quoted may be a whole file
_CONTROL_CHARACTERS = re.compile(r'\s*[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]+\s*')


def one_line(text: str) -> str:
    """Return a text without control characters, which a name may bring to a terminal or log."""
    return _CONTROL_CHARACTERS.sub(' ', text)


class FisheyeSvpError(Exception):
    """Root of all errors raised on purpose; its text is one line that names the remedy."""

    def __init__(self, text: object = '') -> None:
        text = str(text)
        if len(text) > _MAX_LENGTH:
            text = f'{text[: _MAX_LENGTH // 2]} ... {text[-_MAX_LENGTH // 2 :]}'
        super().__init__(one_line(text))


class LensError(FisheyeSvpError):
    """A lens description is incomplete or impossible."""


class ObservationError(FisheyeSvpError):
    """Observations, poses or landmarks are missing, malformed or contradictory."""


class GeometryError(FisheyeSvpError):
    """Too few or degenerate points, or points outside the domain of the lens."""


class ParameterError(FisheyeSvpError):
    """A parameter or a sweep file holds a value that cannot be used."""


class BagError(FisheyeSvpError):
    """A recording cannot be read or written."""


class OutputError(FisheyeSvpError):
    """A result cannot be written."""


class SweepError(FisheyeSvpError):
    """A sweep cannot go on, for want of somebody who works on it."""


class GraphError(FisheyeSvpError):
    """A graph of nodes cannot be: ROS 2 or a part of it is missing, or a process has failed."""


def only_own_errors(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return the function, from which errors of this package come alone, if the call fits it."""
    takes = signature(function)

    @wraps(function)
    def wrapper(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        takes.bind(*args, **kwargs)
        try:
            return function(*args, **kwargs)
        except (FisheyeSvpError, ImportError, MemoryError):
            raise
        except Exception as cause:
            raise ParameterError(
                f'{function.__name__}: the arguments cannot be used '
                f'({type(cause).__name__}: {cause})'
            ) from cause

    return wrapper
