"""Publishes in ROS 2 the poses that `measure live --send udp://127.0.0.1:5005` sends."""

import json
import socket

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped

rclpy.init()
node = rclpy.create_node("triball")
publisher = node.create_publisher(PoseWithCovarianceStamped, "pose", 10)
receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
receiver.bind(("127.0.0.1", 5005))
scale = [1e-3] * 3 + [1.0] * 3
while rclpy.ok():
    row = json.loads(receiver.recv(65_536))
    if row.get("status") != "ok" or "reference" in row:
        continue
    message = PoseWithCovarianceStamped()
    message.header.frame_id = "world"
    message.header.stamp.sec = int(row["exposed_s"])
    message.header.stamp.nanosec = int(row["exposed_s"] % 1 * 1e9)
    pose = message.pose.pose
    pose.position.x, pose.position.y, pose.position.z = (
        1e-3 * row[n] for n in ("x_mm", "y_mm", "z_mm")
    )
    turn = pose.orientation
    turn.w, turn.x, turn.y, turn.z = (row[n] for n in ("qw", "qx", "qy", "qz"))
    message.pose.covariance = [
        value * scale[k // 6] * scale[k % 6] for k, value in enumerate(row["covariance"])
    ]
    publisher.publish(message)
