"""Robots: what their states mean, their kinematics, and a simulated cable-driven arm."""

from measure.robots.chain import Joint, SerialChain, dh_link
from measure.robots.logs import (
    ROBOT_KEY,
    LogFile,
    check_robot,
    find_schema,
    log_pieces,
    read_log,
    write_log,
)
from measure.robots.psm import psm_schema
from measure.robots.raven import raven_chain, raven_schema
from measure.robots.schema import Feature, Reading, RobotLog, StateLog, StateSchema

__all__ = [
    "ROBOT_KEY", "Feature", "Joint", "LogFile", "Reading", "RobotLog", "SerialChain", "StateLog",
    "StateSchema", "check_robot", "dh_link", "find_schema", "log_pieces", "psm_schema",
    "raven_chain", "raven_schema", "read_log", "write_log",
]  # fmt: skip
