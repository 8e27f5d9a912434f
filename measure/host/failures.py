"""A plugin that fails while it works, in one line."""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from measure.errors import MeasureError, PluginError
from measure.host.interfaces import Plugin


def failure(kind: str, plugin: Plugin, place: str, error: Exception) -> PluginError:
    """What to raise from `error`.

    Args:
        kind: of the plugin.
        plugin: that failed.
        place: what it was doing, or where.
        error: its own, which no plugin should let out.
    """
    last = traceback.extract_tb(error.__traceback__)[-1]
    reason = " ".join(f"{type(error).__name__}: {error}".split())
    return PluginError(
        f"{kind} '{plugin.name}' fails ({place}): {reason} "
        f"({Path(last.filename).name}, line {last.lineno})"
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
