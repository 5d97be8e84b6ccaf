"""What the single-viewpoint approximation of a fisheye lens costs, and where simulation errs.

`import fisheye_svp_ros as fsvp` is the library; a name is loaded when it is asked for.
"""

from importlib import import_module as _import_module
from typing import Any as _Any

__version__ = '1.1.0'

_HOMES = {
    'FisheyeSvpError': 'errors',
    'Pose': 'pose',
    'Lens': 'optics.lens',
    'Observations': 'scene.observations',
    'rig': 'scene.rigs',
    'Columns': 'library.results',
    'read_observations': 'io.readers',
    'write_observations': 'io.readers',
    'read_poses': 'io.readers',
    'detect': '',
    'observations': 'library.boards',
    'render': 'library.boards',
    'plan': 'library.boards',
    'write_lens': 'library.boards',
    'load_lens': 'library.functions',
    'load_rig': 'io.rig_files',
    'save_lens': 'library.functions',
    'resize_lens': 'library.lenses',
    'opencv_matrices': 'library.lenses',
    'project': 'library.functions',
    'back_project': 'library.functions',
    'localize': 'library.functions',
    'calibrate': 'library.functions',
    'calibrate_cameras': 'library.functions',
    'calibrate_stereo': 'library.functions',
    'calibrate_rig': 'library.boards',
    'localize_rig': 'library.boards',
    'map': 'library.tag_maps',
    'stereo_depth': 'library.functions',
    'simulate_scenario': 'library.functions',
    'sweep': 'library.functions',
    'diagnose': 'library.functions',
    'budget': 'library.functions',
    'undistort_maps': 'library.functions',
    'rectify_maps': 'library.functions',
    'undistort_views': 'library.lenses',
    'compare': 'library.lenses',
    'plot_comparison': 'library.plots',
    'plot_lens': 'library.plots',
    'plot_residuals': 'library.plots',
    'plot_budget': 'library.plots',
}
__all__ = [*_HOMES]


def __getattr__(name: str) -> _Any:
    if name not in _HOMES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    if not _HOMES[name]:  # a room that can be called
        return _import_module(f'{__name__}.{name}')
    value = getattr(_import_module(f'{__name__}.{_HOMES[name]}'), name)
    if not isinstance(value, type):
        from fisheye_svp_ros.errors import only_own_errors

        value = only_own_errors(value)
    return globals().setdefault(name, value)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
