"""What nodes tell of their inputs: topics first, then the reason, the remedy last."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.io.lens_formats import READERS_TO_90_DEG, share_beyond_90_deg
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.solve.lens_checks import ExtrapolatedPoints
from fisheye_svp_ros.solve.mirrored_points import Mirror

_MAX_NAMES = 5


def points_without_value(topic: str, count: int, of: int) -> str:
    """Tell of points that hold no number."""
    return f'{topic}: {count} of {of} points left out: no finite value, or beyond the limit'


def late(seconds: float) -> str:
    """Tell of results that come late; seconds: from the stamp of a set to its result."""
    return (
        f'{seconds:.2f} s late: from the stamp of the latest set to its result; relieve the '
        'machine, or set backlog:=1'
    )


def doubtful_tags(count: int, of: int) -> str:
    """Tell of tags that the detector is not sure of."""
    return (
        f'{count} of {of} tags left out: seen twice, hamming above max_hamming or margin below '
        'min_decision_margin'
    )


def unknown_landmark(topic: str, number: int, of_tags: bool = False) -> str:
    """Tell of a set that is refused for the sake of one landmark or tag, or of all."""
    if of_tags:
        return f'{topic}: tag {number} is not in the tag map'
    return f'{topic}: landmark {number} is not one of the landmarks'


def unknown_landmarks(topic: str, numbers: Sequence[int], of: int, of_tags: bool = False) -> str:
    """Tell of points whose landmarks nobody has published, or of tags not in the map."""
    what, why = ('tags', 'not in the map') if of_tags else ('points', 'unknown landmarks')
    return f'{topic}: {len(numbers)} of {of} {what} left out: {why} {_first_names(numbers)}'


def _first_names(numbers: Sequence[int]) -> str:
    more = ', ...' if len(numbers) > _MAX_NAMES else ''
    return ', '.join(map(str, numbers[:_MAX_NAMES])) + more


def tag_map_in_use(name: str, stderr: Array) -> str:
    """Tell which landmarks hold, in place of the topic; stderr (T,): of tags, m."""
    errors = f'up to {1e3 * stderr.max():.2g} mm' if stderr.any() else 'none stated'
    return (
        f'landmarks: {len(stderr)} tags of {name} (standard errors: {errors}); the topic '
        'landmarks is not used'
    )


def landmarks_refused(reason: str) -> str:
    """Tell of a map that cannot be used while the one before is."""
    return f'landmarks: the latest message is refused, the one before is used ({reason})'


def landmarks_left_out(count: int, of: int) -> str:
    """Tell of landmarks that hold no number."""
    return f'landmarks: {count} of {of} left out: no finite value, or beyond the limit'


def frames_differ(topic: str, frame: str, other_topic: str, other: str) -> str:
    """Tell of two inputs that cannot belong together."""
    return (
        f'{topic}: left out: in frame {frame!r}, but {other_topic} in {other!r}; publish both '
        'in one frame, or publish the transform between them on /tf'
    )


def camera_info_of_another(topic: str, frame: str, points: str) -> str:
    """Tell of a lens that belongs to another camera than the image points."""
    return f'{topic}: of {frame!r}, but the image points are of {points!r}; remap {topic}'


def rig_of_others(frames: Sequence[str], cameras: Sequence[str]) -> str:
    """Tell of a rig whose cameras (left, right) are not those of the image points."""
    return (
        f'rig: of {frames[0]!r} in {frames[1]!r}, but left and right image points are of '
        f'{cameras[0]!r} and {cameras[1]!r}; remap rig, or exchange left and right'
    )


def cameras_exchanged(distance: float) -> str:
    """Tell of a pair whose left camera is on the right."""
    return (
        f'the left camera is {distance:.3g} m to the right of the right one; are left and right '
        'exchanged?'
    )


def inactive(node: str, configured: bool) -> str:
    """Tell of a managed node that listens to nothing."""
    first = '' if configured else f'configure, then ros2 lifecycle set {node} '
    return f'not active, so no set is solved; run ros2 lifecycle set {node} {first}activate'


def messages_lost(topic: str, count: int, of: int, remedy: str) -> str:
    """Tell of messages that were sent and have not come."""
    return f'{topic}: {count} of {of} messages were lost; {remedy}'


def small_message_remedy(override: str) -> str:
    """Say what helps against the loss of messages; override: of the QoS."""
    return f'raise net.core.rmem_max, or set {override}.subscription.reliability:=reliable'


def large_message_remedy(profile: str) -> str:
    """Say what helps against the loss of images; profile: of Fast DDS, empty for none to name."""
    memory = f'start both nodes with FASTRTPS_DEFAULT_PROFILES_FILE={profile}, or ' * bool(profile)
    return f'{memory}raise net.core.rmem_max, or have it sent reliably'


def no_camera_info(topic: str) -> str:
    """Tell of a lens that was to come on a topic."""
    return f'{topic}: no message received; check its publisher, or set lens:=FILE'


def cameras_mixed(topic: str, frame: str, before: str) -> str:
    """Tell of two cameras on one topic."""
    return f'{topic}: from {frame!r}, but {before!r} before; give each camera its own topic'


def compiling() -> str:
    """Say that a node is slower for a while."""
    return (
        'solving with NumPy until Numba has compiled in the background, once on this machine: '
        'about a minute'
    )


def compiling_first() -> str:
    """Say why a command does not begin yet."""
    return (
        'Numba compiles first, once on this machine: about a minute; FISHEYE_SVP_ENGINE=numpy '
        'avoids it'
    )


def compilation_text(state: str) -> str:
    """Say that it has, or why not; state: of `optics.engines.cache.Compilation`."""
    if state == 'compiled':
        return 'solving with Numba from now on'
    return f'solving with NumPy: Numba has not compiled ({state})'


MIRROR_WORDS = {
    Mirror.V_UPWARDS: 'v is counted upward',
    Mirror.UV_EXCHANGED: 'u and v are exchanged',
    Mirror.IMAGE: 'v is counted upward, u leftward, or both are exchanged',
    Mirror.Y_REVERSED: 'y of the board is reversed',
    Mirror.U_LEFTWARDS: 'u is counted leftward',
    Mirror.X_REVERSED: 'x of the board is reversed',
    Mirror.ONE_AXIS: 'v is counted upward, or u leftward',
}
MIRROR_REMEDY = 'write u to the right, v down, x, y, z right-handed with z into the board'


def points_mirrored(what: str, mirror: Mirror) -> str:
    """Tell of points that are a mirror image of what was seen."""
    if mirror == Mirror.Y_UPWARDS:
        return (
            f'{what}: every frame shows the board from behind: its y points up and its z out of '
            'it. Poses refer to that frame. For z into the board, count y downward'
        )
    return (
        f'{what}: every frame shows the board from behind: {MIRROR_WORDS[mirror]}; {MIRROR_REMEDY}'
    )


def points_extrapolated(what: str, beyond: ExtrapolatedPoints) -> str:
    """Tell of points, or pixels, where nothing is known of the lens."""
    return (
        f'{what}: {100 * beyond.share:.2g} % lie up to {np.degrees(beyond.farthest):.0f} deg '
        'from the axis, but image points of the calibration reach '
        f'{np.degrees(beyond.known):.0f} deg: beyond, the lens is extrapolated'
    )


def reader_limit(lens: Lens, form: str) -> str:
    """Return where the readers of a format end before the image of a lens does; '' elsewhere."""
    share = share_beyond_90_deg(lens) if form in READERS_TO_90_DEG else 0.0
    if not share:
        return ''
    return (
        f'{100 * share:.2g} % of the image of {lens.name} lies beyond 90 deg, where '
        f'{READERS_TO_90_DEG[form]} ends; basalt, nerfstudio and mrcal reach further'
    )


def exchanged_cameras(left: str, right: str) -> str:
    """Tell of a rig whose left camera stands right of the right one."""
    return (
        f'{right} is to the left of {left}: the baseline is negative, which stereo_image_proc '
        'refuses; exchange the names, or turn the images upright'
    )
