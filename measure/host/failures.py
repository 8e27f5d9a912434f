"""A plugin that fails while it works, in one line."""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from measure.errors import MeasureError, PluginError
from measure.host.discovery import origin
from measure.host.interfaces import Plugin


def failure(kind: str, plugin: Plugin, place: str, error: Exception) -> PluginError:
    """The error to raise from a plugin's own.

    Args:
        kind: of the plugin.
        plugin: that failed.
        place: what it was doing, or where.
        error: its own, which no plugin should let out.
    """
    distribution = origin(type(plugin))
    owner = "" if distribution is None else f" of {distribution}"
    reason = " ".join(f"{type(error).__name__}: {error}".split())
    return PluginError(
        f"{kind} '{plugin.name}'{owner} fails ({place}): {reason} ({_line(plugin, error)})"
    )


@contextmanager
def named(kind: str, plugin: Plugin, place: str) -> Iterator[None]:
    """Name a plugin that fails in here.

    Raises:
        PluginError: it fails.
    """
    try:
        yield
    except MeasureError:
        raise
    except Exception as error:
        raise failure(kind, plugin, place, error) from error


def _line(plugin: Plugin, error: Exception) -> str:
    """The plugin's own line that led to an error; the last of all, if none is its own."""
    stack = list(traceback.walk_tb(error.__traceback__))
    package = _package(type(plugin).__module__)
    own = [step for step in stack if _package(step[0].f_globals.get("__name__", "")) == package]
    frame, line = (own or stack)[-1]
    return f"{Path(frame.f_code.co_filename).name}, line {line}"


def _package(module: str) -> str:
    return module.partition(".")[0]
