"""The engines that the projection and its solvers run on, and which of them does.

NumPy is the reference.  Numba computes the same faster, but must be loaded and, once on a machine,
compile: the reference works until it has worked about as long as that takes.  FISHEYE_SVP_ENGINE
or `use` settle it; nothing outside this package asks which one runs.
"""

from __future__ import annotations

import os
from importlib.util import find_spec
from types import ModuleType

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.engines import cache, numpy_engine
from fisheye_svp_ros.engines.answers import Poses, Rigs, Seen
from fisheye_svp_ros.engines.rays import Incidence
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.lens import Lens

ENGINES = ('auto', 'numpy', 'numba')
VARIABLE = 'FISHEYE_SVP_ENGINE'
_LOADING = 4_000_000  # points that the reference projects while Numba loads what it has compiled
_COMPILING = 400_000_000  # while it compiles


class _Choice:
    """The engine in use, and how many points may still go to the reference before Numba comes."""

    def __init__(self, name: str) -> None:
        if name not in ENGINES:
            raise ParameterError(f'{VARIABLE} is {name!r}; known are {", ".join(ENGINES)}')
        self._engine: ModuleType = numpy_engine
        self._patience: float = float('inf')
        if name == 'numba':
            self._engine = _numba()
        elif name == 'auto' and find_spec('numba') is not None:
            self._patience = _LOADING if cache.filled() else _COMPILING

    def engine(self, points: int) -> ModuleType:
        """Return the engine for a call about so many points."""
        self._patience -= points
        if self._patience < 0:
            self._patience = float('inf')
            self._engine = _numba()
        return self._engine


def use(name: str) -> None:
    """Settle the engine of this process, and of processes it starts: one of ENGINES.

    Raises ParameterError for another name, or for one that is not installed.
    """
    global _choice
    _choice = _Choice(name)
    os.environ[VARIABLE] = name


def incidence(lens: Lens, points: Array, limited: bool) -> Incidence:
    """Return where points (M, 3), m, in the camera frame meet the lens."""
    return numpy_engine.incidence(lens, points, limited)


def project(lens: Lens, points: Array, limited: bool) -> tuple[Array, Mask]:
    """Return image points (M, 2), px, of points (M, 3), m, in the camera frame, and validity."""
    uv, valid = _choice.engine(len(points)).project(lens, points, limited)
    return uv, valid


def linearise(lens: Lens, points: Array, limited: bool) -> tuple[Array, Mask, Array]:
    """Return what `project` does, and the derivatives (M, 2, 3) by the point, px/m."""
    uv, valid, d_point = _choice.engine(len(points)).linearise(lens, points, limited)
    return uv, valid, d_point


def linearise_views(
    lens: Lens, rotation: Array, position: Array, points: Array, limited: bool
) -> tuple[Array, Mask, Array]:
    """Return image points (S, N, 2) of points (S, N, 3) in the world, validity, derivatives.

    rotation (S, 3, 3), position (S, 3): cameras in the world.  The derivatives (S, N, 2, 6) are
    by the small changes of `pose.Pose.retract`, px/m and px/rad.
    """
    uv, valid, d_pose = _choice.engine(points.size // 3).linearise_views(
        lens, rotation, position, points, limited
    )
    return uv, valid, d_pose


def pose_equations(
    lens: Lens, rotation: Array, position: Array, seen: Seen
) -> tuple[Array, Array, Array]:
    """Return costs (S,) and normal equations (S, 6, 6), (S, 6) of single poses.

    rotation (S, 3, 3), position (S, 3): cameras in the world.  A point without an image costs
    infinity, unless its weight is 0.
    """
    return numpy_engine.pose_equations(lens, rotation, position, seen)


def localize(
    lens: Lens, seen: Seen, row: Index, minimum: int, start: tuple[Array, ...]
) -> Poses | None:
    """Solve single poses from starts (S, 3, 3), (S, 3), if the engine can do so by itself.

    row (S, N): below 0 for padding; minimum: usable points that a view must have.
    """
    poses: Poses | None = _choice.engine(seen[2].size).localize(lens, seen, row, minimum, start)
    return poses


def adjust_rigs(
    lenses: tuple[Lens, Lens], seen: tuple[Seen, Seen], state: tuple[Array, ...]
) -> Rigs | None:
    """Solve S stereo rigs of V views each from their starts, if the engine can do so by itself.

    lenses, seen: of the left and right cameras, S * V views; state: rotation (S, V, 3, 3) and
    position (S, V, 3) of the right camera, (S, 3, 3) and (S, 3) of the left one in the right one.
    """
    rigs: Rigs | None = _choice.engine(seen[0][2].size).adjust_rigs(lenses, seen, state)
    return rigs


def _numba() -> ModuleType:
    try:
        from fisheye_svp_ros.engines import numba_engine
    except ModuleNotFoundError as cause:
        raise ParameterError(
            f'the engine numba needs the Python package {cause.name}: '
            'pip install fisheye_svp_ros[fast]'
        ) from cause
    cache.mark_filled()
    return numba_engine


_choice = _Choice(os.environ.get(VARIABLE, 'auto'))
