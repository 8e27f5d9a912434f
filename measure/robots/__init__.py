"""What a robot's state means, and its kinematics: for estimators, data sets and models."""

from measure.robots.chain import Joint, SerialChain, dh_link
from measure.robots.schema import Feature, Reading, RobotLog, StateSchema

__all__ = ["Feature", "Joint", "Reading", "RobotLog", "SerialChain", "StateSchema", "dh_link"]
