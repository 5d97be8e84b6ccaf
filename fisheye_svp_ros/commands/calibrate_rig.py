"""The rig of two and more calibrated cameras: fitted, printed, written."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fisheye_svp_ros.commands.notes import counted, say
from fisheye_svp_ros.errors import FisheyeSvpError
from fisheye_svp_ros.io.files import write_json, write_text
from fisheye_svp_ros.io.lens_formats import kalibr, transforms
from fisheye_svp_ros.io.rig_files import check_camera_names, save_rig
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import quaternion_from_rotation
from fisheye_svp_ros.reporting.tables import print_table
from fisheye_svp_ros.scene.observations import Observations, rig_cameras
from fisheye_svp_ros.scene.photograph_names import list_frames
from fisheye_svp_ros.solve.measured_poses import posable_observations
from fisheye_svp_ros.solve.outliers import FRAME
from fisheye_svp_ros.solve.rig_calibration import (
    RigCalibration,
    calibrate_rig,
    connected_cameras,
)
from fisheye_svp_ros.solve.rig_checks import MAX_RIG_RATIO, MIN_SHARED_FRAMES


def check_names(table: Observations, where: str) -> None:
    """Raise LensError for names of cameras that the files of their rig cannot hold."""
    largest = max(connected_cameras(table), key=len)
    check_camera_names(table.cameras, rig_cameras(largest) or largest, where)


def fit_rig(table: Observations, lenses: Mapping[str, Lens]) -> RigCalibration | None:
    """Fit the rig of the cameras that frames hold together; None, with a note why, for none."""
    try:
        table, _ = posable_observations(table, lenses)
        groups = connected_cameras(table)
        largest = max(groups, key=len)
        for group in groups:
            if group != largest:
                say(f'rig: {" and ".join(group)} cannot be related to {", ".join(largest)}: no '
                    'frame shows the target in both; photograph it where two cameras see it, or '
                    'turn the rig while each sees a board of its own, and give simultaneous '
                    'photographs the same frame number')
        if len(largest) < 2:
            return None
        found = calibrate_rig(table, lenses, rig_cameras(largest) or largest)
    except FisheyeSvpError as cause:
        say(f'rig: {cause}')
        return None
    for warning in _warnings(found, table, lenses):
        say(f'rig: {warning}')
    return found


def _warnings(
    found: RigCalibration, table: Observations, lenses: Mapping[str, Lens]
) -> Iterator[str]:
    """Yield what there is to say against a rig."""
    if found.left_out:
        yield f'left out: {list_frames(table, found.left_out)}: {FRAME}'
    if found.reason:
        yield found.reason
    own = max((lenses[name].calibration or {}).get('rms_px', np.inf) for name in found.cameras)
    if found.total_rms_px > MAX_RIG_RATIO * own:
        yield (f'rms {found.total_rms_px:.2f} px with a rigid rig, at most {own:.2f} px for each '
               'camera alone: the cameras moved, their photographs were not simultaneous, or a '
               'lens is wrong')
    for name, shared in zip(found.cameras, found.shared.tolist(), strict=True):
        if shared < MIN_SHARED_FRAMES:
            one = shared == 1
            what = (f'relate{"s" if one else ""} {name} to the others'
                    if len(found.cameras) > 2 else 'is shared' if one else 'are shared')
            yield (f'only {counted(shared, "frame")} {what}, and it is assumed that all '
                   'cameras saw one target; take more photographs of it with two cameras at once')
            if len(found.cameras) == 2:
                return


def write_rig(found: RigCalibration, folder: Path) -> None:
    """Write a rig as tools read it, its lenses apart."""
    save_rig(found.steps(), folder / 'rig.yaml', found.cameras)
    write_json(folder / 'rig.json', _document(found))
    write_text(folder / 'rig.urdf', transforms.urdf_text(found.cameras, found.rig))
    write_text(folder / 'tf_static.yaml',
               transforms.static_transforms_text(found.cameras, found.rig))
    try:
        write_text(folder / 'camchain.yaml', kalibr.write_chain(found.lenses, found.steps()))
    except FisheyeSvpError as cause:
        say(f'camchain.yaml of Kalibr is not written: {cause}')


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
            'board': found.boards[i] if found.boards else 0,
        } for i, name in enumerate(found.cameras)},
    }


def print_rig(found: RigCalibration) -> None:
    """Print a rig."""
    if len(found.cameras) == 2:
        x, y, z = 1000 * found.steps()[0].position
        print(f'rig: camera {found.cameras[0]} in {found.cameras[1]} at {x:.3f}, '
              f'{y:.3f}, {z:.3f} mm, from {len(found.frame)} frames, '
              f'rms {found.total_rms_px:.4f} px')
    if found.boards:
        each = [' and '.join(name for name, board in zip(found.cameras, found.boards, strict=True)
                             if board == one) for one in sorted(set(found.boards))]
        print('rig: boards apart, related by the motion of the rig: one seen by '
              f'{", another by ".join(each)}')
    sigma = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    rows = []
    for i, name in enumerate(found.cameras):
        place = [f'{1e3 * value:.3f}' for value in found.rig.position[i]]
        error = (f'{1e3 * sigma[i - 1, :3].max():.3f}', f'{np.degrees(sigma[i - 1, 3:].max()):.4f}'
                 ) if i else ('', '')
        rows.append((name, *place, *error, str(found.shared[i]), f'{found.rms_px[i]:.4f}'))
    print_table(f'rig: cameras in {found.cameras[0]}, from {len(found.frame)} frames that several '
                'cameras see', ('camera', 'x, mm', 'y, mm', 'z, mm', '±, mm', '±, deg', 'frames',
                                'rms, px'), rows)
