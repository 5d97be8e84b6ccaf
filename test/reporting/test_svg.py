"""Panels of SVG: what is drawn stands where the numbers on the axes say, whole and once."""

from __future__ import annotations

import base64
import re
from itertools import pairwise
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.reporting.style import error_levels, tick_places
from fisheye_svp_ros.reporting.svg import Axis, Panel

SVG = '{http://www.w3.org/2000/svg}'
COLORS = ['#ff0000', '#00ff00', '#0000ff']


def parsed(panel: Panel) -> ElementTree.Element:
    """Return a panel as a browser reads it."""
    return ElementTree.fromstring(panel.to_svg().replace('<svg ', f'<svg xmlns="{SVG[1:-1]}" ', 1))


def path_places(panel: Panel) -> Array:
    """Return the places (N, 2) of the last path inside the axes."""
    path = parsed(panel).findall(f'{SVG}svg/{SVG}path')[-1].attrib['d']
    numbers = [part.split() for part in re.findall(r'[ML](-?\d+ -?\d+)', path)]
    return np.array(numbers, dtype=float)


def number_places(panel: Panel, anchor: str) -> dict[float, tuple[float, float]]:
    """Return where the numbers of an axis stand."""
    return {
        float(text.text.replace('−', '-')): (float(text.attrib['x']), float(text.attrib['y']))
        for text in parsed(panel).iter(f'{SVG}text')
        if text.attrib['text-anchor'] == anchor
        and text.text
        and re.fullmatch(r'[−.\de-]+', text.text)
    }


@pytest.mark.parametrize(
    ('x', 'y'), [((-0.5, 639.5), (479.5, -0.5)), ((0.0, 97.3), (-1.2e-3, 2e-3))]
)
def test_points_stand_where_the_numbers_say(
    x: tuple[float, float], y: tuple[float, float]
) -> None:
    panel = Panel('points', Axis('x', *x), Axis('y', *y), 0.75)
    across, up = (number_places(panel, anchor) for anchor in ('middle', 'end'))
    assert min(len(across), len(up)) >= 3
    box = parsed(panel).find(f'{SVG}svg')
    assert box is not None
    left, above = float(box.attrib['x']), float(box.attrib['y'])
    places = np.array([(a, b) for a in across for b in up])
    panel.line(places, 'red')
    drawn = path_places(panel) + np.array([left, above])
    expected = [(across[a][0], up[b][1] - 45) for a, b in places.tolist()]
    np.testing.assert_allclose(drawn, expected, atol=1.1)


def test_points_that_fall_on_one_another_are_drawn_once() -> None:
    panel = Panel('points', Axis('x', 0.0, 1.0), Axis('y', 0.0, 1.0))
    panel.dots(np.tile([[0.2, 0.5], [0.7, 0.1]], (500, 1)), 'red')
    assert len(path_places(panel)) == 2


def test_arrows_lead_from_their_points_along_their_steps() -> None:
    panel = Panel('arrows', Axis('x', 0.0, 100.0), Axis('y', 100.0, 0.0), 1.0)
    start, step = np.array([[20.0, 30.0], [60.0, 70.0]]), np.array([[10.0, 0.0], [0.0, -20.0]])
    panel.arrows(start, step, 'red', 1.0)
    ends = path_places(panel).reshape(2, -1, 2)
    unit = panel.size[0] / 100
    np.testing.assert_allclose(ends[:, 0], unit * start, atol=1)
    np.testing.assert_allclose(ends[:, 1], unit * (start + step), atol=1)


def test_bars_stand_on_zero_under_the_names_of_frames() -> None:
    names = [(0.0, '<1>.jpg'), (1.0, 'a name of a photograph.jpg')]
    panel = Panel('frames', Axis('', -0.6, 1.6, names), Axis('rms / px', 0.0, 2.0))
    panel.bars(np.array([1.0, 2.0]), 'red')
    path = parsed(panel).findall(f'{SVG}svg/{SVG}path')[-1].attrib['d']
    tops, feet = (re.findall(pattern, path) for pattern in (r'M\d+ (\d+)', r'V(\d+)'))
    height = panel.size[1]
    assert [int(top) for top in tops] == [height // 2, 0] and set(feet) == {str(height)}
    shown = {text.text: text.attrib for text in parsed(panel).iter(f'{SVG}text')}
    for _, name in names:
        assert 'rotate(-90' in shown[name]['transform']
    total = float(parsed(panel).attrib['viewBox'].split()[-1])
    assert total - float(shown[names[1][1]]['y']) > 60 * len(names[1][1])


def test_a_map_has_the_colors_of_its_levels_and_nothing_where_nothing_is_known() -> None:
    values = np.repeat([[0.5, 1.5, 2.5]], 3, axis=0)
    values[0, 0] = np.nan
    panel = Panel('map', Axis('u', 0.0, 2.0), Axis('v', 2.0, 0.0), 1.0)
    panel.map(values, [1.0, 2.0], COLORS)
    image = parsed(panel).find(f'{SVG}svg/{SVG}image')
    assert image is not None
    data = base64.b64decode(image.attrib['href'].partition(',')[2])
    drawn = np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED))
    size, last = np.array(drawn.shape[:2]) // 10 * 10, -1
    assert tuple(size) == tuple(np.array(panel.size[::-1]) // 100 * 10)
    assert drawn[last, 0].tolist() == [0, 0, 255, 255]  # blue, green, red, opaque
    assert drawn[last, drawn.shape[1] // 2].tolist() == [0, 255, 0, 255]
    assert drawn[last, last].tolist() == [255, 0, 0, 255]
    assert drawn[0, 0, 3] == 0 and drawn[0, last, 3] == 255


@pytest.mark.parametrize('scale', [1e-6, 1.0, 3e5])
def test_ticks_are_round_and_inside(scale: float) -> None:
    for low, high in ((0.0, 1.0), (-0.5, 1279.5), (-1.03, 1.41), (3.0, 3.2)):
        places = np.array(tick_places(scale * low, scale * high, 6))
        assert 3 <= len(places) <= 7 and np.ptp(np.diff(places)) < 1e-9 * scale * high
        assert places[0] >= scale * low - 1e-9 * scale
        assert places[-1] <= scale * high * (1 + 1e-9)


@pytest.mark.parametrize(('low', 'high'), [(1e-5, 1e-5), (2e-1, 300.0), (1e-6, 1e3)])
def test_levels_begin_below_what_is_least_and_are_few(low: float, high: float) -> None:
    levels = error_levels(np.geomspace(low, high, 1000))
    assert 2 <= len(levels) <= 9 and levels[0] <= low * 1.2
    assert all(1.9 < b / a < 2.6 for a, b in pairwise(levels))
