"""All a plugin author needs to read: interfaces, the hooks, and how plugins are found."""

from measure.host.dataset import Dataset, Turns
from measure.host.hooks import ENTRY_POINT_GROUP, hookimpl
from measure.host.interfaces import (
    Conclusion,
    Correction,
    Detector,
    Epoch,
    Estimator,
    EventMark,
    LeftOut,
    Plugin,
    PoseSolver,
    RecordingLeftOut,
    Report,
    Review,
    SelfCalibratingDetector,
    SentPose,
    SentRun,
    Sink,
    Tracker,
    Triangulator,
    host_port,
    quiet,
)
from measure.host.messages import plain_name, plain_names
from measure.host.registry import Broken, Distribution, Loaded, Registry, discover
from measure.host.settings import Setting, Settings, describe_settings, setting
from measure.processes import needed

__all__ = [
    "ENTRY_POINT_GROUP", "Broken", "Conclusion", "Correction", "Dataset", "Detector",
    "Distribution", "Epoch", "Estimator", "EventMark", "LeftOut", "Loaded", "Plugin", "PoseSolver",
    "RecordingLeftOut", "Registry", "Report", "Review", "SelfCalibratingDetector", "SentPose",
    "SentRun", "Setting", "Settings", "Sink", "Tracker", "Triangulator", "Turns",
    "describe_settings", "discover", "hookimpl", "host_port", "needed", "plain_name", "plain_names",
    "quiet", "setting",
]  # fmt: skip
