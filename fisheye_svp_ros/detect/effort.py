"""How thoroughly a photograph is searched, by what those before it have shown.

A chessboard is mostly found at a first look.  All that follows where it is not takes ten times as
long, and is put off until some photograph shows the board; a few are searched thoroughly at once.
Boards whose dark squares are bright are found at a first look at the inverted image.
"""

from __future__ import annotations

from enum import Enum

_FIRST_ONES, _ONE_OF = 3, 24  # photographs that are searched thoroughly in any case


class Look(Enum):
    """What is done with a photograph; SAMPLE: thorough, and whether the board is inverted."""

    FIRST_SEARCH = 'first'
    SAMPLE = 'sample'
    THOROUGH = 'thorough'
    INVERTED_IMAGE = 'inverted'


class Effort:
    """The looks at photographs, one after the other."""

    def __init__(self, has_first_look: bool) -> None:
        """Take whether a detector has a first look; others are always thorough."""
        self._has_first_look = has_first_look
        self._found = self._inverted = 0

    @property
    def has_found_board(self) -> bool:
        """Whether any photograph showed the board."""
        return self._found > 0

    def note(self, found: bool, inverted: bool) -> None:
        """Take note of what a photograph has shown."""
        self._found += found
        self._inverted += inverted

    def look(self, number: int, repeatable: bool) -> Look:
        """Return how to look at a photograph; repeatable: it can be read once more."""
        if not self._has_first_look:
            return Look.THOROUGH
        if self.has_found_board:
            return Look.INVERTED_IMAGE if self._inverted == self._found else Look.THOROUGH
        sample = number < _FIRST_ONES or number % _ONE_OF == 0 or not repeatable
        return Look.SAMPLE if sample else Look.FIRST_SEARCH
