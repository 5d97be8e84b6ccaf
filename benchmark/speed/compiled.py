"""C sources compiled at run time: the hand-written kernel and mrcal's core."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np

from benchmark.speed.harness import NotHereError
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.optics.curves import Equidistant, Gennery, KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens

_HERE = Path(__file__).parent
# Where `make bench` puts the sources of mrcal.
MRCAL = Path(os.environ.get('MRCAL', _HERE.parents[1] / '.venv-bench' / 'mrcal'))
# The second set for compilers and machines that do not know the width.
_FAST = (('-march=native', '-mprefer-vector-width=512'), ('-march=native',), ())


class Kernel:
    """The hand-written kernel for one lens; arrays are written over at every call."""

    def __init__(self, lens: Lens) -> None:
        if not isinstance(lens.image_height, Equidistant | KannalaBrandt):
            raise NotHereError('the hand-written kernel has no such image height')
        library = _kernel()
        end = 'svp' if lens.viewpoint_shift is None else 'shift'
        self._project = getattr(library, f'project_{end}')
        self._linearize = getattr(library, f'linearise_{end}')
        k = np.zeros(4)
        k[: len(lens.image_height.coefficients)] = lens.image_height.coefficients
        shift = lens.viewpoint_shift.coefficients if lens.viewpoint_shift else np.zeros(4)
        self._lens = np.array([lens.fx, lens.fy, lens.cx, lens.cy, *k, *shift])

    def project(self, points: Array) -> Array:
        """Return image points (N, 2), px, of points (N, 3), m, in the camera frame."""
        uv = np.empty((len(points), 2))
        self._project(ctypes.c_long(len(points)), *map(_at, (points, self._lens, uv)))
        return uv

    def linearize(self, points: Array, rotation: Array, position: Array) -> tuple[Array, Array]:
        """Return image points (N, 2) and derivatives (N, 2, 6) of world points (N, 3)."""
        uv, jacobian = np.empty((len(points), 2)), np.empty((len(points), 2, 6))
        arrays = (points, np.ascontiguousarray(rotation), position, self._lens, uv, jacobian)
        self._linearize(ctypes.c_long(len(points)), *map(_at, arrays))
        return uv, jacobian


class MrcalCore:
    """mrcal's CAHVORE core for an equidistant lens with Gennery's shift."""

    def __init__(self, lens: Lens) -> None:
        self._project_all = _mrcal().mrcal_project
        assert isinstance(lens.viewpoint_shift, Gennery)
        s0, *e = lens.viewpoint_shift.coefficients
        self._lens = np.array([lens.fx, lens.cx, lens.cy, *e])
        self._offset = np.array([0.0, 0.0, s0])

    def prepared(self, points: Array) -> Array:
        """Return points as CAHVORE has them, from its own origin."""
        return np.ascontiguousarray(points - self._offset)

    def project(self, points: Array) -> Array:
        """Return image points (N, 2), px, of prepared points (N, 3), m."""
        uv = np.empty((len(points), 2))
        self._call(points, uv, None)
        return uv

    def project_with_gradient(self, points: Array) -> tuple[Array, Array]:
        """Return also the derivatives (N, 3, 3) by the point."""
        uv, gradient = np.empty((len(points), 2)), np.empty((len(points), 3, 3))
        self._call(points, uv, gradient)
        return uv, gradient

    def _call(self, points: Array, uv: Array, gradient: Array | None) -> None:
        last = None if gradient is None else _at(gradient)
        self._project_all(ctypes.c_long(len(points)), *map(_at, (points, self._lens, uv)), last)


# -Ofast by its parts: a library linked with it makes the whole process flush subnormal numbers.
_OFAST = (
    '-O3',
    '-fno-math-errno',
    '-fno-trapping-math',
    '-ffinite-math-only',
    '-fno-signed-zeros',
    '-fassociative-math',
    '-freciprocal-math',
)


@cache
def _kernel() -> ctypes.CDLL:
    return _compile('cc', [*_OFAST, '-fopenmp-simd'], [_HERE / 'kernel.c'], 'kernel')


@cache
def _mrcal() -> ctypes.CDLL:
    mrcal_revision()
    sources = [_HERE / 'mrcal_core.cc', MRCAL / 'cahvore.cc']
    return _compile('c++', ['-O3', f'-I{MRCAL}'], sources, 'mrcal')


def compiler(command: str = 'cc') -> str:
    """Return what a compiler calls itself; raise NotHereError where there is none."""
    if shutil.which(command) is None:
        raise NotHereError(f'no compiler `{command}`')
    run = subprocess.run([command, '--version'], capture_output=True, text=True, check=True)
    return run.stdout.splitlines()[0]


def mrcal_revision() -> str:
    """Return the revision of the sources of mrcal; raise NotHereError where there are none."""
    if not (MRCAL / 'cahvore.cc').is_file():
        raise NotHereError(
            'no sources of mrcal; `git clone https://github.com/dkogan/mrcal .venv-bench/mrcal`'
        )
    run = subprocess.run(
        ['git', f'--git-dir={MRCAL}/.git', 'rev-parse', '--short', 'HEAD'],
        capture_output=True,
        text=True,
        check=False,
    )
    return run.stdout.strip() or 'unknown'


def _compile(
    command: str, flags: Sequence[str], sources: Sequence[Path], name: str
) -> ctypes.CDLL:
    compiler(command)
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / f'{name}.so'
        for fast in _FAST:
            line = [
                command,
                *flags,
                *fast,
                '-shared',
                '-fPIC',
                *map(str, sources),
                '-o',
                str(library),
                '-lm',
            ]
            run = subprocess.run(line, capture_output=True, text=True, check=False)
            if run.returncode == 0:
                return ctypes.CDLL(str(library))
    complaint = next(iter(run.stderr.splitlines()), 'no reason given')
    raise NotHereError(f'`{command}` does not compile it: {complaint}')


def _at(array: Array) -> ctypes.c_void_p:
    return array.ctypes.data_as(ctypes.c_void_p)
