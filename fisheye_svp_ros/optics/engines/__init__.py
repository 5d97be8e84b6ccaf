"""The engines that the projection and its solvers run on, and which of them does.

NumPy is the reference.  Numba computes the same faster, but must be loaded and, once on a machine,
compile, which only long work pays back: what begins such work says so (`settle`), and what must
not wait has it compiled meanwhile (`settle_in_background`).  A lens behind a port is traced by
`port_projection`; a displacement moves what any of them returns.  Anything else runs on NumPy, and
gives the same to the last digit whatever was compiled before.
FISHEYE_SVP_ENGINE or `use` have the last word; nothing outside this package asks which one runs.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from importlib.util import find_spec
from types import ModuleType

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.optics.engines import cache, numpy_engine, port_projection
from fisheye_svp_ros.optics.engines.cache import Compilation
from fisheye_svp_ros.optics.engines.results import Incidence, Localization, Rigs, Seen
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose

ENGINES = ('auto', 'numpy', 'numba')
VARIABLE = 'FISHEYE_SVP_ENGINE'
LOADING = 4_000_000  # points that the reference projects while Numba loads what it has compiled
_COMPILING = 400_000_000  # while it compiles

pose_equations = numpy_engine.pose_equations


def _say_nothing() -> None:
    pass


# Called before this process waits for Numba to compile, for whoever has somebody to tell.
before_compiling: Callable[[], None] = _say_nothing


def use(name: str) -> None:
    """Settle the engine of this process, and of processes it starts: one of ENGINES.

    Raises ParameterError for another name, or for one that is not installed.
    """
    global _engine
    _engine = _load_engine(name)
    os.environ[VARIABLE] = name


def settle_in_background() -> Compilation | None:
    """Take Numba now if it has compiled; else have it compile, and take it then.

    Returns what tells how far that is; None where there is nothing to compile, or not to be.
    """
    global _engine
    wanted = os.environ.get(VARIABLE, 'auto') != 'numpy' and find_spec('numba') is not None
    if not wanted or cache.is_compiled():
        settle(LOADING)
        return None
    _engine = numpy_engine
    return Compilation(lambda: use('numba'), VARIABLE)


def settle(points: float) -> str:
    """Take Numba for work about so many points if that pays; return the engine in use.

    Does nothing where the engine is settled already, or where Numba cannot be had.
    """
    if os.environ.get(VARIABLE, 'auto') == 'auto' and find_spec('numba') is not None:
        with suppress(ParameterError):
            if points >= (LOADING if cache.is_compiled() else _COMPILING):
                use('numba')
    return 'numpy' if _engine is numpy_engine else 'numba'


def incidence(lens: Lens, points: Array, limited: bool) -> Incidence:
    """Return where points (M, 3), m, in the camera frame have their ray through the lens."""
    if lens.port is not None:
        return port_projection.incidence(lens, points, limited)
    return numpy_engine.incidence(lens, points, limited)


def project(lens: Lens, points: Array, limited: bool) -> tuple[Array, Mask]:
    """Return image points (M, 2), px, of points (M, 3), m, in the camera frame, and validity."""
    engine = _running() if lens.port is None else port_projection
    uv, valid = engine.project(lens, points, limited)
    return lens.displace(uv) if lens.displaces else uv, valid


def linearize_views(
    lens: Lens, rotation: Array, position: Array, points: Array, limited: bool
) -> tuple[Array, Mask, Array]:
    """Return image points (S, N, 2) of points (S, N, 3) in the world, validity, derivatives.

    rotation (S, 3, 3), position (S, 3): cameras in the world.  The derivatives (S, N, 2, 6) are
    by the small changes of `pose.Pose.retract`, px/m and px/rad.
    """
    engine = _running() if lens.port is None else port_projection
    uv, valid, d_pose = engine.linearize_views(lens, rotation, position, points, limited)
    if lens.displaces:
        d_pose, uv = lens.carry(uv, d_pose), lens.displace(uv)
    return uv, valid, d_pose


def localize(
    lens: Lens, seen: Seen, row: Index, minimum: int, start: Pose
) -> tuple[Localization, int, int] | None:
    """Solve single poses from starts (S,), if the engine can do so by itself.

    row (S, N): below 0 for padding; minimum: usable points that a view must have.  Returns also
    how many have not converged, which remain for the solver, and how many targets are flat.
    """
    if not lens.is_bare:
        return None
    solution: tuple[Localization, int, int] | None = _running().localize(
        lens, seen, row, minimum, start
    )
    return solution


def adjust_rigs(
    lenses: tuple[Lens, Lens], seen: tuple[Seen, Seen], state: tuple[Array, ...]
) -> Rigs | None:
    """Solve S stereo rigs of V views each from their starts, if the engine can do so by itself.

    lenses, seen: of the left and right cameras, S * V views; state: rotation (S, V, 3, 3) and
    position (S, V, 3) of the right camera, (S, 3, 3) and (S, 3) of the left one in the right one.
    """
    if not all(lens.is_bare for lens in lenses):
        return None
    rigs: Rigs | None = _running().adjust_rigs(lenses, seen, state)
    return rigs


def _load_engine(name: str) -> ModuleType:
    if name not in ENGINES:
        raise ParameterError(f'{VARIABLE} is {name!r}; choose from {", ".join(ENGINES)}')
    if name != 'numba':
        return numpy_engine
    if find_spec('numba') is not None and not cache.is_compiled():
        before_compiling()
    try:
        from fisheye_svp_ros.optics.engines import numba_engine
    except ImportError as cause:  # also where Numba does not go with this NumPy
        raise ParameterError(
            f'the engine numba cannot be loaded: {cause}; pip install -U fisheye_svp_ros[fast]'
        ) from cause
    cache.mark_filled()
    return numba_engine


def _running() -> ModuleType:
    if _engine is None:
        use('numba')
    assert _engine is not None
    return _engine


def _compiles_first() -> bool:
    """Say whether the engine asked for is there, but would have to compile now."""
    numba = os.environ.get(VARIABLE) == 'numba' and find_spec('numba') is not None
    return numba and not cache.is_compiled()


# What has to compile waits until it is needed: a node has it compile in the background by then.
_engine: ModuleType | None = (
    None if _compiles_first() else _load_engine(os.environ.get(VARIABLE, 'auto'))
)
