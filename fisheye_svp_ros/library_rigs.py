"""The library's part about rigs of any number of cameras."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.io.rig_files import load_cameras
from fisheye_svp_ros.library import AnyLens, AnyObservations, check_images, load_lens, table_of
from fisheye_svp_ros.library_checks import check_type
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.solve import rig_calibration, rig_localization
from fisheye_svp_ros.solve.measured_poses import posable_observations, rig_lenses
from fisheye_svp_ros.solve.rig_calibration import RigCalibration
from fisheye_svp_ros.solve.rig_localization import RigLocalization
from fisheye_svp_ros.threads import limit_threads


@limit_threads
def calibrate_rig(
    observations: AnyObservations, lenses: Mapping[str, AnyLens]
) -> RigCalibration:
    """Fit where the cameras of a table stand, in the first of them; lenses by camera.

    A lens that states its standard errors (`calibrate`) is fitted, too, with these as its prior;
    the rig goes with the lenses of the result.
    Cameras whose views no relative pose explains as those of one target see boards of their own:
    these stand still, and the motion of the rig relates them.
    Raises ObservationError for a camera without a lens, for cameras that no frame holds to the
    others, and where no rig explains most frames; GeometryError where it is not determined.
    """
    table, known = _inputs(observations, lenses)
    table, _ = posable_observations(table, known)
    group, *others = rig_calibration.connected_cameras(table)
    if others:
        raise ObservationError(f'{table.source}: {" and ".join(others[0])} cannot be related to '
                               f'{", ".join(group)}: no frame shows the target to both at once')
    return rig_calibration.calibrate_rig(table, known, table.cameras)


@limit_threads
def localize_rig(
    observations: AnyObservations, lenses: Mapping[str, AnyLens],
    rig: RigCalibration | str | Path,
) -> RigLocalization:
    """Pose every frame from all cameras of a rig at once: its first camera in the world.

    rig: from `calibrate_rig`, or a file or folder that `calibrate` has written.
    Raises ObservationError for a camera without a lens, or that the rig does not have, and
    GeometryError where no frame can be posed.
    """
    table, known = _inputs(observations, lenses)
    names, places = _cameras(rig)
    return rig_localization.localize_rig(table, known, names, places)


def _inputs(
    observations: AnyObservations, lenses: Mapping[str, AnyLens]
) -> tuple[Observations, dict[str, Lens]]:
    table = table_of(observations)
    check_type(lenses, Mapping, 'lenses', 'a mapping of cameras to lenses')
    known = {name: load_lens(lens) for name, lens in lenses.items()}
    check_images(observations, known)
    return table, rig_lenses(table, known)


def _cameras(rig: RigCalibration | str | Path) -> tuple[tuple[str, ...], Pose]:
    return (rig.cameras, rig.rig) if isinstance(rig, RigCalibration) else load_cameras(rig)
