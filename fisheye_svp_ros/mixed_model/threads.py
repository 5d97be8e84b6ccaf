"""Work on all cores: NumPy and SciPy's sparse products let go of the interpreter."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

_WORTH_THREADS = 5e7  # products of numbers: fewer take less time than threads to start
_T = TypeVar('_T')
_R = TypeVar('_R')


def map_in_threads(function: Callable[[_T], _R], items: Iterable[_T], products: float) -> list[_R]:
    """Return what a function makes of items, on all cores where that is worth it.

    products: of numbers, in all.
    """
    if products < _WORTH_THREADS:
        return list(map(function, items))
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(function, items))


def run_in_threads(*parts: Callable[[], Any], products: float = float('inf')) -> list[Any]:
    """Return what parts return that do not need each other; products: of numbers, in all."""
    return map_in_threads(lambda part: part(), parts, products)
