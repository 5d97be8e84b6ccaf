"""Lenses as other tools write them: recognised by their content, read and written.

A new format is one module with `recognises` (true of the text of such a file), `read` and, where
it can be written, `write`, and one line in FORMATS.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.forward import back_project_corrected
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose

# In the order in which they are asked: OpenCV's files are the most general of YAML.
FORMATS = (
    'kalibr',
    'ros',
    'euroc',
    'orbslam',
    'camodocal',
    'mc_calib',
    'gyroflow',
    'depthai',
    'photonvision',
    'theia',
    'woodscape',
    'opencv',
    'basalt',
    'mrcal',
    'colmap',
    'nerfstudio',
    'boofcv',
    'metashape',
    'ocamcalib',
    'transforms',
    'rig',
)
WRITABLE = ('kalibr', 'ros', 'opencv', 'basalt', 'mrcal', 'colmap', 'nerfstudio')
# Whose readers project nothing, or something else, from 90 degrees off the axis on
READERS_TO_90_DEG = {
    'kalibr': 'Kalibr',
    'ros': 'image_proc (cv2.fisheye)',
    'opencv': 'cv2.fisheye',
    'colmap': 'COLMAP',
}
RIG_WRITABLE = ('kalibr', 'basalt')  # cameras with the transforms between them
_FAR_CAMERAS = 15.0  # m: between two neighbors; a baseline of 15 mm is the smallest in mm
_GRID = 100  # image points along each axis
READABLE = (
    'ROS camera_info, Kalibr, OpenCV, Basalt, mrcal, EuRoC, COLMAP, ORB-SLAM3, CamOdoCal, '
    'nerfstudio, Metashape, OCamCalib, BoofCV, PhotonVision, DepthAI, Gyroflow, '
    'OpenImuCameraCalibrator, MC-Calib and WoodScape'
)
# What is known by sight alone
UNREADABLE_FORMATS = {
    'an OpenMVG scene': '"sfm_data_version"',
    'an OpenSfM camera': '"projection_type"',
    'an AliceVision (Meshroom) scene': '"intrinsicId"',
    'a lensfun database': '<lensdatabase',
    'a Hugin or PTGui project': r'^[iop] w\d+ h\d+ f\d',
    'a Bundler file': '^# Bundle file',
    'a RealityScan (RealityCapture) XMP file': 'xcr:DistortionModel',
    'an SVO (vikit) camera': r'^cam_model *:|^cameras: *\n *- camera:',
    "Kalibr's text of results (take its camchain YAML)": '^Camera-system parameters:',
    'a transforms.json without fl_x': '"camera_angle_x"',
    'a BoofCV model other than omnidirectional_universal': '^ *pinhole:',
    'a configuration of stella_vslam': r'^ +setup: *"?(monocular|stereo|RGBD)',
    'a calibration of the MATLAB toolbox of Caltech': r'^ *fc *= *\[',
    'a calibu rig': '<camera_model',
    'a .mat file of MATLAB (write camera matrix, distortion and size as YAML)': '^MATLAB 5.0 MAT',
    'a field layout of WPILib (a tag map, no lens)': r'"pose"\s*:\s*\{\s*"translation"',
}


class Foreign(NamedTuple):
    """What a file of another tool holds.

    form: of the file; lenses by camera; rigs: each camera in the next one; worst_px: how far each
    lens is from what the file says; cameras: of a rig without lenses, if it names them;
    notes: what was assumed; rectified: R (3, 3) and P (3, 4) of a camera_info.
    """

    form: str
    lenses: dict[str, Lens]
    rigs: tuple[Pose, ...]
    worst_px: dict[str, float]
    cameras: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    rectified: tuple[Array, Array] | None = None

    @classmethod
    def from_lenses(
        cls, form: str, found: Mapping[str, tuple[Lens, float]], rigs: Sequence[Pose] = ()
    ) -> Foreign:
        """Return what a file holds; found: each lens with how far it is from the file, px."""
        lenses = {camera: lens for camera, (lens, _) in found.items()}
        return cls(form, lenses, tuple(rigs), {camera: px for camera, (_, px) in found.items()})

    def with_unit_note(self) -> Foreign:
        """Return it with a note where the cameras stand further apart than those of any rig."""
        far = max((float(np.linalg.norm(rig.position)) for rig in self.rigs), default=0.0)
        if far < _FAR_CAMERAS:
            return self
        note = f'cameras are {far:.3g} m apart; translations must be in m, not in mm'
        return self._replace(notes=(*self.notes, note))

    def deviation_px(self, lens: Lens) -> float:
        """Return how far a lens of the file is from what the file says, px."""
        return next(
            (
                self.worst_px.get(camera, 0.0)
                for camera, candidate in self.lenses.items()
                if candidate == lens
            ),
            0.0,
        )


def read_foreign(path: str | Path, text: str) -> Foreign | None:
    """Return the lenses in a file of another tool, None where no format knows its content.

    Raises LensError, naming file and field, for a file that is incomplete, and naming the format
    of one that cannot be read.
    """
    for name in FORMATS:
        module = import_module(f'{__name__}.{name}')
        if module.recognises(text):
            read: Callable[[str, str], Foreign] = module.read
            return read(text, str(path)).with_unit_note()
    for name, mark in UNREADABLE_FORMATS.items():
        if re.search(mark, text, re.MULTILINE):
            raise LensError(f'{path}: {name} cannot be read; readable are {READABLE}')
    return None


def share_beyond_90_deg(lens: Lens) -> float:
    """Return the share of the image, within the field of view, from 90 degrees off the axis on."""
    across, down = (np.linspace(0, side - 1, _GRID) for side in (lens.width, lens.height))
    rays = back_project_corrected(lens, np.stack(np.meshgrid(across, down), axis=-1))
    beyond = rays.direction[rays.valid][:, 2] <= 0
    return float(beyond.mean()) if len(beyond) else 0.0


def write_foreign(lens: Lens, form: str) -> str:
    """Return a lens in another tool's form; a viewpoint shift stays behind, but for mrcal.

    Raises LensError for a lens that the form cannot say to a hundredth of a pixel; CAHVORE, the
    only form with a shift, is the nearest one.
    """
    if form not in WRITABLE:
        raise LensError(f'format {form!r} is unknown; choose from {", ".join(WRITABLE)}')
    text: str = import_module(f'{__name__}.{form}').write(lens)
    return text


def write_foreign_rig(lenses: Sequence[Lens], rigs: Sequence[Pose], form: str) -> str:
    """Return lenses and each camera in the next one, in one of RIG_WRITABLE; else as above."""
    text: str = import_module(f'{__name__}.{form}').write_chain(lenses, rigs)
    return text
