"""Sweep files: ROS parameter files for the nodes of a sweep."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fisheye_svp_ros.commands.notes import say
from fisheye_svp_ros.errors import FisheyeSvpError, ParameterError
from fisheye_svp_ros.io.parameter_files import parameters_of, read_parameter_file
from fisheye_svp_ros.io.parameters import SWEEP, rows
from fisheye_svp_ros.study.sweep import CAMERA, TABLES, Plan, idle_solvers, plan_sweep


def read_sweep(path: Path) -> Plan:
    """Return the sweep of a parameter file.

    Raises ParameterError, naming the file, for whatever cannot be used.
    """
    try:
        given = read_parameter_file(path)
        for pattern, values in given.items():
            _check_names(pattern, values)
        plan = plan_sweep({node: parameters_of(f'/{node}', given) for node in TABLES})
        # A pattern such as /** means those that there are; a name means that node.
        for sentence in idle_solvers(plan, [node for node in TABLES if f'/{node}' in given]):
            say(f'{path}: {sentence}')
        return plan
    except FisheyeSvpError as error:
        text = ' '.join(str(error).split())
        raise ParameterError(text if str(path) in text else f'{path}: {text}') from error


def lens_folder(plan: Plan) -> str:
    """Return the folder that the lens files of a sweep lie below; empty where it names none."""
    names = [plan.base.lens, *plan.sweep.lists.get('lens', ())]
    folders = [str(Path(name).resolve().parent) for name in names
               if Path(name).suffix in ('.yaml', '.yml')]
    return os.path.commonpath(folders) if folders else ''


def _check_names(pattern: str, values: Mapping[str, Any]) -> None:
    """Refuse what means nothing to any node; the nodes themselves would only warn."""
    nodes = [node for node in TABLES if parameters_of(f'/{node}', {pattern: values})]
    if values and not nodes:
        raise ParameterError(f'{pattern} is not a node of a sweep; known are {", ".join(TABLES)}')
    known = {row.name for node in nodes for row in rows(TABLES[node])}
    for name in values:
        swept = name.startswith(SWEEP) and CAMERA in nodes  # the camera's own table says more
        if name.startswith(SWEEP) and not swept:
            raise ParameterError(f'{name}: only parameters of {CAMERA} can be swept, below its '
                                 f'name; {", ".join(nodes)} takes one value of each of its own')
        if name not in known and not swept:
            raise ParameterError(f'{name} is not a parameter of {", ".join(nodes)}; known are '
                                 + ', '.join(sorted(known)))
