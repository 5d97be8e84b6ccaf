"""Stereo calibration by mrcal.optimize, once a line that comes in; run by rig_adjustment.py."""

import json
import sys
import time

import mrcal
import numpy as np

problem = np.load(sys.argv[1])
rows, columns = problem['grid']
views = len(problem['left'])
seen = np.ones((views, 2, rows, columns, 3))
for camera, side in enumerate(('right', 'left')):
    seen[:, camera, ..., :2] = problem[side].reshape(views, rows, columns, 2)
seen = seen.reshape(2 * views, rows, columns, 3)
indices = np.array(
    [(view, camera, camera - 1) for view in range(views) for camera in range(2)], dtype=np.int32
)
# The names of the poses since mrcal 2.5, and those before.
CAMERA, FRAMES = (
    ('rt_cam_ref', 'rt_ref_frame')
    if 'rt_cam_ref' in (mrcal.optimize.__doc__ or '')
    else ('extrinsics_rt_fromref', 'frames_rt_toref')
)
for _ in sys.stdin:
    extrinsics = problem['extrinsics'].copy()
    arguments = {
        'intrinsics': np.array([problem['intrinsics']] * 2),
        CAMERA: extrinsics,
        'points': None,
        'observations_point': None,
        'indices_point_camintrinsics_camextrinsics': None,
        FRAMES: problem['frames'].copy(),
        'observations_board': seen.copy(),
        'indices_frame_camintrinsics_camextrinsics': indices,
        'lensmodel': 'LENSMODEL_STEREOGRAPHIC',
        'imagersizes': np.array([problem['size']] * 2, dtype=np.int32),
        'calibration_object_spacing': float(problem['spacing']),
    }
    fixed = dict.fromkeys(
        (
            'do_optimize_intrinsics_core',
            'do_optimize_intrinsics_distortions',
            'do_optimize_calobject_warp',
            'do_apply_outlier_rejection',
            'do_apply_regularization',
        ),
        False,
    )
    start = time.process_time()
    mrcal.optimize(**arguments, **fixed)
    seconds = time.process_time() - start
    print(json.dumps({'seconds': seconds, 'rig': extrinsics[0].tolist()}), flush=True)
