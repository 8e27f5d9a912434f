"""A ROS 2 node: the corrected tip on `corrected`, for each message of joint states.

`python3 ros2_node.py --ros-args -p joints:="[shoulder_pan_joint, ...]"`
"""

import rclpy
from corrector import Corrector, correct, state_of
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState


class TipNode(Node):
    """Joins the joints and the reported tip to a state, and publishes the corrected tip."""

    def __init__(self):
        super().__init__("triball_tip")
        self._names = self.declare_parameter("joints", ["q1", "q2"]).value
        port = self.declare_parameter("port", 47118).value
        self._corrector, self._tip = Corrector(port=port), None
        self._out = self.create_publisher(PoseWithCovarianceStamped, "corrected", 10)
        quality = qos_profile_sensor_data
        self.create_subscription(PoseStamped, "tip", self.on_tip, quality)
        self.create_subscription(JointState, "joint_states", self.on_joints, quality)

    def on_tip(self, message):
        """Keep the newest reported tip."""
        self._tip = message

    def on_joints(self, message):
        """Correct the tip of this instant."""
        place = self._tip and self._tip.pose.position
        tip_mm = place and [1e3 * place.x, 1e3 * place.y, 1e3 * place.z]
        state, stamp = state_of(self._names, message, tip_mm), message.header.stamp
        answer = state and self._corrector.ask(state, stamp.sec + 1e-9 * stamp.nanosec)
        if answer:
            self._out.publish(correct(PoseWithCovarianceStamped(), self._tip, answer))


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(TipNode())
