"""Pictures of runs of one kind of node beside each other: before and after a change."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fisheye_svp_ros.io.recording_table import STAMP
from fisheye_svp_ros.reporting.plots import picture

_SHOWN = {
    'position_error_m': (1e3, 'position error / mm'),
    'axis_error_rad': (180 / np.pi, 'axis error / deg'),
    'rms_px': (1.0, 'rms residual / px'),
}


def draw_runs(columns: Mapping[str, Sequence[Any]], path: Path) -> list[Path]:
    """Draw over time the errors that several localizers publish, from a tabulated recording.

    Returns the file; none where there are no two localizers to compare.
    """
    posed = [c.rpartition('.')[0] for c in columns if c.endswith('.axis_error_rad')]
    localizers = [name for name in posed if f'{name}.views' not in columns]  # no calibrator
    runs = {
        name: found for name in _SHOWN
        if len(found := [c for n in localizers if (c := f'{n}.{name}') in columns]) > 1
    }
    if not runs or STAMP not in columns:
        return []
    stamp = np.array(columns[STAMP], dtype=float) / 1e9
    with picture(path, 9.2, 0.8 + 2.1 * len(runs)) as figure:
        axes = figure.subplots(len(runs), 1, sharex=True, squeeze=False)[:, 0]
        for axis, (name, nodes) in zip(axes, runs.items(), strict=True):
            factor, label = _SHOWN[name]
            for node in nodes:
                values = factor * np.array(columns[node], dtype=float)
                mean = float(np.nanmean(values))
                axis.plot(stamp - stamp.min(), values, 'o-', ms=3, lw=1,
                          label=f'{node.rpartition(".")[0]}, mean {mean:.3g}')
            axis.set(ylabel=label, ylim=(0, None))
            axis.legend(loc='lower right', bbox_to_anchor=(1, 1), ncols=len(nodes), fontsize=8)
        axes[-1].set_xlabel('time / s')
    return [path]
