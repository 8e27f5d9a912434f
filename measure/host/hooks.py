"""The hooks. A hook only registers: it returns classes and runs nothing."""

from __future__ import annotations

from dataclasses import dataclass

import pluggy

from measure.host.interfaces import (
    Detector,
    Estimator,
    Plugin,
    PoseSolver,
    Sink,
    Tracker,
    Triangulator,
)

ENTRY_POINT_GROUP = "measure"
"""The group of entry points in which plugins are found."""

hookspec = pluggy.HookspecMarker("measure")
hookimpl = pluggy.HookimplMarker("measure")
"""Decorator of the functions that register plugins (pluggy)."""


@hookspec
def measure_detectors() -> list[type[Detector]]:  # type: ignore[empty-body]
    """Return detector classes."""


@hookspec
def measure_triangulators() -> list[type[Triangulator]]:  # type: ignore[empty-body]
    """Return triangulator classes."""


@hookspec
def measure_pose_solvers() -> list[type[PoseSolver]]:  # type: ignore[empty-body]
    """Return pose-solver classes."""


@hookspec
def measure_trackers() -> list[type[Tracker]]:  # type: ignore[empty-body]
    """Return tracker classes."""


@hookspec
def measure_estimators() -> list[type[Estimator]]:  # type: ignore[empty-body]
    """Return estimator classes."""


@hookspec
def measure_sinks() -> list[type[Sink]]:  # type: ignore[empty-body]
    """Return sink classes."""


@dataclass(frozen=True)
class PluginKind:
    """A kind of plugin: its name for users, its hook, and what its classes must be."""

    name: str
    hook: str
    interface: type[Plugin]


KINDS = (
    PluginKind("detector", "measure_detectors", Detector),
    PluginKind("triangulator", "measure_triangulators", Triangulator),
    PluginKind("solver", "measure_pose_solvers", PoseSolver),
    PluginKind("tracker", "measure_trackers", Tracker),
    PluginKind("estimator", "measure_estimators", Estimator),
    PluginKind("sink", "measure_sinks", Sink),
)
