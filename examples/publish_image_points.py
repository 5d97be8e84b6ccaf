"""Publish image points of your own detector to the localizer node, and print the poses.

    ros2 run fisheye_svp_ros localizer --ros-args -p lens:=fish214
    python examples/publish_image_points.py

`detect` stands for your detector: here it simulates ten views of known landmarks.
"""

from __future__ import annotations

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2, PointField

import fisheye_svp_ros as fsvp

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def detect() -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return landmark numbers (N,), image points (N, 2), px, and landmarks (N, 3), m, by view."""
    table = fsvp.simulate_scenario(
        lens='fish214', radius=0.5, noise_px=0.2, poses_file='calibration'
    ).observations
    views = [table.frame == frame for frame in np.unique(table.frame)]
    return [(table.landmark[view], table.uv[view], table.xyz[view]) for view in views]


def cloud(landmark: np.ndarray, **columns: np.ndarray) -> PointCloud2:
    """Return a point cloud with the field `landmark` (uint32) and columns of float64."""
    dtype = np.dtype([('landmark', np.uint32), *((name, np.float64) for name in columns)])
    points = np.empty(len(landmark), dtype)
    points['landmark'] = landmark
    for name, values in columns.items():
        points[name] = values
    kinds = {'landmark': PointField.UINT32}
    fields = [
        PointField(
            name=name,
            offset=dtype.fields[name][1],
            count=1,
            datatype=kinds.get(name, PointField.FLOAT64),
        )
        for name in dtype.names
    ]
    return PointCloud2(
        height=1,
        width=len(points),
        fields=fields,
        is_dense=True,
        point_step=dtype.itemsize,
        row_step=points.nbytes,
        data=points.tobytes(),
    )


class Detector(Node):
    """Publishes one view after the other, each until its pose has come."""

    def __init__(self) -> None:
        """Publish the landmarks once: with stamp 0 they hold for every view."""
        super().__init__('detector')
        self.views = detect()
        self.stamp = None
        self.landmarks = self.create_publisher(PointCloud2, 'landmarks', LATCHED)
        self.points = self.create_publisher(PointCloud2, 'image_points', 10)
        self.create_subscription(PoseWithCovarianceStamped, 'localizer/pose', self.on_pose, 10)
        number, first = np.unique(np.concatenate([n for n, _, _ in self.views]), return_index=True)
        xyz = np.concatenate([xyz for _, _, xyz in self.views])[first]
        landmarks = cloud(number, x=xyz[:, 0], y=xyz[:, 1], z=xyz[:, 2])
        landmarks.header.frame_id = 'world'
        self.landmarks.publish(landmarks)
        self.create_timer(0.5, self.publish_view)

    def publish_view(self) -> None:
        """Publish the image points of the first view that has no pose, under the present time."""
        number, uv, _ = self.views[0]
        message = cloud(number, u=uv[:, 0], v=uv[:, 1])
        message.header.frame_id = 'camera_optical_frame'
        message.header.stamp = self.stamp = self.get_clock().now().to_msg()
        self.points.publish(message)

    def on_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Print the position and its standard error; publish the next view or end."""
        if message.header.stamp != self.stamp:
            return  # of an earlier attempt
        p = message.pose.pose.position
        sigma = 1e3 * np.sqrt(message.pose.covariance[0::7][:3])
        print(
            f'x = {p.x:.4f} m, y = {p.y:.4f} m, z = {p.z:.4f} m; '
            f'standard errors {sigma.round(2)} mm',
            flush=True,
        )
        del self.views[0]
        if not self.views:
            raise SystemExit
        self.publish_view()


def main() -> None:
    """Run until the last pose has come."""
    rclpy.init()
    try:
        rclpy.spin(Detector())
    except (KeyboardInterrupt, ExternalShutdownException, SystemExit):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == '__main__':
    main()
