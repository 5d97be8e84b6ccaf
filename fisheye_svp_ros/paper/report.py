"""The report on the paper: pictures, Markdown, HTML and paper.json."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

from fisheye_svp_ros.io.results import write_json
from fisheye_svp_ros.paper.beyond_figures import draw_crossings, draw_solvers
from fisheye_svp_ros.paper.document import document
from fisheye_svp_ros.paper.figures import (
    draw_calibration_poses,
    draw_height,
    draw_localization,
    draw_rigs,
    draw_shift,
)
from fisheye_svp_ros.paper.results import Results
from fisheye_svp_ros.paper.sections import sections
from fisheye_svp_ros.paper.stereo_figures import draw_stereo
from fisheye_svp_ros.paper.tables import PANELS
from fisheye_svp_ros.reporting.blocks import write_blocks

Drawing = tuple[Callable[..., None], tuple[Any, ...]]


def write_report(results: Results, folder: Path, executor: Executor) -> list[Path]:
    """Write everything into a folder, pictures by the executor; return the files.

    Raises OutputError where one cannot be written.
    """
    pictures = {
        folder / f'{name}.png': executor.submit(draw, folder / f'{name}.png', *arguments)
        for name, (draw, arguments) in _drawings(results).items()
    }
    for drawn in pictures.values():
        drawn.result()
    write_json(folder / 'paper.json', document(results))
    return [folder / 'paper.json', *write_blocks(folder, 'paper', sections(results)), *pictures]


def _drawings(results: Results) -> dict[str, Drawing]:
    """The slowest first, so that workers end together."""
    panels = results.panels()
    half = len(PANELS)
    return {
        'figure6': (draw_localization, (results.svp,)),
        'figure9': (draw_stereo, (results.svp['fish180'], panels[:half])),
        'figure10': (draw_stereo, (results.svp['fish214'], panels[half:])),
        'noise': (draw_crossings, (results.crossings,)),
        'solvers': (draw_solvers, (results.found,)),
        'figure4': (draw_shift, (results.lenses, results.family)),
        'figure5': (draw_height, (results.lenses,)),
        'figure7': (draw_rigs, ()),
        'figure8': (draw_calibration_poses, ()),
    }
