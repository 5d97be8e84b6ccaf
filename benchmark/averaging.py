"""What averaging over a viewpoint shift is worth: `python -m benchmark.averaging --sets 120`.

Few photographs of a board that may be bent, through a Kannala-Brandt lens whose viewpoint may
move; the image points are formed by a few lines of their own. Each set is calibrated and
diagnosed; against the truth stand the lens of `calibrate`, the lens with the confirmed causes
alone, and the lens that is written. Ray error: rms angle at 0.3, 1 and 5 m over the part of the
image that was photographed, a common motion of the camera frame taken out.

Writes docs/results/averaging.md and docs/images/averaging.png.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmark.true_rays import ray_error
from benchmark.workers import in_processes
from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis import diagnose
from fisheye_svp_ros.diagnosis.stages import extended_lenses
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.optics.curves import Gennery, KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import rotation_from_vector
from fisheye_svp_ros.reporting.diagnosis_plots import AFTER, BEFORE, INK, NOISE
from fisheye_svp_ros.reporting.plots import legend_below, picture
from fisheye_svp_ros.scene.observations import Observations, make_observations
from fisheye_svp_ros.solve.lens_calibration import calibrate

WIDTH, HEIGHT = 1280, 800


class Outcome(NamedTuple):
    """Of one set: e0 as it is and as it is written, m, its stated error and its weight.

    errors: ray errors, mrad, of three lenses: of `calibrate`, with the causes alone, as written.
    """

    e0: float
    written: float
    stderr: float
    weight: float
    named: bool
    errors: tuple[float, float, float]


def draw_lens(rng: np.random.Generator) -> Lens:
    """Draw a lens; in one of three the viewpoint stands still."""
    k = rng.normal(0, [0.02, 0.008, 0.002, 0.0004])
    shift = 0.0 if rng.random() < 1 / 3 else rng.choice([-1, 1], p=[0.2, 0.8]) * abs(
        rng.normal(0, 3e-3))
    focal, (x, y) = rng.uniform(280, 380), rng.normal(0, 8, 2)
    lens = Lens('truth', WIDTH, HEIGHT, focal, focal, WIDTH / 2 + x, HEIGHT / 2 + y,
                KannalaBrandt(*k), np.radians(rng.uniform(65, 92)))
    if lens.image_height.limit < 1.1 * lens.max_incidence:
        return draw_lens(rng)
    return lens.with_shift(Gennery(0.0, shift, shift * rng.normal(0, 0.15)))


def image_points(lens: Lens, points: Array) -> tuple[Array, Array]:
    """Return image points (N, 2), px, and incidence angles (N,) of points (N, 3) by iteration."""
    e0, e1 = lens.viewpoint_shift.e0, lens.viewpoint_shift.e1  # type: ignore[union-attr]
    radius = np.hypot(*points[:, :2].T)
    theta = np.arctan2(radius, points[:, 2])
    for _ in range(60):
        shift = (theta / np.sin(theta) - 1) * (e0 + e1 * theta**2)
        theta = np.arctan2(radius, points[:, 2] - shift)
    k = lens.parameters
    height = lens.fx * sum((k[f'k{i}'] if i else 1.0) * theta ** (2 * i + 1) for i in range(5))
    return [lens.cx, lens.cy] + (height / radius)[:, None] * points[:, :2], theta


def draw_set(
    seed: int, frames: tuple[int, int] = (5, 9), warp: Callable[[Array], Array] | None = None
) -> tuple[Observations, Lens]:
    """Draw photographs of a board, and the lens that took them.

    frames: least number, and one more than the most; warp: displacements (N, 2), px, of image
    points (N, 2).
    """
    rng = np.random.default_rng(seed)
    lens, count, noise = draw_lens(rng), int(rng.integers(*frames)), rng.uniform(0.03, 0.2)
    columns, rows = int(rng.integers(7, 11)), int(rng.integers(6, 9))
    flat = rng.uniform(0.02, 0.035) * np.stack(
        [*np.meshgrid(np.arange(columns), np.arange(rows)), np.zeros((rows, columns))],
        axis=-1).reshape(-1, 3)
    flat -= flat.mean(axis=0)
    u, v = flat[:, :2].T / flat.max()
    bend = rng.normal(0, 4e-4, 3) * (rng.random() < 0.7)
    true = flat + rng.normal(0, 2.5e-5, flat.shape)
    true[:, 2] += bend @ [u * u, u * v, v * v]
    seen: list[tuple[Index, Array]] = []
    while len(seen) < count:
        turned = rotation_from_vector(np.append(rng.uniform(-0.8, 0.8, 2), rng.uniform(-0.6, 0.6)))
        angle, azimuth = rng.uniform(0, 0.75 * lens.max_incidence), rng.uniform(0, 2 * np.pi)
        axis = np.array([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth),
                         np.cos(angle)])
        toward = rotation_from_vector(angle * np.array([-np.sin(azimuth), np.cos(azimuth), 0.0]))
        facing = toward @ turned
        there = true @ facing.T + np.exp(rng.uniform(np.log(0.08), np.log(0.35))) * axis
        uv, theta = image_points(lens, there)
        kept = (theta < lens.max_incidence) & (uv > 3).all(axis=1) & (
            uv < [WIDTH - 4, HEIGHT - 4]).all(axis=1) & (np.linalg.norm(there, axis=1) > 0.04) & (
            np.abs(there @ facing[:, 2]) > 0.2 * np.linalg.norm(there, axis=1))
        if kept.sum() >= 25:
            moved = uv[kept] if warp is None else uv[kept] + warp(uv[kept])
            seen.append((np.flatnonzero(kept), moved + rng.normal(0, noise, moved.shape)))
    number = np.repeat(np.arange(count), [len(ids) for ids, _ in seen])
    ids, uv = (np.concatenate(parts) for parts in zip(*seen, strict=True))
    return make_observations(number, ids, uv, flat[ids], source=f'set {seed}'), lens


def trial(seed: int) -> Outcome:
    """Calibrate and diagnose one set."""
    table, truth = draw_set(seed)
    given = calibrate(table, 'kannala_brandt', (WIDTH, HEIGHT)).adjusted.lens
    found = diagnose(table, given, free_intrinsics=True)
    named = extended_lenses({'': given}, found.evaluation.null.linear.state, table)['']
    shift, names = found.averaged_model.shifts, [cause.effect for cause in found.causes]
    written = getattr(found.lens.viewpoint_shift, 'e0', 0.0)
    return Outcome(
        truth.viewpoint_shift.e0, written,  # type: ignore[union-attr]
        shift[0].stderr if shift else 0.0, shift[0].weight if shift else 0.0,
        'viewpoint_shift' in names,
        tuple(ray_error(lens, truth, table.uv) for lens in (given, named, found.lens)))


def report(outcomes: Sequence[Outcome], command: str) -> str:
    """Return the page: geometric means of the ray error over that of `calibrate`."""
    kinds = {
        'a shift that is not named': [one for one in outcomes if one.e0 and not one.named],
        'a shift that is named': [one for one in outcomes if one.e0 and one.named],
        'no shift': [one for one in outcomes if not one.e0], 'all': list(outcomes)}
    lines = ['# Averaging over a viewpoint shift', '', *(__doc__ or '').split('\n')[2:7], '',
             f'    {command}', '', 'Ray error over that of `calibrate`, geometric means; '
             'in brackets how many lenses are more than 10 % worse than the one given.', '',
             '| sets | number | confirmed causes alone | as written |', '|---|---|---|---|']
    for name, some in kinds.items():
        if some:
            errors = np.array([one.errors for one in some])
            ratio = errors[:, 1:] / errors[:, :1]
            cells = [f'{np.exp(np.log(one).mean()):.3f} ({(one > 1.1).sum()})' for one in ratio.T]
            lines.append(f'| {name} | {len(some)} | {" | ".join(cells)} |')
    return '\n'.join(lines) + '\n'


def draw(path: Path, outcomes: Sequence[Outcome]) -> None:
    """Draw e0 as written against the truth, and what averaging does to the ray error."""
    with picture(path, 10.5, 4.6) as figure:
        left, right = figure.subplots(1, 2)
        open_ = [one for one in outcomes if not one.named]
        for some, color, label in (
                ([one for one in outcomes if one.named], NOISE, 'named'),
                ([one for one in open_ if one.weight], AFTER, 'averaged'),
                ([one for one in open_ if not one.weight], BEFORE, 'not written')):
            left.errorbar([1e3 * one.e0 for one in some], [1e3 * one.written for one in some],
                          [1e3 * one.stderr for one in some], fmt='o', ms=4, lw=1, color=color,
                          label=label)
            before, after = (np.array([one.errors[i] for one in some]) for i in (1, 2))
            right.plot(before, after, 'o', ms=4, color=color)
        left.axline((0, 0), slope=1, color=INK, lw=0.8)
        left.set(xlabel='true e0 / mm', ylabel='e0 in the lens file / mm')
        right.axline((1, 1), slope=1, color=INK, lw=0.8)
        right.set(xscale='log', yscale='log', xlabel='ray error, confirmed causes alone / mrad',
                  ylabel='ray error of the lens file / mrad')
        legend_below(figure, left)


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw, diagnose and compare sets."""
    parser = argparse.ArgumentParser(prog='python -m benchmark.averaging')
    parser.add_argument('--sets', type=int, default=120)
    parser.add_argument('--workers', type=int, default=os.cpu_count(), help='processes')
    parser.add_argument('-o', '--output', type=Path, default=Path('docs'), help='directory')
    asked = parser.parse_args(arguments)
    outcomes = in_processes('averaging', trial, range(asked.sets), asked.workers)
    page = report(outcomes, f'python -m benchmark.averaging --sets {asked.sets}')
    write_text(asked.output / 'results' / 'averaging.md', page)
    draw(asked.output / 'images' / 'averaging.png', outcomes)
    sys.stdout.write(page)


if __name__ == '__main__':
    main()
