"""Robots: what their states mean, their kinematics, and a simulated cable-driven arm."""

from measure.robots.chain import Joint, SerialChain, dh_link
from measure.robots.logs import (
    ROBOT_KEY,
    LogFile,
    StateLog,
    check_robot,
    feature_columns,
    find_schema,
    is_table,
    log_pieces,
    read_log,
    robot_names,
    write_log,
)
from measure.robots.raven import raven_chain, raven_schema
from measure.robots.schema import Feature, Reading, RobotLog, StateSchema

__all__ = [
    "ROBOT_KEY", "Feature", "Joint", "LogFile", "Reading", "RobotLog", "SerialChain", "StateLog",
    "StateSchema", "check_robot", "dh_link", "feature_columns", "find_schema", "is_table",
    "log_pieces", "raven_chain", "raven_schema", "read_log", "robot_names", "write_log",
]  # fmt: skip
