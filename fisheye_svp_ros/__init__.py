"""What the single-viewpoint approximation of a fisheye lens costs, and where simulation errs.

`import fisheye_svp_ros as fsvp` is the library; a name is loaded when it is asked for.
"""

from importlib import import_module as _import_module
from typing import Any as _Any

__version__ = '1.0.0'

_HOMES = {
    'FisheyeSvpError': 'errors',
    'Pose': 'pose',
    'Lens': 'optics.lens',
    'Observations': 'scene.observations',
    'rig': 'scene.rigs',
    'Columns': 'library_results',
    'read_observations': 'io.readers',
    'write_observations': 'io.readers',
    'read_poses': 'io.readers',
    'detect': '',
    'observations': 'library_boards',
    'render': 'library_boards',
    'plan': 'library_boards',
    'write_lens': 'library_boards',
    'load_lens': 'library',
    'load_rig': 'io.rig_files',
    'save_lens': 'library',
    'project': 'library',
    'back_project': 'library',
    'localize': 'library',
    'calibrate': 'library',
    'calibrate_stereo': 'library',
    'calibrate_rig': 'library_boards',
    'localize_rig': 'library_boards',
    'stereo_depth': 'library',
    'simulate_scenario': 'library',
    'sweep': 'library',
    'diagnose': 'library',
    'budget': 'library',
    'undistort_maps': 'library',
    'rectify_maps': 'library',
    'plot_lens': 'library_plots',
    'plot_residuals': 'library_plots',
    'plot_budget': 'library_plots',
}
__all__ = [*_HOMES]


def __getattr__(name: str) -> _Any:
    if name not in _HOMES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    if not _HOMES[name]:  # a room that can be called
        return _import_module(f'{__name__}.{name}')
    return getattr(_import_module(f'{__name__}.{_HOMES[name]}'), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
