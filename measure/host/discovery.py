"""Finding plugins, one entry point at a time; a broken stranger stops nobody."""

from __future__ import annotations

import inspect
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from importlib import metadata

import pluggy

from measure.host import hooks
from measure.host.interfaces import Plugin
from measure.host.settings import Settings


@dataclass(frozen=True)
class Distribution:
    """What a user installed: name and version of the distribution a plugin came in."""

    name: str
    version: str

    def __str__(self) -> str:
        return f"{self.name} {self.version}"


@dataclass(frozen=True)
class Loaded:
    """A plugin that can be used."""

    kind: str
    name: str
    distribution: Distribution
    plugin: type[Plugin]


@dataclass(frozen=True)
class Broken:
    """An entry point that cannot be used, and why, in one line."""

    name: str
    distribution: Distribution
    error: str


def discover(disabled: Collection[str] = ()) -> list[Loaded | Broken]:
    """Load every entry point of the group "measure".

    Args:
        disabled: names of entry points or distributions to leave out, without importing them.
    """
    manager = pluggy.PluginManager("measure")
    manager.add_hookspecs(hooks)
    found: list[Loaded | Broken] = []
    for distribution, entry_point in _entry_points():
        if entry_point.name in disabled or distribution.name in disabled:
            continue
        try:
            found += _load(manager, distribution, entry_point)
        except (Exception, SystemExit) as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            found.append(Broken(entry_point.name, distribution, reason))
    return found


def _entry_points() -> Iterator[tuple[Distribution, metadata.EntryPoint]]:
    seen: set[str] = set()
    for installed in metadata.distributions():
        name = str(installed.metadata["Name"])
        if (
            name in seen
        ):  # found again further down the path: the first one is the one that is imported
            continue
        seen.add(name)
        for entry_point in installed.entry_points:
            if entry_point.group == hooks.ENTRY_POINT_GROUP:
                yield Distribution(name, installed.version), entry_point


def _load(
    manager: pluggy.PluginManager, distribution: Distribution, entry_point: metadata.EntryPoint
) -> Iterable[Loaded]:
    module = entry_point.load()
    identity = f"{distribution.name}:{entry_point.name}"
    manager.register(module, identity)
    try:
        manager.check_pending()
        loaded = [
            Loaded(kind.name, plugin.name, distribution, plugin)
            for kind in hooks.KINDS
            for plugin in _registered(manager, kind, module)
        ]
        if not loaded:
            raise TypeError(
                f"implements none of the hooks {', '.join(kind.hook for kind in hooks.KINDS)}"
            )
    except Exception:
        manager.unregister(module)
        raise
    return loaded


def _registered(
    manager: pluggy.PluginManager, kind: hooks.Kind, module: object
) -> Iterator[type[Plugin]]:
    others = [plugin for plugin in manager.get_plugins() if plugin is not module]
    for classes in manager.subset_hook_caller(kind.hook, others)():
        if not isinstance(classes, list):
            raise TypeError(f"{kind.hook}() must return a list of classes, got {classes!r}")
        for plugin in classes:
            _check_class(kind, plugin)
            yield plugin


def _check_class(kind: hooks.Kind, plugin: object) -> None:
    if not (inspect.isclass(plugin) and issubclass(plugin, kind.interface)):
        raise TypeError(
            f"{kind.hook}() returned {plugin!r}, which is not a {kind.interface.__name__} class"
        )
    if missing := sorted(getattr(plugin, "__abstractmethods__", ())):
        raise TypeError(f"{plugin.__name__} lacks {', '.join(missing)}")
    if not isinstance(getattr(plugin, "name", None), str) or not plugin.name:
        raise TypeError(f"{plugin.__name__} has no name")
    if not (inspect.isclass(plugin.Config) and issubclass(plugin.Config, Settings)):
        raise TypeError(f"{plugin.__name__}.Config is not a subclass of measure.host.Settings")
