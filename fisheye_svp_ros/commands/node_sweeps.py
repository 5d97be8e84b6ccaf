"""Sweep files, and the node graph in lock-step through one: each set waits for its solvers."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from fisheye_svp_ros.commands.notes import say
from fisheye_svp_ros.commands.processes import Processes
from fisheye_svp_ros.errors import FisheyeSvpError, ParameterError
from fisheye_svp_ros.io.parameters import SWEEP, node_parameters, read_parameter_file, rows
from fisheye_svp_ros.study.sweep import CAMERA, TABLES, Plan, idle_solvers, plan_sweep

_PATIENCE = 3600.0  # s, of a solver for the other topics of a set: nothing is lost in lock-step


def read_sweep(path: Path) -> Plan:
    """Return the sweep of a parameter file; raise ParameterError, naming it, for any fault."""
    try:
        given = read_parameter_file(path)
        space = namespace_of(given)
        for pattern, values in given.items():
            _check_names(pattern, values, space)
        plan = plan_sweep({node: node_parameters(f'{space}/{node}', given) for node in TABLES})
        # A pattern such as /** means those that there are; a name means that node.
        named = [node for node in TABLES if f'{space}/{node}' in given]
        for sentence in idle_solvers(plan, named):
            say(f'{path}: {sentence}')
        return plan
    except FisheyeSvpError as error:
        text = ' '.join(str(error).split())
        raise ParameterError(text if str(path) in text else f'{path}: {text}') from error


def namespace_of(given: Iterable[str]) -> str:
    """Return the namespace of the nodes that a parameter file names; '' for none.

    Raises ParameterError for several.
    """
    places = [name.rpartition('/') for name in given if '*' not in name]
    spaces = {space for space, _, node in places if node in TABLES}
    if len(spaces) > 1:
        names = ', '.join(sorted(space or '/' for space in spaces))
        raise ParameterError(f'nodes of the namespaces {names}; a sweep has those of one')
    return spaces.pop() if spaces else ''


def lens_folder(plan: Plan) -> str:
    """Return the folder that the lens files of a sweep lie below; empty where it names none."""
    names = [plan.base.lens, *plan.sweep.lists.get('lens', ())]
    folders = [
        str(Path(name).resolve().parent)
        for name in names
        if Path(name).suffix in ('.yaml', '.yml')
    ]
    return os.path.commonpath(folders) if folders else ''


def _check_names(pattern: str, values: Mapping[str, Any], space: str) -> None:
    """Refuse what means nothing to any node; the nodes themselves would only warn."""
    nodes = [node for node in TABLES if node_parameters(f'{space}/{node}', {pattern: values})]
    if values and not nodes:
        raise ParameterError(
            f'{pattern} is not a node of a sweep; choose from {", ".join(TABLES)}'
        )
    known = {row.name for node in nodes for row in rows(TABLES[node])}
    for name in values:
        swept = name.startswith(SWEEP) and CAMERA in nodes  # the camera's own table says more
        if name.startswith(SWEEP) and not swept:
            raise ParameterError(
                f'{name}: only parameters of {CAMERA} can be swept, below its '
                f'name; {", ".join(nodes)} takes one value of each of its own'
            )
        if name not in known and not swept:
            raise ParameterError(
                f'{name} is not a parameter of {", ".join(nodes)}; choose from '
                + ', '.join(sorted(known))
            )


def values(**parameters: Any) -> list[str]:
    """Return parameters as ROS arguments."""
    return [word for name, value in parameters.items() for word in ('-p', f'{name}:={value}')]


def start_in_step(
    processes: Processes,
    camera: str,
    solvers: Sequence[str],
    common: Sequence[str],
    scenarios: Sequence[str] = (),
    folder: str = '',
) -> None:
    """Start solver nodes and a synthetic camera, `camera` by name, that ends after its sweep.

    common: ROS arguments of all nodes; scenarios: of the camera; folder: below which its lens
    files lie.  All wait for a recorder, and
    solvers for the camera, which listens to what they answer.
    """
    for node in solvers:
        processes.start(
            node,
            [
                'run',
                node,
                '--ros-args',
                *common,
                *values(
                    wait_for_subscribers=2,
                    patience=_PATIENCE,
                    **({'folder': folder} if folder else {}),
                ),
            ],
        )
    processes.start(
        camera,
        [
            'run',
            'synthetic_camera',
            '--ros-args',
            *common,
            *scenarios,
            *values(
                wait_for_subscribers=len(solvers) + 1,
                repeat='false',
                lock_step=' '.join(f'{node}/result' for node in solvers),
            ),
        ],
    )


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
        space = namespace_of(read_parameter_file(path))
        common = ['--params-file', str(path), *(['-r', f'__ns:={space}'] if space else [])]
        start_in_step(processes, 'camera', solvers, common, folder=lens_folder(plan))
        processes.wait(['camera'], math.inf, look)
        processes.stop('recorder')
        for node in solvers:
            processes.stop(node)
