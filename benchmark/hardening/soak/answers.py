"""Whether a node that was attacked answers well."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.serialization import serialize_message
from sensor_msgs.msg import PointCloud2

from benchmark.hardening.soak import hostile
from benchmark.hardening.soak.victims import Victim, Watch
from fisheye_svp_ros.io.decoding import read_image_points, read_key_values, stamp_of
from fisheye_svp_ros.nodes import messages

_LONG = 120.0  # s
_FRAMES = 24  # of which the critic needs 20
_FIGURES = {'stereo_depth': ('error3_m', 0.05)}


def wrong(victim: Victim, watch: Watch, victims: dict[str, Victim]) -> str:
    """Say what is wrong with a node's answer to what is good; empty for nothing."""

    def until(condition: Callable[[], bool]) -> bool:
        return watch.until(victims, condition, _LONG)

    if victim.name == 'detector':
        return _detector(victim, until)
    if victim.name.endswith('_camera'):
        return _camera(victim, until)
    return _solver(victim, until)


def _solver(victim: Victim, until: Callable[[Callable[[], bool]], bool]) -> str:
    results = victim.hear_topic(f'{victim.name}/result', DiagnosticArray)
    critic = victim.name == 'model_critic'
    latest: dict[str, str] = {}
    if not until(lambda: victim.has_publisher(f'{victim.name}/result')):
        return 'no results'
    stamps = set()
    for stamp, told in victim.good(_FRAMES if critic else 3):
        stamps.add(stamp)
        for topic, data in told:
            victim.tell(topic, data)
        time.sleep(0.05)

    def answered() -> bool:
        while results:
            message = results.popleft()
            if stamp_of(message) in stamps:
                latest.update(read_key_values(message))
        return bool(latest.get('verdict') if critic else latest)

    if not until(answered):
        return f'a good set is not answered: {latest}'
    if critic:
        noise = float(latest['noise_px'])
        return '' if 0.8 < noise / hostile.NOISE < 1.25 else f'the noise is said to be {noise} px'
    name, most = _FIGURES.get(victim.name, ('rms_px', 0.5))
    value = float(latest.get(name, math.nan))
    return '' if value < most else f'a good set is left with {name} = {value}: {latest}'


def _detector(victim: Victim, until: Callable[[Callable[[], bool]], bool]) -> str:
    found = victim.hear_topic('image_points', PointCloud2)

    def seen() -> bool:
        victim.stamp += 1
        victim.tell('image', hostile.good_image(victim.stamp))
        time.sleep(0.2)
        return any(len(read_image_points(message).uv) == 30 for message in list(found))

    return '' if until(seen) else 'a good image is not answered'


def _camera(victim: Victim, until: Callable[[Callable[[], bool]], bool]) -> str:
    heard = victim.hear_topic('image_points', PointCloud2)
    stamps: list[int] = []

    def goes_on() -> bool:
        while heard:
            stamps.append(stamp_of(heard.popleft()))
            answer = messages.key_values_message('a', {'rms_px': 0.1}, stamps[-1])
            victim.tell('answer', serialize_message(answer))
        return len(stamps) > 3

    return '' if until(goes_on) else f'it has published {len(stamps)} sets since'
