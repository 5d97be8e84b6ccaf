"""The rig of three and more calibrated cameras: fitted, printed, written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fisheye_svp_ros.commands.notes import say
from fisheye_svp_ros.errors import FisheyeSvpError
from fisheye_svp_ros.io.files import write_json, write_text, write_together
from fisheye_svp_ros.io.lens_formats import kalibr, transforms
from fisheye_svp_ros.io.rig_files import save_rig
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import quaternion_from_rotation
from fisheye_svp_ros.reporting.tables import print_table
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.solve.rig_calibration import (
    RigCalibration,
    calibrate_rig,
    connected_cameras,
)


def calibrate_cameras(
    table: Observations, lenses: Mapping[str, Lens], folder: Path | None
) -> None:
    """Fit the rig of all cameras that frames hold together; print it, write it to a folder."""
    groups = connected_cameras(table)
    largest = max(groups, key=len)
    for group in groups:
        if group != largest:
            say(f'rig: nothing holds {" and ".join(group)} to {", ".join(largest)}: no frame '
                'shows the target to both at once; photograph it where two cameras see it')
    if len(largest) < 2:
        return
    try:
        found = calibrate_rig(table, lenses, largest)
    except FisheyeSvpError as cause:
        say(f'rig: {cause}')
        return
    if found.left_out:
        say('rig: left out, since no rig explains them: frames '
            + ', '.join(map(str, found.left_out)))
    if folder:
        with write_together():
            _write(found, [lenses[name] for name in found.cameras], folder)
    _print(found)


def _write(found: RigCalibration, lenses: Sequence[Lens], folder: Path) -> None:
    save_rig(found.steps(), folder / 'rig.yaml', found.cameras)
    write_json(folder / 'rig.json', _document(found))
    write_text(folder / 'rig.urdf', transforms.urdf_text(found.cameras, found.rig))
    write_text(folder / 'tf_static.yaml',
               transforms.static_transforms_text(found.cameras, found.rig))
    try:
        write_text(folder / 'camchain.yaml', kalibr.write_chain(lenses, found.steps()))
    except FisheyeSvpError as cause:
        say(f'no camchain of Kalibr: {cause}')


def _document(found: RigCalibration) -> dict[str, Any]:
    """Return the mapping of rig.json: cameras in the first one, with covariances."""
    turns = quaternion_from_rotation(found.rig.rotation)
    return {
        'frame': found.cameras[0], 'frames': len(found.frame), 'sigma_px': found.sigma_px,
        'left_out': list(found.left_out),
        'cameras': {name: {
            'position': found.rig.position[i].tolist(), 'quaternion': turns[i].tolist(),
            'covariance': found.covariance[i - 1].tolist() if i else None,
            'rms_px': float(found.rms_px[i]), 'frames': int(found.shared[i]),
        } for i, name in enumerate(found.cameras)},
    }


def _print(found: RigCalibration) -> None:
    sigma = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    rows = []
    for i, name in enumerate(found.cameras):
        place = [f'{1e3 * value:.3f}' for value in found.rig.position[i]]
        error = (f'{1e3 * sigma[i - 1, :3].max():.3f}', f'{np.degrees(sigma[i - 1, 3:].max()):.4f}'
                 ) if i else ('', '')
        rows.append((name, *place, *error, str(found.shared[i]), f'{found.rms_px[i]:.4f}'))
    print_table(f'rig: cameras in {found.cameras[0]}, from {len(found.frame)} frames that several '
                'of them saw', ('camera', 'x, mm', 'y, mm', 'z, mm', '±, mm', '±, deg', 'frames',
                                'rms, px'), rows)
