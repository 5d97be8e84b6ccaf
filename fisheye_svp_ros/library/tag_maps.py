"""The library's part about maps of tags, which the command `map` calls, too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fisheye_svp_ros.detect.photographs import find_photographs
from fisheye_svp_ros.detect.tags import FAMILY, find_tag_views, tag_size
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.files import write_together
from fisheye_svp_ros.io.readers import check_sizes, write_poses
from fisheye_svp_ros.io.tag_maps import TagMap, map_of_size, tag_covariance, write_tag_map
from fisheye_svp_ros.library.checks import check_type, check_whole_numbers
from fisheye_svp_ros.library.functions import AnyLens, Progress, load_lens, silent
from fisheye_svp_ros.library.results import Columns
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.process import limit_threads
from fisheye_svp_ros.reporting.wording.poses import map_notes
from fisheye_svp_ros.solve.tag_mapping import TagMapping, map_tags


@dataclass(frozen=True)
class MappedTags:
    """A map of tags from images of a walk.

    tags: ids (T,), sizes (T,), m, poses (T,) in the frame of the origin, covariance (6 T, 6 T);
    mapping: what was solved, with `rms_px`, `missing` and the number of each posed image (F,);
    photographs: the names of all images.
    """

    tags: TagMap
    mapping: TagMapping
    photographs: tuple[str, ...]

    @property
    def pose(self) -> Pose:
        """Poses (F,) of the camera in the map."""
        return self.mapping.cameras

    @property
    def notes(self) -> tuple[str, ...]:
        """What the map lacks, and whether it can be relied on."""
        found = self.mapping
        return tuple(map_notes(found.missing, found.outside, found.rms_px, found.focal))

    def table(self) -> Columns:
        """Return one row a tag: its middle and the rms distance that this may be off, m."""
        x, y, z = self.tags.poses.position.T
        return Columns({'tag': self.tags.ids, 'x': x, 'y': y, 'z': z, 'stderr': self.tags.stderr})

    def save(self, path: str | Path) -> None:
        """Write TAGS.yaml; beside it TAGS.covariance.npz and, of the camera, TAGS.poses.csv."""
        found = self.mapping
        named = {'photograph': np.array(self.photographs)[found.images]}
        with write_together():
            write_tag_map(self.tags, path, 'fisheye-svp map', found.information)
            write_poses(Path(path).with_suffix('.poses.csv'), found.images, self.pose, named)


@limit_threads
def map(
    photographs: str | Path | Sequence[str | Path],
    board: str,
    lens: AnyLens,
    *,
    origin: int | None = None,
    every: int = 1,
    progress: Progress = silent,
) -> MappedTags:
    """Map tags from photographs of a walk (files, folders, videos, recordings), as the command.

    board: tags:36h11:160mm (family, side of the black square); origin: id of the tag whose frame
    is that of the map, None: the one that most images show; every: take one of so many.
    progress: called with each stage and the share that is done.
    Raises ObservationError where no image shows a tag, GeometryError where no image shows two
    together, LensError for images of another size than the lens, ParameterError for a board that
    is no tags.
    """
    given = [photographs] if isinstance(photographs, str | Path) else photographs
    paths = [str(path) for path in check_type(given, Sequence, 'photographs', 'a list of paths')]
    if not paths:
        raise ParameterError('no photographs; give at least one file or folder')
    if every < 1:
        raise ParameterError(f'every is {every}; 1 or more is needed')
    size, known = tag_size(str(board)), load_lens(lens)
    first = None if origin is None else int(check_whole_numbers(origin, 'origin'))
    progress('searching', 0.0)
    seen = find_tag_views(find_photographs(paths, every))
    check_sizes(paths[0], {'': seen.size}, {'': known})
    progress('mapping', 0.5)
    found = map_tags(ForwardModel(known), seen.image, seen.ids, seen.uv, size, first)
    covariance = tag_covariance(found.information)
    tags = map_of_size(found.ids, size, found.poses, FAMILY, covariance)
    return MappedTags(tags, found, seen.names)
