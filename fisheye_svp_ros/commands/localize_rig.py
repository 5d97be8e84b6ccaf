"""`localize --rig`: one pose per frame from all cameras of a rig, printed and written."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from fisheye_svp_ros.commands.notes import note_gross_errors, note_left_out, say
from fisheye_svp_ros.io.csv_table import write_table
from fisheye_svp_ros.io.files import write_json, write_together
from fisheye_svp_ros.io.readers import write_poses
from fisheye_svp_ros.io.rig_files import load_cameras
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.reporting.progress import progress
from fisheye_svp_ros.reporting.tables import noise_text, print_table
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.scene.photograph_names import photograph_entry
from fisheye_svp_ros.solve.measured_poses import rms_px
from fisheye_svp_ros.solve.rig_localization import RigLocalization, localize_rig

MAX_TABLE_ROWS = 40  # frames in the table for people
AXES = ('x', 'y', 'z', 'rx', 'ry', 'rz')


def localize_cameras(
    table: Observations, lenses: Mapping[str, Lens], rig: str, folder: Path | None
) -> None:
    """Localize every frame of a rig, print the poses of its first camera, write the results.

    rig: a file that `load_cameras` reads.
    """
    cameras, places = load_cameras(rig)
    with progress('localizing'):
        found = localize_rig(table, lenses, cameras, places)
    note_left_out(table, found.left_out)
    note_gross_errors(found.table, found.outliers)
    if found.contradicted:
        say(f'{rig}: the relative poses of the cameras differ; calibrate the rig again')
    if folder:
        with write_together():
            _write(folder, cameras, found)
    _print(table, cameras, found)


def _print(table: Observations, cameras: tuple[str, ...], found: RigLocalization) -> None:
    data, rows = found.data, []
    for i, frame in enumerate(found.frame[:MAX_TABLE_ROWS].tolist()):
        mine = data.frame_of == i
        names = [found.table.cameras[camera] for camera in data.camera_of[mine]]
        worst = [np.sqrt(np.linalg.eigvalsh(found.covariance[i][part, part])[-1])
                 for part in (slice(0, 3), slice(3, 6))]
        rows.append((
            str(frame), ' '.join(names),
            str(int(data.views.used[mine].sum())), f'{rms_px(found.residual[mine]):.4f}',
            *(f'{1000 * value:.3f}' for value in found.pose.position[i]),
            f'{1000 * worst[0]:.3f}', f'{np.degrees(worst[1]):.4f}'))
    print_table(
        f'{table.source}: {cameras[0]} in the world, from {int(data.views.used.sum())} points of '
        f'{len(found.table.cameras)} cameras in {len(found.frame)} frames, rms '
        f'{rms_px(found.residual):.4f} px',
        ('frame', 'cameras', 'points', 'rms px', 'x mm', 'y mm', 'z mm', 'std. error mm',
         'std. error deg'), rows, words=('cameras',))
    if len(found.frame) > MAX_TABLE_ROWS:
        print(f'  and {len(found.frame) - MAX_TABLE_ROWS} more frames')
    print(f'  {noise_text(found.sigma)}, largest over all directions')


def _write(folder: Path, cameras: tuple[str, ...], found: RigLocalization) -> None:
    data, views, residual = found.data, found.data.views, found.residual
    write_poses(folder / 'poses.csv', found.frame, found.pose)
    used = views.used
    frame, camera = (np.broadcast_to(part[:, None], used.shape)[used]
                     for part in (views.frame, data.camera_of))
    write_table(folder / 'residuals.csv', {
        'frame': frame, 'camera': np.array(found.table.cameras)[camera],
        'landmark': views.landmark[used], 'u': views.uv[used][:, 0], 'v': views.uv[used][:, 1],
        'du': residual[used][:, 0], 'dv': residual[used][:, 1],
    })
    names = [f'{a}_{b}' for a in AXES for b in AXES]
    write_table(folder / 'covariance.csv', {
        'frame': found.frame,
        **dict(zip(names, found.covariance.reshape(-1, 36).T, strict=True))})
    write_json(folder / 'localize.json', {
        'rms_px': rms_px(residual), 'frames': len(found.frame), 'observations': int(used.sum()),
        'left_out': found.left_out, 'sigma_px': found.sigma, 'frame_id': cameras[0],
        'rig_contradicted': found.contradicted,
        'cameras': {name: {'rms_px': rms_px(residual[data.camera_of == i]),
                           'frames': int((data.camera_of == i).sum())}
                    for i, name in enumerate(found.table.cameras)},
        'gross': [
            {'frame': int(found.table.frame[row]),
             **photograph_entry(found.table, int(found.table.frame[row])),
             'camera': found.table.cameras[found.table.camera[row]],
             'landmark': int(found.table.landmark[row]), 'px': float(px), 'why': why}
            for row, px, why in zip(*found.outliers, strict=True)],
    })
