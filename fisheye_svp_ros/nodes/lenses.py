"""The lenses of solving nodes, as a parameter or a scenario names them."""

from __future__ import annotations

from collections.abc import Sequence

from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.io.lens_files import cameras_in
from fisheye_svp_ros.io.parameters import rows
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.simulate.scenario import Scenario, true_lens
from fisheye_svp_ros.study.settings import SolverSettings

_SHIFT_SCALE = next(row for row in rows(Scenario) if row.name == 'shift_scale')


def lenses_of(settings: SolverSettings, cameras: Sequence[str]) -> dict[str, Lens]:
    """Return the lens of the parameter by camera; raise LensError for a bad one.

    cameras: namespaces, each with its slash.
    """
    names = cameras_in(lens_path(settings.lens))
    if len(cameras) < 2 or not names:
        return dict.fromkeys(('', *cameras), lens_of(settings.lens, 1.0, settings))
    return {
        camera: lens_of(f'{settings.lens}#{name}', 1.0, settings)
        for camera, name in zip(cameras, names, strict=False)
    }


def lens_of(name: str, scale: float, settings: SolverSettings) -> Lens:
    """Return a lens as it is to be solved with; raise FisheyeSvpError where it cannot be."""
    lens = true_lens(name, scale)
    return lens.approximate() if settings.solves_svp else lens


def shift_scale(text: str) -> float:
    """Return the factor that a scenario names; raise FisheyeSvpError where it cannot be used."""
    try:
        value = float(text)
    except ValueError:
        raise ObservationError(
            f'scenario: shift_scale is {text[:40]!r}; a number is needed'
        ) from None
    return float(_SHIFT_SCALE.check(value))
