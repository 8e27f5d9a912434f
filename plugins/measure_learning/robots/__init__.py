"""Robots' logs in all their formats, descriptions of robots, and the RAVEN-II."""

from measure_learning.robots.logs import (
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
from measure_learning.robots.raven import raven_chain, raven_schema

__all__ = [
    "ROBOT_KEY", "LogFile", "StateLog", "check_robot", "feature_columns", "find_schema", "is_table",
    "log_pieces", "raven_chain", "raven_schema", "read_log", "robot_names", "write_log",
]  # fmt: skip
