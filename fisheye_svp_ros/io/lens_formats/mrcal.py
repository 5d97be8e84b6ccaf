"""mrcal .cameramodel files: CAHVORE, which has a viewpoint shift, STEREOGRAPHIC, splined, OPENCV.

mrcal has no model of Kannala and Brandt.  A lens of one viewpoint is a splined model where CAHVORE
does not hold it.  Its CAHVORE (Gennery, IJCV 2006) solves the equation of this package; its image
height is f (1 + r0 + r1 c^2 + r2 c^4) c, where c is theta for a linearity of 0, tan(l theta) / l
above and sin(l theta) / l below.

LENSMODEL_SPLINED_STEREOGRAPHIC is a stereographic lens with an image field: q = f (w + d(w)) + c,
where w = 2 tan(theta / 2) (cos phi, sin phi) and d is a tensor product of uniform cubic B-splines:
that of `optics.image_field`, over the focal length.  Source: documentation of mrcal 2.2.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.forward import back_project_corrected
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.lens_formats import Foreign, models
from fisheye_svp_ros.optics.curves import Gennery, Stereographic
from fisheye_svp_ros.optics.image_field import MAX_NODES, MIN_NODES, ImageField
from fisheye_svp_ros.optics.lens import Lens

recognises = re.compile('[\'"]LENSMODEL_').search
_LINEARITY = re.compile(
    r'LENSMODEL_CAHVORE_linearity=([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)$'
)
# Those of cv2.calibrateCamera, and how many coefficients follow fx, fy, cx and cy
_PERSPECTIVE = {'LENSMODEL_PINHOLE': 0} | {f'LENSMODEL_OPENCV{n}': n for n in (4, 5, 8)}
_STEREOGRAPHIC = 'LENSMODEL_STEREOGRAPHIC'
_COUNTS = {_STEREOGRAPHIC: 4} | {name: 4 + n for name, n in _PERSPECTIVE.items()}
_OF_CAHVORE = 12
_MOST_TOKENS = 100_000
_AXIS = 1e-9  # rad, of CAHVORE's axis off the image's
_TERMS, _GRID, _TOLERANCE = 3, 400, 0.01  # radial terms, angles, px
_SPLINED_MODEL = 'LENSMODEL_SPLINED_STEREOGRAPHIC'
_CONFIGURATION = re.compile(_SPLINED_MODEL + r'_order=(\d+)_Nx=(\d+)_Ny=(\d+)_fov_x_deg=(\d+)$')
_MARGIN_NODES = 3  # nodes that lie outside the field, along an axis
_NODES = (24, 36, 54, 80)  # along x that are tried
_SAMPLES = 4  # along each axis for a node
_RIDGE = 1e-11  # of the weight of a sample: for nodes that none calls for


def read(text: str, where: str) -> Foreign:
    """Read the lens; raises LensError for a model that is no fisheye's, or is incomplete."""
    if sum(map(text.count, ',[({+-*~')) > _MOST_TOKENS:
        raise LensError(f'{where}: more than {_MOST_TOKENS} values; no .cameramodel has these')
    try:
        document = ast.literal_eval(text.strip())
        model = str(document.get('lensmodel', document.get('lens_model')))
        values = [float(value) for value in document['intrinsics']]
        size = [int(value) for value in document['imagersize']]
    except (
        AttributeError,
        LookupError,
        SyntaxError,
        TypeError,
        ValueError,
        MemoryError,
        RecursionError,
        OverflowError,
    ) as cause:
        raise LensError(f'{where}: not a whole .cameramodel ({cause})'.splitlines()[0]) from cause
    match = _LINEARITY.match(model)
    needed = _OF_CAHVORE if match else _COUNTS.get(model, len(values))
    if len(values) != needed:
        raise LensError(f'{where}: intrinsics has {len(values)} values; {model} needs {needed}')
    if model == _STEREOGRAPHIC:
        return _read_stereographic(size, values, where)
    if model.startswith(_SPLINED_MODEL):
        lens = _read_splined(model, values, size, where)
        return Foreign('mrcal', {'camera': lens}, (), {})
    if model in _PERSPECTIVE:
        return Foreign.from_lenses(
            'mrcal',
            {
                'camera': models.nearest_lens(
                    'camera', size, values[:4], models.opencv_distortion(values[4:]), where
                )
            },
        )
    if match is None:
        raise LensError(
            f'{where}: lensmodel is {model}; CAHVORE with its linearity, '
            'STEREOGRAPHIC, SPLINED_STEREOGRAPHIC, PINHOLE and OPENCV4 to 8 can be '
            'read'
        )
    if max(map(abs, values[4:6])) > _AXIS:
        raise LensError(
            f'{where}: the axis of its CAHVORE is not square to the image (alpha, '
            'beta); that is not supported'
        )
    linearity, r = float(match[1]), values[6:9]

    def curve(theta: Array) -> Array:
        c = _chi(theta, linearity)
        return np.asarray(c * (1 + r[0] + r[1] * c**2 + r[2] * c**4))

    shift = Gennery(0.0, *values[9:12]) if any(values[9:12]) else None
    limit = np.pi / 2 / abs(linearity) * (1 - 1e-3) if abs(linearity) > 0.5 else np.pi * 0.999
    return Foreign.from_lenses(
        'mrcal',
        {'camera': models.fit_curve('camera', size, values[:4], curve, limit, where, shift)},
    )


def _chi(theta: Array, linearity: float) -> Array:
    if abs(linearity) < 1e-12:
        return theta
    form = np.tan if linearity > 0 else np.sin
    return np.asarray(form(linearity * theta) / linearity)


def _read_stereographic(size: list[int], values: list[float], where: str) -> Foreign:
    value = Stereographic().value_and_slope
    lens, _ = models.fit_curve(
        'camera', size, values, lambda theta: value(theta)[0], np.pi * 0.9, where
    )
    lens = replace(lens, fx=values[0], fy=values[1], image_height=Stereographic())
    return Foreign('mrcal', {'camera': lens}, (), {})


def write(lens: Lens) -> str:
    """Return the lens as CAHVORE of linearity 0, its shift included.

    A curve that three radial terms do not say is the nearest one.  Without a shift, and with an
    image field or a curve that they do not say to a hundredth of a pixel, it is a splined model.
    """
    theta = np.linspace(0.0, lens.max_incidence, _GRID)[1:]
    heights = lens.image_height.value_and_slope(theta)[0]
    powers = theta[:, None] ** np.arange(1, 2 * _TERMS, 2)
    terms = np.linalg.lstsq(powers, heights, rcond=None)[0]
    worst = float(np.abs(powers @ terms - heights).max() * max(lens.fx, lens.fy))
    # Of a lens with a shift that CAHVORE has not, the curve is written.
    shift = lens.viewpoint_shift if isinstance(lens.viewpoint_shift, Gennery) else None
    if shift is None and (lens.image_field is not None or worst > _TOLERANCE):
        return _model_text(*_fit_splined_model(lens), (0.0, 0.0, 0.0), lens)
    e = [shift.e0, shift.e1, shift.e2] if shift is not None else [0.0] * 3
    intrinsics = [
        lens.fx,
        lens.fy,
        lens.cx,
        lens.cy,
        0.0,
        0.0,
        float(terms[0]) - 1,
        *map(float, terms[1:]),
        *e,
    ]
    # A constant part of the shift is where the camera stands.
    place = (0.0, 0.0, -shift.s0 if shift is not None else 0.0)
    return _model_text('LENSMODEL_CAHVORE_linearity=0', intrinsics, place, lens)


def _model_text(model: str, intrinsics: list[float], place: tuple[float, ...], lens: Lens) -> str:
    return (
        '{\n'
        + ''.join(
            f'    {key!r}: {value!r},\n'
            for key, value in (
                ('lensmodel', model),
                ('intrinsics', intrinsics),
                ('extrinsics', [0.0, 0.0, 0.0, *place]),
                ('imagersize', [lens.width, lens.height]),
            )
        )
        + '}\n'
    )


def _read_splined(model: str, values: Sequence[float], size: Sequence[int], where: str) -> Lens:
    """Return the lens; raise LensError, naming `where`, for one that is incomplete."""
    match = _CONFIGURATION.match(model)
    if match is None or match[1] != '3':
        raise LensError(f'{where}: {model} cannot be read; its splines must be of order 3')
    columns, rows, degrees = (int(match[i]) for i in (2, 3, 4))
    if not (
        min(rows, columns) >= MIN_NODES
        and max(rows, columns) <= MAX_NODES
        and 0 < degrees < 360
        and len(values) == 4 + 2 * rows * columns
    ):
        raise LensError(
            f'{where}: {model} with {len(values)} values; it needs {4 + 2 * rows * columns}'
        )
    focal, center = np.array(values[:2]), np.array(values[2:4])
    pitch = focal * _spacing(columns, degrees)
    low = center - pitch * (np.array([columns, rows]) - 1) / 2
    field = ImageField(low, pitch, focal * np.reshape(values[4:], (rows, columns, 2)))
    # The spline holds between the second node and the last but one.
    steps = (np.arange(1.0, count - 1.75, 0.25) for count in (columns, rows))
    ideal = low + pitch * np.stack(np.meshgrid(*steps), axis=-1)
    shown = (np.abs(field.apply(ideal) + 0.5 - np.array(size) / 2) <= np.array(size) / 2).all(
        axis=-1
    )
    if not shown.any():
        raise LensError(f'{where}: {model}: no point of it is in the image')
    reach = np.linalg.norm((ideal[shown] - center) / focal, axis=-1).max()
    theta = float(Stereographic().angle(np.asarray(reach)))
    fx, fy, cx, cy = values[:4]
    lens = Lens(
        'camera', size[0], size[1], fx, fy, cx, cy, Stereographic(), theta, image_field=field
    )
    if wrong := lens.check():
        raise LensError(f'{where}: {wrong}')
    return lens


def _fit_splined_model(lens: Lens) -> tuple[str, list[float]]:
    """Return model and intrinsics of the nearest splined lens; raise LensError above 0.01 px."""
    worst = np.inf
    for columns in _NODES:
        model, field, worst = _fit_nodes(replace(lens, target={}), columns)
        if worst < _TOLERANCE:
            focal = [lens.fx, lens.fy]
            return model, [*focal, lens.cx, lens.cy, *(field.values / focal).ravel().tolist()]
    raise LensError(
        f'lens {lens.name!r}: its image is {worst:.2g} px from any splined model of '
        f'{_NODES[-1]} nodes'
    )


def _fit_nodes(lens: Lens, columns: int) -> tuple[str, ImageField, float]:
    """Return the name of a model of so many columns of nodes, its field, its worst error, px."""
    from scipy import sparse
    from scipy.sparse.linalg import splu

    count = _SAMPLES * columns
    uv = np.stack(
        np.meshgrid(np.linspace(0, lens.width - 1, count), np.linspace(0, lens.height - 1, count)),
        axis=-1,
    ).reshape(-1, 2)
    rays = back_project_corrected(lens, uv)
    uv, way = uv[rays.valid], rays.direction[rays.valid]
    # tan(theta / 2) = sin / (1 + cos)
    plane = 2 * way[:, :2] / (1 + way[:, 2:])
    edge = np.abs(plane).max(axis=0)
    degrees = int(np.ceil(np.degrees(4 * np.arctan(edge[0] / 2))))
    if degrees >= 360:
        raise LensError(
            f'lens {lens.name!r}: a splined model cannot reach its max_incidence_deg, '
            'so far behind the camera'
        )
    spacing = _spacing(columns, degrees)
    rows = int(np.ceil(2 * edge[1] / spacing)) + _MARGIN_NODES
    focal, center = np.array([lens.fx, lens.fy]), np.array([lens.cx, lens.cy])
    low = center - focal * spacing * (np.array([columns, rows]) - 1) / 2
    empty = ImageField(low, focal * spacing, np.zeros((rows, columns, 2)))
    ideal = focal * plane + center
    weight, node = empty.weights(ideal)
    design: Any = sparse.csr_array(
        (weight.ravel(), (np.repeat(np.arange(len(uv)), weight.shape[1]), node.ravel())),
        (len(uv), rows * columns),
    )
    normal = design.T @ design + _RIDGE * sparse.csr_array(sparse.eye(rows * columns))
    values: Array = splu(normal.tocsc()).solve(design.T @ (uv - ideal))
    field = replace(empty, values=values.reshape(rows, columns, 2))
    worst = float(np.linalg.norm(field.apply(ideal) - uv, axis=-1).max())
    return f'{_SPLINED_MODEL}_order=3_Nx={columns}_Ny={rows}_fov_x_deg={degrees}', field, worst


def _spacing(columns: int, degrees: float) -> float:
    """Return the distance of neighboring nodes for unit focal length."""
    return float(4 * np.tan(np.radians(degrees) / 4) / (columns - _MARGIN_NODES))
