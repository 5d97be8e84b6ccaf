"""Lenses of every pair of curves, and points that they see."""

from dataclasses import replace

import numpy as np
import pytest

from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.optics.curves import (
    Equidistant,
    Equisolid,
    FlatPort,
    Gennery,
    KannalaBrandt,
    Orthographic,
    Perspective,
    Stereographic,
)
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.optics.pinhole import BrownConrady, RationalPolynomial
from helpers import high_precision

KITA = [load_lens(lens_path(name)) for name in ('fish180', 'fish214')]
HEIGHTS = {
    'orthographic': (Orthographic(), 90.0),
    'equidistant': (Equidistant(), 107.0),
    'equisolid': (Equisolid(), 107.0),
    'stereographic': (Stereographic(), 120.0),
    'perspective': (Perspective(), 68.0),
    'kannala_brandt': (KannalaBrandt(-0.02, 0.004, -0.003, 0.0004), 100.0),
    'brown_conrady': (BrownConrady(-0.28, 0.09, -0.004), 55.0),
    'rational_polynomial': (RationalPolynomial(0.3, 0.02, 0.001, 0.5, 0.03, 0.002), 70.0),
}
SHIFTS = {
    'svp': None,
    'gennery': Gennery(-0.002, 0.011, 0.006, -0.0007),
    'receding': Gennery(0.003, -0.006, -0.002, 0.0004),
    'flat_port': FlatPort(0.02, 1.5),
}
STEPS = {
    'k1': 1e-2,
    'k2': 1e-2,
    'k3': 1e-2,
    'k4': 1e-2,
    'k5': 1e-3,
    'k6': 1e-4,
    's0': 1e-4,
    'e0': 1e-4,
    'e1': 1e-4,
    'e2': 2e-5,
    'thickness': 1e-3,
    'refractive_index': 1e-2,
}


def make_lens(height, shift):
    curve, degrees = HEIGHTS[height]
    if shift == 'flat_port':
        degrees = min(degrees, 90.0)
    return Lens(
        'lens', 1200, 1000, 381.0, 379.5, 598.3, 501.7, curve, np.radians(degrees), SHIFTS[shift]
    )


LENSES = [pytest.param(make_lens(h, s), id=f'{h}-{s}') for h in HEIGHTS for s in SHIFTS]


def points_on_rays(lens, rng, count, nearest=0.05, farthest=3.0, edge=1.0):
    """Points that lie on rays of the lens: angles up to the edge of the field, log distances."""
    theta = rng.uniform(0.0, edge * lens.max_incidence, count)
    azimuth = rng.uniform(-np.pi, np.pi, count)
    distance = np.exp(rng.uniform(np.log(nearest), np.log(farthest), count))
    return place(lens, theta, azimuth, distance)


def place(lens, theta, azimuth, distance):
    shift = np.asarray(high_precision.shift(lens, theta, np))
    across = distance * np.sin(theta)
    return np.stack(
        [across * np.cos(azimuth), across * np.sin(azimuth), distance * np.cos(theta) + shift],
        axis=-1,
    )


def points_around(rng, count, nearest, farthest, widest):
    """Points anywhere: within `widest` degrees of the axis as seen from the camera's origin."""
    theta = np.radians(rng.uniform(0.0, widest, count))
    azimuth = rng.uniform(-np.pi, np.pi, count)
    distance = rng.uniform(nearest, farthest, count)
    return distance[:, None] * np.stack(
        [np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)], axis=-1
    )


# A fisheye lens of four coefficients, and of two with a moving viewpoint, to be written to files.
FRONT = Lens(
    'front',
    848,
    800,
    285.2,
    284.9,
    424.3,
    398.7,
    KannalaBrandt(-0.011, 0.0041, -0.0012, 0.0001),
    np.radians(95.0),
)
SHORT = replace(
    FRONT,
    image_height=KannalaBrandt(-0.011, 0.0041),
    viewpoint_shift=Gennery(0.0, 0.004, 0.001, -0.0002),
)
