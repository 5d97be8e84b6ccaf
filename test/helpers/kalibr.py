"""Camchains as Kalibr writes them, of two cameras."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import yaml

from fisheye_svp_ros.io.lens_formats import write_foreign
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose


def write_camchain(path: Path, left: Lens, right: Lens, rig: Pose) -> Path:
    """Write a rig, left in right, its lenses without their viewpoint shifts."""
    cameras = [
        yaml.safe_load(write_foreign(replace(lens, viewpoint_shift=None), 'kalibr'))['cam0']
        for lens in (left, right)
    ]
    matrix = [
        [*row, place]
        for row, place in zip(rig.rotation.tolist(), rig.position.tolist(), strict=True)
    ]
    cameras[1]['T_cn_cnm1'] = [*matrix, [0.0, 0.0, 0.0, 1.0]]
    path.write_text(yaml.safe_dump({'cam0': cameras[0], 'cam1': cameras[1]}))
    return path
