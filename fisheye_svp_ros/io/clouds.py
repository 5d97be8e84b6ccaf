"""sensor_msgs/PointCloud2 as structured arrays; knows the layout, not ROS.

Messages come as rclpy or a bag reader made them: only attributes count.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.errors import ObservationError

Points = NDArray[np.void]

LANDMARKS = np.dtype([('landmark', '<u4'), ('x', '<f8'), ('y', '<f8'), ('z', '<f8')])
IMAGE_POINTS = np.dtype([('landmark', '<u4'), ('u', '<f8'), ('v', '<f8')])
RESIDUALS = np.dtype([
    *IMAGE_POINTS.descr, ('du', '<f8'), ('dv', '<f8'), ('theta', '<f8'), ('range', '<f8')
])

MAX_VALUE = 1e12  # m or px; squares and products of anything larger are soon no numbers
_MAX_POINT_BYTES = 1 << 16  # bytes of a point
_MOST_FIELDS = 100

# sensor_msgs/PointField: datatype numbers.
DATATYPES = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}
_NUMBER_KINDS = {'u': ('iu', 'a whole number'), 'f': ('f', 'a floating-point number')}


def structured_array(layout: np.dtype[np.void], landmark: Index, *columns: Array) -> Points:
    """Return an array (N,) of `layout` from ids (N,) and its other fields, each (N,)."""
    points = np.empty(len(landmark), dtype=layout)
    for name, values in zip(layout.names or (), (landmark, *columns), strict=True):
        points[name] = values
    return points


def unpack(cloud: Any, layout: np.dtype[np.void], what: str) -> Points:
    """Return the points (N,) of a PointCloud2 as `layout`, whatever their order and widths.

    what: topic or file, for the error.  Raises ObservationError where a field is missing, of the
    wrong kind, not finite, or where a landmark stands twice.
    """
    raw = _raw_points(cloud, what)
    points = np.empty(raw.shape, dtype=layout)
    for name in layout.names or ():
        if name not in (raw.dtype.names or ()):
            needed = ', '.join(layout.names or ())
            raise ObservationError(f'{what}: field {name!r} is missing; needed are {needed}')
        kinds, kind = _NUMBER_KINDS[layout[name].kind]
        if raw.dtype[name].kind not in kinds:
            given = raw.dtype[name]
            raise ObservationError(f'{what}: field {name!r} is {given}; {kind} is needed')
        usable = _representable(raw[name], layout[name])
        if not usable.all():
            bad = int(np.argmin(usable))
            raise ObservationError(
                f'{what}: field {name!r} of point {bad} is {raw[name][bad]}; leave out '
                f'points without a value, or beyond {MAX_VALUE:g}'
            )
        points[name] = raw[name]
    if len(set(points['landmark'].tolist())) < len(points):
        ids, counts = np.unique(points['landmark'], return_counts=True)
        raise ObservationError(f'{what}: landmark {ids[counts > 1][0]} is listed twice')
    return points


def _representable(values: NDArray[Any], kind: np.dtype[Any]) -> NDArray[np.bool_]:
    if kind.kind == 'f':
        return np.asarray(np.abs(values) <= MAX_VALUE)  # not so for NaN
    if values.dtype == kind:
        return np.ones(values.shape, dtype=bool)
    return np.asarray((values >= 0) & (values <= np.iinfo(kind).max))


def _raw_points(cloud: Any, what: str) -> Points:
    step, count = int(cloud.point_step), int(cloud.width) * int(cloud.height)
    if step > _MAX_POINT_BYTES or len(cloud.fields) > _MOST_FIELDS:
        raise ObservationError(
            f'{what}: {len(cloud.fields)} fields in a point of {step} bytes; at most '
            f'{_MOST_FIELDS} in {_MAX_POINT_BYTES} are read'
        )
    fields = tuple((f.name, int(f.offset), int(f.datatype), int(f.count)) for f in cloud.fields)
    layout = _layout(fields, step, bool(cloud.is_bigendian), what)
    data, row_step = cloud.data, int(cloud.row_step)
    if row_step > step * cloud.width and len(data) == row_step * cloud.height > 0:
        rows = np.frombuffer(data, np.uint8).reshape(cloud.height, row_step)
        data = rows[:, :step * cloud.width].tobytes()  # without the padding of the rows
    if len(data) != step * count:
        raise ObservationError(
            f'{what}: {len(cloud.data)} bytes of data do not hold {count} points of {step} bytes'
        )
    return np.frombuffer(data, dtype=layout) if count else np.empty(0, dtype=layout)


@lru_cache(maxsize=64)
def _layout(
    fields: tuple[tuple[str, int, int, int], ...], step: int, big: bool, what: str
) -> np.dtype[np.void]:
    """Return the layout of one point; fields: name, offset, datatype and count."""
    names, formats, offsets = [], [], []
    for name, offset, datatype, count in fields:
        size = np.dtype(DATATYPES.get(datatype, 'V0')).itemsize
        if not size or count != 1 or offset + size > step or name in names:
            raise ObservationError(
                f'{what}: field {name!r} has an impossible type, count or offset'
            )
        names.append(name)
        formats.append(('>' if big else '<') + DATATYPES[datatype])
        offsets.append(offset)
    return np.dtype(
        {'names': names, 'formats': formats, 'offsets': offsets, 'itemsize': max(step, 1)}
    )
