"""What is wrong with the inputs of a node, one slot for each topic and reason."""

from __future__ import annotations

import re
import time
from collections import OrderedDict
from collections.abc import Callable

# What one reason is told with, and another time otherwise: names, numbers, lists of them.
_DETAIL = re.compile(r"'[^']*'|[-+]?\d[\d.]*(e[-+]?\d+)?")
_KEY_LENGTH = 60  # characters: more is a list
_MAX_SLOTS = 20  # in one report
_MAX_LOGGED = 200  # slots of which it is known when they were logged


class Complaints:
    """Texts since the last report: no reason hides another, and each is logged now and then.

    log: writes a line.
    """

    def __init__(self, log: Callable[[str], object]) -> None:
        self._log = log
        self._texts: dict[str, str] = {}
        self._logged: OrderedDict[str, float] = OrderedDict()  # s, by slot

    def add(self, text: str, period: float, prefix: str = '') -> None:
        """Take a text up; log it with a prefix, once in `period` seconds.

        The text begins with its topic, the rest is the reason.
        """
        slot = _DETAIL.sub('#', text)[:_KEY_LENGTH]
        if slot in self._texts or len(self._texts) < _MAX_SLOTS:
            self._texts[slot] = text
        now = time.monotonic()
        if now - self._logged.get(slot, -period) < period:
            return
        self._logged[slot] = now
        self._logged.move_to_end(slot)
        if len(self._logged) > _MAX_LOGGED:
            self._logged.popitem(last=False)
        self._log(f'{prefix}{text}')

    def collect(self) -> list[str]:
        """Return the texts since the last time, in the order in which their slots began."""
        texts, self._texts = [*self._texts.values()], {}
        return texts
