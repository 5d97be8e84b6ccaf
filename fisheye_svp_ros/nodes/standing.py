"""Which landmarks hold for a set of image points that has none of its own stamp."""

from __future__ import annotations

from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.io.decoding import LandmarkSet
from fisheye_svp_ros.nodes.inputs import Unread


class StandingLandmarks:
    """The latest landmarks, until they turn out to come set by set.

    That is so once a set had landmarks of its own stamp and landmarks of other stamps come as
    well: those of one set must not stand in for those of another.  Stamp 0 says that they hold.
    """

    def __init__(self) -> None:
        self._latest: LandmarkSet | None = None
        self._stamp: int | None = None
        self._matched = self._vary = False

    def hear(self, stamp: int, unread: Unread) -> None:
        """Take note of landmarks; raise ObservationError where they cannot be used."""
        if not stamp:
            self._stamp, self._matched, self._vary = None, False, False
        elif stamp != self._stamp:
            self._vary = self._stamp is not None
            self._stamp = stamp
        if not self._is_series:
            self._latest = unread.read()

    def find_for_set(self, own: LandmarkSet | None, distance: int | None) -> LandmarkSet:
        """Return the landmarks of a set; raise ObservationError where there are none.

        own: those of its stamp; distance: of the nearest stamp there was, ns.
        """
        self._matched = self._matched or own is not None
        if own is not None:
            return own
        if self._is_series:
            raise ObservationError(
                f'no landmarks of its stamp, the nearest is {1e-6 * (distance or 0):.1f} ms off: '
                'they were late, lost, or never sent; publish landmarks that hold for all sets '
                'with stamp 0')
        if self._latest is None:
            raise ObservationError('no landmarks; publish them on `landmarks`')
        return self._latest

    @property
    def _is_series(self) -> bool:
        return self._matched and self._vary
