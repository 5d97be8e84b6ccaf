"""One way to solve: a set has the same pose by node, by sweep and by command."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers.graph import LATCHED, Graph
from helpers.targets import plane, poses_around
from helpers.walks import files_run, walk

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped  # isort: skip
from sensor_msgs.msg import PointCloud2  # isort: skip

from fisheye_svp_ros.cli import main
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.csv_files import CsvTable, write_columns
from fisheye_svp_ros.io.decoding import read_pose
from fisheye_svp_ros.io.lens_files import save_lens
from fisheye_svp_ros.io.readers import read_poses, write_observations, write_poses
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.localizer import Localizer
from fisheye_svp_ros.optics.curves import Equidistant
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Observations, group_views, make_observations
from fisheye_svp_ros.simulate.scenario import Scenario, simulate_scenario
from fisheye_svp_ros.solve.poses import solve_poses
from fisheye_svp_ros.study.solutions import residual_points
from fisheye_svp_ros.study.sweep import plan_sweep, sweep_rows

SETS = 116


@pytest.fixture
def flat(tmp_path: Path) -> Scenario:
    """Return far views of a flat board: each has two minima, which are nearly alike."""
    lens = Lens('tele', 1280, 960, 1800.0, 1800.0, 639.5, 479.5, Equidistant(), 0.44)
    save_lens(lens, tmp_path / 'tele.yaml')
    target, rng = plane(), np.random.default_rng(3)
    poses = poses_around(target, SETS, rng, widest=0.2, distance=(8.0, 20.0))
    x, y, z = target.points.T
    write_columns(tmp_path / 'board.csv', {'landmark': target.ids, 'x': x, 'y': y, 'z': z})
    write_poses(tmp_path / 'poses.csv', np.arange(SETS), poses)
    return Scenario(
        lens=f'{tmp_path}/tele.yaml',
        environment=f'{tmp_path}/board.csv',
        noise_px=0.1,
        poses_file=f'{tmp_path}/poses.csv',
        seed=3,
    )


@pytest.fixture
def graph(ros_domain: int, flat: Scenario) -> Iterator[Graph]:
    """Return a graph without nodes."""
    one = Graph('-p', f'lens:={flat.lens}', '-p', 'patience:=0.5')
    yield one
    one.close()


def by_sweep(scenario: Scenario) -> np.ndarray:
    plan = plan_sweep(
        {
            'synthetic_camera': {
                'lens': scenario.lens,
                'environment': scenario.environment,
                'poses_file': scenario.poses_file,
                'noise_px': scenario.noise_px,
                'sweep.seed': [scenario.seed],
            }
        }
    )
    columns = sweep_rows(plan, range(1))
    return np.array([columns[f'localizer.position_error_{axis}_m'] for axis in 'xyz']).T


def by_command(scenario: Scenario, observations: Observations, folder: Path) -> np.ndarray:
    write_observations(folder / 'seen.csv', observations)
    arguments = ['localize', folder / 'seen.csv', '--lens', scenario.lens, '-o', folder / 'out']
    assert main([*map(str, arguments)]) == 0
    return read_poses(folder / 'out' / 'poses.csv').pose.position


def by_node(graph: Graph, observations: Observations, true: Pose) -> np.ndarray:
    heard = graph.hear(PoseWithCovarianceStamped, 'localizer/pose')
    node = graph.start(Localizer)
    landmarks = graph.tell(PointCloud2, 'landmarks', LATCHED)
    points, truth = graph.tell(PointCloud2, 'image_points'), graph.tell(PoseStamped, 'true_pose')
    graph.until(lambda: node._pose.get_subscription_count() > 0)
    landmarks.publish(messages.landmarks_message(observations.landmarks(), 0, 'world'))
    views = group_views(observations)
    for i, used in enumerate(views.used):
        truth.publish(messages.pose_message(true.take(i), i + 1, 'world'))
        points.publish(
            messages.image_points_message(
                views.landmark[i][used], views.uv[i][used], i + 1, 'camera'
            )
        )
        graph.until(lambda count=i + 1: len(heard) == count)
    return np.stack([read_pose(message.pose).position for message in heard])


def test_flat_boards_have_the_same_poses_by_every_way(
    flat: Scenario, graph: Graph, tmp_path: Path
) -> None:
    simulation = simulate_scenario(flat)
    true, seen = simulation.poses[0], simulation.observations
    assert len(seen.frames) == SETS
    told = by_node(graph, seen, true)
    np.testing.assert_allclose(by_command(flat, seen, tmp_path), told, atol=1e-7)
    np.testing.assert_allclose(by_sweep(flat) + true.position, told, atol=1e-7)
    # Some of them are on the wrong side where that fits better; hardly any is far off.
    off = np.linalg.norm(told - true.position, axis=1)
    assert np.quantile(off, 0.9) < 1.0


def test_a_message_goes_to_its_topics(flat: Scenario, graph: Graph) -> None:
    seen, files = simulate_scenario(flat).observations, walk('an `image_points` message')
    heard = graph.hear(PoseWithCovarianceStamped, 'localizer/pose')
    node = graph.start(Localizer)
    landmarks = graph.tell(PointCloud2, 'landmarks', LATCHED)
    points = graph.tell(PointCloud2, 'image_points')
    graph.until(lambda: node._pose.get_subscription_count() > 0)
    landmarks.publish(messages.landmarks_message(seen.landmarks(), 0, 'world'))
    views = group_views(seen)
    sent = [
        messages.image_points_message(views.landmark[0], views.uv[0], stamp, 'camera')
        for stamp in (2, 1)
    ]

    def tell() -> None:
        points.publish(sent.pop())
        graph.until(lambda: len(heard) + len(sent) == 2)
        graph.idle(0.1)  # what is left to look at

    for timer in node.timers:  # they look at the sets, too, at any time
        timer.cancel()
    assert files_run(tell, files) == files


def test_angles_and_ranges_are_those_of_the_corrected_target(tmp_path: Path) -> None:
    grown = {'landmark_scale': {'axes': 1, 'parameters': {'relative': 0.05}}}
    lens = Lens('wide', 1280, 960, 400.0, 400.0, 639.5, 479.5, Equidistant(), 1.5, target=grown)
    save_lens(lens, tmp_path / 'wide.yaml')
    target, count = plane(), len(plane().points)
    pose = Pose(np.eye(3)[None], np.array([[0.05, 0.1, -0.15]]))
    seen = pose.into_body(1.05 * target.points)[0]
    theta, away = np.arctan2(np.hypot(*seen[:, :2].T), seen[:, 2]), np.linalg.norm(seen, axis=1)
    uv = [639.5, 479.5] + 400 * theta[:, None] * seen[:, :2] / np.hypot(*seen[:, :2].T)[:, None]
    table = make_observations(np.zeros(count), target.ids, uv, target.points)
    write_observations(tmp_path / 'seen.csv', table)
    assert (
        main(
            [
                'localize',
                f'{tmp_path}/seen.csv',
                '--lens',
                f'{tmp_path}/wide.yaml',
                '-o',
                f'{tmp_path}/out',
            ]
        )
        == 0
    )
    told = CsvTable(tmp_path / 'out' / 'residuals.csv', ['theta', 'range'])
    model, views = ForwardModel(lens), group_views(table)
    cloud = residual_points(solve_poses(model, views))
    for name, true in (('theta', theta), ('range', away)):
        np.testing.assert_allclose(told.numbers(name)[:, 0], true, atol=1e-8)
        np.testing.assert_allclose(cloud[name], true, atol=1e-8)
