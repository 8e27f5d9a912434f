"""A ROS 1 node: the corrected tip on `corrected`, for each message of joint states.

`python3 ros1_node.py _joints:="[shoulder_pan_joint, ...]"`
"""

import rospy
from corrector import Corrector, correct, state_of
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from sensor_msgs.msg import JointState


class TipNode:
    """Joins the joints and the reported tip to a state, and publishes the corrected tip."""

    def __init__(self):
        self._names = rospy.get_param("~joints")
        self._corrector, self._tip = Corrector(port=rospy.get_param("~port", 47118)), None
        self._out = rospy.Publisher("corrected", PoseWithCovarianceStamped, queue_size=1)
        rospy.Subscriber("tip", PoseStamped, self.on_tip, tcp_nodelay=True)
        rospy.Subscriber("joint_states", JointState, self.on_joints, tcp_nodelay=True)

    def on_tip(self, message):
        """Keep the newest reported tip."""
        self._tip = message

    def on_joints(self, message):
        """Correct the tip of this instant."""
        place = self._tip and self._tip.pose.position
        tip_mm = place and [1e3 * place.x, 1e3 * place.y, 1e3 * place.z]
        state = state_of(self._names, message, tip_mm)
        answer = state and self._corrector.ask(state, message.header.stamp.to_sec())
        if answer:
            self._out.publish(correct(PoseWithCovarianceStamped(), self._tip, answer))


if __name__ == "__main__":
    rospy.init_node("triball_tip")
    TipNode()
    rospy.spin()
