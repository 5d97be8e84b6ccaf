"""The node graph in lock-step: a camera whose every set waits for what the solvers say."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from fisheye_svp_ros.commands.processes import Processes
from fisheye_svp_ros.commands.sweep_file import lens_folder
from fisheye_svp_ros.study.sweep import Plan

_PATIENCE = 3600.0  # s, of a solver for the other topics of a set: nothing is lost in lock-step


def values(**parameters: Any) -> list[str]:
    """Return parameters as ROS arguments."""
    return [word for name, value in parameters.items() for word in ('-p', f'{name}:={value}')]


def start_in_step(
    processes: Processes, camera: str, solvers: Sequence[str], common: Sequence[str],
    scenarios: Sequence[str] = (), folder: str = '',
) -> None:
    """Start solver nodes and a synthetic camera, `camera` by name, that ends after its sweep.

    common: ROS arguments of all nodes; scenarios: of the camera; folder: below which its lens
    files lie.  All wait for a recorder, and
    solvers for the camera, which listens to what they answer.
    """
    for node in solvers:
        processes.start(node, ['run', node, '--ros-args', *common,
                               *values(wait_for_subscribers=2, patience=_PATIENCE,
                                       **({'folder': folder} if folder else {}))])
    processes.start(camera, [
        'run', 'synthetic_camera', '--ros-args', *common, *scenarios, *values(
            wait_for_subscribers=len(solvers) + 1, repeat='false',
            lock_step=' '.join(f'{node}/result' for node in solvers),
        )
    ])


def record_sweep(
    path: Path, plan: Plan, bag: Path, logs: Path, advance: Callable[[int], None]
) -> None:
    """Run the node graph through a sweep file into a new recording.

    advance: told how many more scenarios the camera has reached.
    Raises GraphError where a process does not end well.
    """
    reached, solvers = 0, tuple(plan.solvers)

    def look() -> None:
        nonlocal reached
        told = re.findall(r'scenario (\d+) of', processes.log_tail('camera'))
        if told and int(told[-1]) > reached:
            advance(int(told[-1]) - reached)
            reached = int(told[-1])

    with Processes(logs) as processes:
        processes.start('recorder', ['record', '-o', str(bag)])
        start_in_step(processes, 'camera', solvers, ['--params-file', str(path)],
                      folder=lens_folder(plan))
        processes.wait(['camera'], math.inf, look)
        processes.stop('recorder')
        for node in solvers:
            processes.stop(node)
