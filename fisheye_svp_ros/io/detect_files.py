"""What `detect` wrote beside its observations: photographs and image sizes, checked for use."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from fisheye_svp_ros.errors import LensError, ObservationError, ParameterError
from fisheye_svp_ros.io.documents import read_json
from fisheye_svp_ros.optics.lens import Lens

Sizes = dict[str, tuple[int, int]]  # width and height, px, by camera


def photographs_beside(
    path: Path, cameras: Sequence[str]
) -> tuple[tuple[int, str, str], ...]:
    """Return frame, camera and path of the photographs that `detect` wrote beside observations."""
    beside = path.with_suffix('.detect.json')
    if not beside.exists():
        return ()
    try:
        entries = [(int(one['frame']), str(one['camera']), str(one['name']))
                   for one in read_json(beside, ObservationError).get('photographs', ())]
    except (KeyError, TypeError, ValueError) as cause:
        raise ObservationError(f'{beside}: photographs is not a list of name, camera and frame '
                               f'({cause}); run `fisheye-svp detect` again') from cause
    return tuple(one for one in entries if one[0] >= 0 and one[1] in cameras)


def sizes_beside(path: Path) -> Sizes:
    """Return the image size of each camera that `detect` wrote beside its observations."""
    beside = path.with_suffix('.detect.json')
    if not beside.exists():
        return {}
    document = read_json(beside, ObservationError)
    entries = document.get('image_sizes', {'': document.get('image_size')})
    sizes: Sizes = {}
    for camera, entry in entries.items() if isinstance(entries, dict) else ():
        match entry:
            case [int(width), int(height)] if width > 0 < height:
                sizes[camera] = width, height
    if not sizes:
        raise ObservationError(f'{beside}: image_sizes must be whole numbers; give --image-size')
    return sizes


def check_sizes(path: str, sizes: Sizes, lenses: Mapping[str, Lens]) -> None:
    """Raise LensError where images are of another size than their lens.

    sizes: as far as they are known from elsewhere than from what `detect` wrote.
    """
    sizes = sizes or sizes_beside(Path(path))
    for camera, lens in lenses.items():
        size = sizes.get(camera) or sizes.get('')
        if size and size != (lens.width, lens.height):
            raise LensError(f'{path}: images are {size[0]}x{size[1]} px, lens {lens.name!r} is '
                            f'for {lens.width}x{lens.height} px; give the lens of this camera at '
                            'this size')


def check_size_given(path: str, sizes: Sizes, given: Sizes, name: str) -> None:
    """Raise ParameterError where images have another size than an argument; sizes: as above."""
    for camera, (width, height) in (sizes or sizes_beside(Path(path))).items():
        size = given.get(camera) or given.get('') or (width, height)
        if size != (width, height):
            raise ParameterError(f'{path}: images are {width}x{height} px, {name} is '
                                 f'{size[0]}x{size[1]}; give the size of the images')
