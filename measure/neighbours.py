"""Packages that add commands, or something to the demonstration; none is imported to know them.

A package declares itself in the entry-point group `measure.commands` and holds a `commands.toml`:
by group of `measure --help`, its commands, each with its line there. The function, or cyclopts
App, `NAME` of the command NAME stands in the package's module `cli.NAME`.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib import import_module, metadata, util
from pathlib import Path
from typing import Any

from measure.errors import ConfigError, PluginError

COMMANDS, DEMO, FORMATS = "measure.commands", "measure.demo", "measure.formats"
VIEWS, CAMERA_FITS = "measure.views", "measure.camera_fits"
STREAMS = "measure.streams"
"""Groups of entry points: packages with commands, functions that the demonstration calls, formats
of other programs, functions that write further recordings of a run for the viewer, functions
that fit cameras to what they see of a capture, and functions that measure running cameras."""


@dataclass(frozen=True)
class Command:
    """A command of `measure`."""

    name: str  # as typed
    group: str  # its heading in `measure --help`
    line: str  # what it does, in `measure --help`; empty where its package is not installed
    package: str  # that holds it in `cli.NAME`

    @property
    def target(self) -> str:
        """Where its function is, as `MODULE:NAME`."""
        return f"{self.package}.cli.{self.name}:{self.name}"


@cache
def commands() -> dict[str, Command]:
    """All commands by name, in the order of `measure --help`.

    Our own table also holds the places of the commands of packages beside this one, with the
    package's name, so that one that is missing can be named; others' come last in their group. Of
    two packages with one command the first keeps it.
    """
    offered: dict[str, Command] = {}
    for package in sorted({point.value.partition(":")[0] for point in _points(COMMANDS)}):
        for command in _declared(package):
            offered.setdefault(command.name, command)
    placed = {}
    for command in _declared("measure"):
        known = offered.get(command.name) if command.package != "measure" else None
        placed[command.name] = known or command
    titles = list(dict.fromkeys(c.group for c in [*placed.values(), *offered.values()]))
    everything = [*placed.values(), *(c for c in offered.values() if c.name not in placed)]
    return {c.name: c for title in titles for c in everything if c.group == title}


def _declared(package: str) -> Iterator[Command]:
    """The commands of a package's table; PluginError: it has none, or that cannot be read."""
    found = util.find_spec(package)
    places = (found.submodule_search_locations if found else None) or ()
    for place in places:
        path = Path(place, "commands.toml")
        try:
            table = tomllib.loads(path.read_text("utf-8"))
        except (OSError, tomllib.TOMLDecodeError) as problem:
            raise PluginError(f"{path}: the commands of {package}: {problem}") from None
        for group, lines in table.items():
            for name, line in lines.items():
                if isinstance(line, str):
                    yield Command(name, group, line, package)
                else:
                    yield Command(name, group, "", line["from"])


def load_command(name: str) -> Any:
    """The function, or App, of a command; ConfigError: its package is not installed."""
    command = commands()[name]
    if not command.line:
        raise lacking(f"`measure {name}`", command.package)
    module, _, attribute = command.target.partition(":")
    return getattr(import_module(module), attribute)


def names(group: str) -> list[str]:
    """The entry points of a group whose packages are installed."""
    return sorted(point.name for point in _points(group) if _is_there(point))


def offers(group: str) -> Iterator[tuple[str, Any]]:
    """Name and object of each of them, imported now; PluginError: one cannot be imported."""
    for point in sorted(_points(group), key=lambda one: one.name):
        if _is_there(point):
            yield point.name, _loaded(point)


def offer(group: str, name: str, what: str) -> Any:
    """The object of the entry point of this name, or None without one.

    ConfigError: two packages have one, or its package was taken out of the environment.
    PluginError: it cannot be imported.
    """
    points = list(_points(group).select(name=name))
    if len(points) > 1:
        owners = " and of ".join(sorted(map(_owner, points)))
        raise ConfigError(f"{what} is that of {owners}: uninstall one of them")
    for point in points:
        if not _is_there(point):
            raise lacking(what, _package(point))
        return _loaded(point)
    return None


def lacking(what: str, package: str) -> ConfigError:
    """What to say of a package beside this one that is not installed."""
    return ConfigError(
        f"{what} comes with the package {package}, which is not installed here: "
        "pip install --force-reinstall triball"
    )


def _loaded(point: metadata.EntryPoint) -> Any:
    try:
        return point.load()
    except Exception as problem:
        reason = " ".join(f"{type(problem).__name__}: {problem}".split())
        raise PluginError(f"'{point.name}' of {_owner(point)} is broken: {reason}") from problem


def _is_there(point: metadata.EntryPoint) -> bool:
    return util.find_spec(_package(point)) is not None


def _package(point: metadata.EntryPoint) -> str:
    return point.module.partition(".")[0]


def _owner(point: metadata.EntryPoint) -> str:
    return f"{point.dist.name} {point.dist.version}" if point.dist is not None else point.value


def _points(group: str) -> metadata.EntryPoints:
    return metadata.entry_points(group=group)
