"""Typed tables of parameters: frozen dataclasses whose fields are the rows; and sweeps of them."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple, TypeVar

from fisheye_svp_ros.errors import ParameterError

SWEEP = 'sweep.'

S = TypeVar('S')


class Row(NamedTuple):
    """One parameter: its default gives the type; low to high is the range, ends included.

    fixed: it holds for the life of a node; file: it may name a file; frame: it is a frame id.
    """

    name: str
    default: Any
    description: str
    unit: str = ''
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    fixed: bool = False
    file: bool = False
    frame: bool = False

    def constraint(self) -> str:
        """Say what values are allowed beyond the type; empty for any."""
        if self.choices:
            return 'one of ' + ', '.join(filter(None, self.choices))
        return '' if self.low is None else f'{self.low:g} to {self.high:g}'

    @property
    def takes_booleans(self) -> bool:
        """Whether a boolean, as YAML reads true and false, stands for one of the words."""
        return 'true' in (*self.choices, self.default)

    def check(self, value: Any) -> Any:
        """Return the value in the type of the default; raise ParameterError if not allowed."""
        if isinstance(self.default, tuple):
            if isinstance(value, str) or not isinstance(value, Sequence):
                raise ParameterError(f'{self.name} is {value!r}; a list is needed')
            return tuple(self._check_one(one, self.default[0]) for one in value)
        return self._check_one(value, self.default)

    def _check_one(self, value: Any, like: Any) -> Any:
        kind = type(like)
        if self.takes_booleans and type(value) is bool:
            value = str(value).lower()
        if kind is float and type(value) is int:
            value = float(value)
        if type(value) is not kind:
            raise ParameterError(f'{self.name} is {value!r}; {kind.__name__} is needed')
        if kind is float and not math.isfinite(value):
            raise ParameterError(f'{self.name} is {value}; a finite number is needed')
        outside = self.low is not None and not self.low <= value <= (self.high or 0)
        if outside or (self.choices and value not in self.choices):
            raise ParameterError(f'{self.name} is {value!r}; allowed is {self.constraint()}')
        if self.frame and re.search(r'^/|\s', value):  # which tf2 refuses, message by message
            raise ParameterError(f'{self.name} is {value!r}; a frame id begins without a slash '
                                 'and holds no blanks')
        return value


def parameter(
    default: Any,
    description: str,
    unit: str = '',
    span: tuple[float, float] | None = None,
    choices: tuple[str, ...] = (),
    *,
    fixed: bool = False,
    file: bool = False,
    frame: bool = False,
) -> Any:
    """Return a dataclass field that is a row of the table; span: smallest and largest value."""
    low, high = span or (None, None)
    row = Row('', default, description, unit, low, high, choices, fixed, file, frame)
    return field(default=default, metadata={'row': row})


def rows(table: Any) -> list[Row]:
    """Return the rows of a table, given as class or instance."""
    return [f.metadata['row']._replace(name=f.name) for f in fields(table)]


def with_values(table: S, values: Mapping[str, Any]) -> S:
    """Return the table with some values changed; names that are no row are ignored.

    Raises ParameterError for a value that is not allowed.
    """
    given = {
        row.name: row.check(values[row.name]) if row.name in values else getattr(table, row.name)
        for row in rows(table)
    }
    return type(table)(**given)


@dataclass(frozen=True)
class Sweep:
    """The Cartesian product of lists of parameter values; the last list runs fastest."""

    lists: Mapping[str, Sequence[Any]]

    def __len__(self) -> int:
        return math.prod(map(len, self.lists.values()))

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return map(self.point, range(len(self)))

    def point(self, number: int) -> dict[str, Any]:
        """Return one combination of values, counted from 0."""
        values = {}
        for name in reversed(tuple(self.lists)):
            number, place = divmod(number, len(self.lists[name]))
            values[name] = self.lists[name][place]
        return {name: values[name] for name in self.lists}


def sweep_of(
    table: Any, parameters: Mapping[str, Any], excluded: Collection[str] = ()
) -> Sweep:
    """Return the sweep that the `sweep.<parameter>` entries of a parameter file ask for.

    excluded: parameters that cannot be swept.
    Raises ParameterError for an unknown parameter, an empty list or a value that is not allowed.
    """
    known = {row.name: row for row in rows(table)
             if not isinstance(row.default, tuple) and row.name not in excluded}
    lists = {}
    for name, values in parameters.items():
        if not name.startswith(SWEEP):
            continue
        row = known.get(name.removeprefix(SWEEP))
        if row is None:
            raise ParameterError(f'{name}: no such parameter to sweep; known are '
                                 + ', '.join(known))
        if values is None:  # as a parameter file has an empty list
            values = []
        if isinstance(values, str) or not isinstance(values, Sequence) or not len(values):
            raise ParameterError(f'{name} is {values!r}; a list of at least one value is needed')
        lists[row.name] = [row.check(value) for value in values]
    return Sweep(lists)
