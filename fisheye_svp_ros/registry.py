"""Registries: the package's own kinds by name, and those of other distributions.

Another distribution adds one by an entry point: its name in the group `fisheye_svp_ros.<what>`,
pointing to the class.  Those are looked for when a name is not the package's own, or when all are
asked for.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache, cached_property
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar

from fisheye_svp_ros.errors import ParameterError

T = TypeVar('T')


class Registry(Mapping[str, T]):
    """Kinds by name; what: the last word of the group of entry points; base: of every class.

    unlisted: kinds that are found by name, and are not among all.
    """

    def __init__(
        self, what: str, own: Mapping[str, T], base: type, unlisted: Mapping[str, T] | None = None
    ) -> None:
        self._what, self._own, self._base, self.unlisted = what, own, base, unlisted or {}

    def __getitem__(self, name: str) -> T:
        known = {**self.unlisted, **self._own}
        return known[name] if name in known else self._entry_points[name]

    def __iter__(self) -> Iterator[str]:
        return iter((*self._own, *self._entry_points))

    def __len__(self) -> int:
        return len(self._own) + len(self._entry_points)

    def name_of(self, kind: object) -> str | None:
        """Return the name of a kind; None where it is not registered."""
        for names in (self._own, self):
            for name, known in names.items():
                if known is kind:
                    return name
        return None

    @cached_property
    def _entry_points(self) -> dict[str, T]:
        group = f'fisheye_svp_ros.{self._what}'
        return {entry.name: self._load(entry) for entry in _all_entry_points().select(group=group)}

    def _load(self, entry: EntryPoint) -> Any:
        whose = f'{entry.group} {entry.name!r} of {entry.dist.name if entry.dist else entry.value}'
        try:
            kind = entry.load()
        except Exception as cause:  # whatever somebody else's module raises
            raise ParameterError(
                f'{whose} cannot be loaded ({cause}); fix or uninstall it'
            ) from cause
        own = {*self.unlisted, *self._own}
        if entry.name in own or getattr(kind, 'name', entry.name) != entry.name:
            raise ParameterError(
                f'{whose}: the name is taken, or is not that of its class; rename it'
            )
        if not issubclass(kind if isinstance(kind, type) else type(kind), self._base):
            raise ParameterError(f'{whose} is not derived from {self._base.__name__}')
        return kind


@cache
def _all_entry_points() -> Any:
    """Return those of all distributions: those of one group take as long."""
    return entry_points()
