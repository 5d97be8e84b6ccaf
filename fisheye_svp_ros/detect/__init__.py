"""Photographs to observations: sources, detectors, the order of corners, their uncertainty.

The room can be called: `fsvp.detect(photographs, board)` searches photographs as the command does.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from fisheye_svp_ros.errors import only_own_errors

if TYPE_CHECKING:
    from fisheye_svp_ros.detect.detection import Detection

# Pixels of an image that OpenCV decodes, 67 million: a small file can ask for any number.  OpenCV
# reads this as it is loaded.
os.environ.setdefault('OPENCV_IO_MAX_IMAGE_PIXELS', str(1 << 26))


class _CallablePackage(ModuleType):
    """A package that is a function of the library, too: both have the name `detect`."""

    @only_own_errors
    def __call__(
        self,
        photographs: str | Path | Sequence[str | Path],
        board: str,
        *,
        detector: str = '',
        every: int = 1,
        sync: float | None = None,
        split: int | None = None,
    ) -> Detection:
        """Search photographs (files, folders, videos, recordings) for a board.

        board: as in `--board`; every: take one of so many; sync: largest difference, s, of the
        stamps of one moment of a rig; split: cameras side by side in each image, None: 2 where
        both halves of wide images show the board.  The result has `observations` and `searched`.
        Raises ObservationError where no photograph shows the board, ParameterError for a board
        that cannot be, and for a detector that does not find it.
        """
        from fisheye_svp_ros.detect.detection import detect
        from fisheye_svp_ros.detect.finders import DETECTORS
        from fisheye_svp_ros.detect.patterns import parse_pattern
        from fisheye_svp_ros.detect.photographs import find_photographs
        from fisheye_svp_ros.detect.side_by_side import count_cameras
        from fisheye_svp_ros.errors import ParameterError

        given = [photographs] if isinstance(photographs, str | Path) else photographs
        paths, pattern = [str(path) for path in given], parse_pattern(str(board))
        able = [name for name, (kinds, _) in DETECTORS.items() if pattern.kind in kinds]
        if detector and detector not in able:
            raise ParameterError(
                f'detector {detector!r} does not find {pattern.spec}; choose from '
                f'{", ".join(able)}'
            )
        if not paths:
            raise ParameterError('no photographs; give at least one file or folder')
        if every < 1:
            raise ParameterError(f'every is {every}; 1 or more is needed')
        if sync is not None and (isinstance(sync, str) or not sync >= 0):
            raise ParameterError(f'sync is {sync!r}; seconds are needed, 0 or more')
        if split is not None and split < 1:
            raise ParameterError(f'split is {split}; 1 or more is needed')
        split = split or count_cameras(find_photographs(paths, every), pattern, detector)
        found = find_photographs(paths, every, split)
        return detect(found, pattern, detector, source=', '.join(paths), sync=sync)


sys.modules[__name__].__class__ = _CallablePackage
