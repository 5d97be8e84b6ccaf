"""Where the package's own files (lenses, environments, parameter files) are installed."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from urllib.parse import unquote

from fisheye_svp_ros.errors import FisheyeSvpError, LensError, ParameterError

_PACKAGE = 'fisheye_svp_ros'


@cache
def share_directory() -> Path:
    """Return the directory that holds config/: the source tree, or <prefix>/share/<package>."""
    package = Path(__file__).resolve().parents[1]
    source = package.parent
    if (source / 'package.xml').is_file():
        return source
    return package.parents[3] / 'share' / package.name


def config_path(name: str) -> Path:
    """Return the path of a file below config/."""
    return share_directory() / 'config' / name


def expand_path(name: str) -> str:
    """Return a path that begins with package://PACKAGE/, file:// or ~ as one of this machine.

    Raises ParameterError for a package that is not here; anything else is returned as it is.
    """
    if name.startswith('file://'):
        return unquote(name.removeprefix('file://'))
    if name.startswith('~'):
        try:
            return str(Path(name).expanduser())
        except RuntimeError as cause:
            raise ParameterError(f'{name!r}: {cause}') from cause
    if not name.startswith('package://'):
        return name
    package, _, path = unquote(name.removeprefix('package://')).partition('/')
    if package == _PACKAGE:
        return str(share_directory() / path)
    try:
        from ament_index_python.packages import get_package_share_directory

        return str(Path(get_package_share_directory(package)) / path)
    except (ImportError, LookupError, ValueError) as cause:
        raise ParameterError(
            f'{name!r}: package {package!r} is not found; source its workspace, or give a path'
        ) from cause


def lens_path(name: str) -> Path:
    """Return a lens file as given, or by its name in config/; raise LensError for neither."""
    return _given_or_named(name, 'lenses', LensError)


def typed_lens_path(name: str) -> Path:
    """Return what `lens_path` does of a name that a user typed: a folder needs no slash then.

    A lens of this package comes before a folder of its name.
    """
    name = expand_path(name)
    try:
        return lens_path(name)
    except LensError:
        if is_there(Path(without_camera(name)[0]), Path.is_dir):
            return Path(name)
        raise


def sweep_path(name: str) -> Path:
    """Return a sweep file as given, or that in config/sweeps; raise ParameterError for neither."""
    return _given_or_named(name, 'sweeps', ParameterError)


def _given_or_named(name: str, folder: str, error: type[FisheyeSvpError]) -> Path:
    literal, named = Path(name), config_path(f'{folder}/{name}.yaml')
    # FILE#cam1 names one of the lenses of a file, or of a folder.
    holder = Path(without_camera(name)[0])
    if literal.suffix in ('.yaml', '.yml') or is_there(holder, Path.is_file):
        return literal
    # What has no slash may come over the network, and is a name in config/ then.
    if '/' in name and is_there(holder, Path.is_dir):
        return literal
    if not is_there(named, Path.is_file):
        if literal.is_dir():
            raise error(
                f'{name!r} is a folder, and not one of the {folder} of this package; '
                f'write {name}/ for the folder'
            )
        names = ', '.join(sorted(path.stem for path in config_path(folder).glob('*.yaml')))
        raise error(f'{name!r} is neither a file nor one of the {folder} of this package: {names}')
    return named


def without_camera(name: str) -> tuple[str, str]:
    """Return the file or folder of FILE#cam1 and the camera, '' where there is none.

    Folders and cameras may have a # in their names: the shortest part that is there counts.
    """
    for place in [*(i for i, letter in enumerate(name) if letter == '#'), len(name)]:
        if is_there(Path(name[:place])):
            return name[:place], name[place + 1 :]
    file, _, camera = name.rpartition('#') if '#' in name else (name, '', '')
    return file, camera


def is_there(path: Path, test: Callable[[Path], bool] = Path.exists) -> bool:
    """Say whether a path is that of a file or folder, or passes another `test`."""
    try:
        return test(path)
    except (OSError, ValueError):  # a name that no file can have
        return False
