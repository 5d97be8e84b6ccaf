"""Scripts of nodes for tests that run several processes."""

HEAD = """
import hashlib, sys
import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Float64, String
rclpy.init()
node = Node(sys.argv[1])
latched = QoSProfile(depth=3, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""

SEND_CLOUD = HEAD + """
points = np.random.default_rng(7).normal(size=(43_691, 3))  # 1 MB of them
publisher = node.create_publisher(PointCloud2, 'cloud', latched)
fields = [PointField(name=n, offset=8 * i, datatype=PointField.FLOAT64, count=1)
          for i, n in enumerate('xyz')]
publisher.publish(PointCloud2(height=1, width=len(points), fields=fields, point_step=24,
                              row_step=points.nbytes, data=points.tobytes(), is_dense=True))
print('sent', points.nbytes, hashlib.sha256(points.tobytes()).hexdigest(), flush=True)
rclpy.spin(node)
"""

RECEIVE_CLOUD = HEAD + """
def receive(cloud):
    points = np.frombuffer(cloud.data, np.float64).reshape(-1, 3)
    print('received', points.nbytes, hashlib.sha256(points.tobytes()).hexdigest(),
          cloud.fields[2].name, cloud.width, cloud.is_dense, flush=True)
node.create_subscription(PointCloud2, 'cloud', receive, latched)
rclpy.spin(node)
"""
