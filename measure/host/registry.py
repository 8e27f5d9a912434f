"""Finding plugins, one entry point at a time; the registry refuses what it cannot give."""

from __future__ import annotations

import difflib
import inspect
import re
import sys
import traceback
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar, cast

import pluggy

from measure.errors import MeasureError, PluginError
from measure.host import hooks
from measure.host.interfaces import NAME, Estimator, Plugin
from measure.host.settings import Settings, read_settings

P = TypeVar("P", bound=Plugin)


@dataclass(frozen=True)
class Distribution:
    """What a user installed."""

    name: str  # as pip knows it
    version: str  # as pip knows it

    def __str__(self) -> str:
        return f"{self.name} {self.version}"


@dataclass(frozen=True)
class Loaded:
    """A plugin that can be used."""

    kind: str  # "detector", "triangulator", "solver", "estimator" or "sink"
    name: str  # the class's `name`
    distribution: Distribution  # the installed distribution that it came in
    plugin: type[Plugin]  # the class


@dataclass(frozen=True)
class Broken:
    """An entry point that cannot be used."""

    name: str  # of the entry point
    distribution: Distribution  # the installed distribution that declares it
    error: str  # why, in one line


def discover(disabled: Collection[str] = ()) -> list[Loaded | Broken]:
    """Load every entry point of the group "measure".

    PluginError: a name in `disabled` is nobody's (with near names).

    Args:
        disabled: what to leave out: names of entry points or distributions, which are then not even
            imported, or of single plugins. Case, "-", "_" and "." make no difference.
    """
    left_out = {_canonical(name): name for name in disabled}
    known: set[str] = set()
    manager = pluggy.PluginManager("measure")
    manager.add_hookspecs(hooks)
    found: list[Loaded | Broken] = []
    for distribution, entry_point in _entry_points():
        names = {_canonical(entry_point.name), _canonical(distribution.name)}
        known |= names
        if names & left_out.keys():
            continue
        try:
            # What is printed meanwhile is no result of the command's.
            with redirect_stdout(sys.stderr):
                found += _load(manager, distribution, entry_point)
        except (Exception, SystemExit) as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            found.append(Broken(entry_point.name, distribution, reason))
    known |= {_canonical(item.name) for item in found}
    for name in left_out.keys() - known:
        hint = suggestion(name, known, "plugin")
        raise PluginError(f"cannot disable '{left_out[name]}': there is no such plugin; {hint}")
    return [item for item in found if _canonical(item.name) not in left_out]


def origin(plugin: type[Plugin]) -> Distribution | None:
    """The distribution that a plugin's package belongs to; None if that is not plain."""
    package = plugin.__module__.partition(".")[0]
    owners = {
        distribution
        for distribution, entry_point in _entry_points()
        if re.split(r"[.:]", entry_point.value.strip(), maxsplit=1)[0] == package
    }
    return owners.pop() if len(owners) == 1 else None


def suggestion(name: str, known: Collection[str], what: str) -> str:
    """Half a sentence for who mistyped `name`: near names, or all there are."""
    if near := difflib.get_close_matches(name, known, n=3):
        return f"did you mean {' or '.join(repr(n) for n in near)}?"
    return f"there is {', '.join(sorted(known))}" if known else f"no {what} is installed"


def _canonical(name: str) -> str:
    """Names as the packaging tools compare them."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _entry_points() -> Iterator[tuple[Distribution, metadata.EntryPoint]]:
    """Of a name that is found again further down the path the first is taken, as it is imported."""
    owners: dict[metadata.Distribution, Distribution] = {}
    for entry_point in metadata.entry_points(group=hooks.ENTRY_POINT_GROUP):
        installed = entry_point.dist
        if installed is not None and (installed in owners or (name := _name(installed))):
            if installed not in owners:
                owners[installed] = Distribution(name, installed.version)
            yield owners[installed], entry_point


def _name(installed: metadata.Distribution) -> str:
    """The name of a distribution; the remains of an interrupted installation have none."""
    try:
        found = installed.metadata  # None, or an error once anybody has loaded importlib_metadata
    except FileNotFoundError:
        return ""
    return str(found["Name"] or "") if found else ""


def _load(
    manager: pluggy.PluginManager, distribution: Distribution, entry_point: metadata.EntryPoint
) -> Iterable[Loaded]:
    module = entry_point.load()
    identity = f"{distribution.name}:{entry_point.name}"
    try:
        manager.register(module, identity)
        manager.check_pending()
        loaded = [
            Loaded(kind.name, plugin.name, distribution, plugin)
            for kind in hooks.KINDS
            for plugin in _registered(manager, kind, module)
        ]
        if not loaded:
            raise TypeError(
                f"implements none of the hooks {', '.join(kind.hook for kind in hooks.KINDS)} "
                "(a hook is a function of that name, decorated with measure.host.hookimpl)"
            )
    except BaseException:
        if manager.has_plugin(identity):
            manager.unregister(name=identity)
        raise
    return loaded


def _registered(
    manager: pluggy.PluginManager, kind: hooks.PluginKind, module: object
) -> Iterator[type[Plugin]]:
    others = [plugin for plugin in manager.get_plugins() if plugin is not module]
    for classes in manager.subset_hook_caller(kind.hook, others)():
        if not isinstance(classes, list):
            raise TypeError(f"{kind.hook}() must return a list of classes, got {classes!r}")
        for plugin in classes:
            _check_class(kind, plugin)
            yield plugin


def _check_class(kind: hooks.PluginKind, plugin: object) -> None:
    if not (inspect.isclass(plugin) and issubclass(plugin, kind.interface)):
        raise TypeError(
            f"{kind.hook}() returned {plugin!r}, which is not a {kind.interface.__name__} class"
        )
    if missing := sorted(getattr(plugin, "__abstractmethods__", ())):
        raise TypeError(f"{plugin.__name__} lacks {', '.join(missing)}")
    if not isinstance(getattr(plugin, "name", None), str) or not plugin.name:
        raise TypeError(f"{plugin.__name__} has no name")
    if not NAME.fullmatch(plugin.name):
        raise TypeError(
            f"{plugin.__name__} is called {plugin.name!r}: lower case, words joined by -"
        )
    if not (inspect.isclass(plugin.Config) and issubclass(plugin.Config, Settings)):
        raise TypeError(f"{plugin.__name__}.Config is not a subclass of measure.host.Settings")


class Registry:
    """All plugins of this environment. Built once by whoever starts a command, and passed on."""

    def __init__(self, found: Sequence[Loaded | Broken]) -> None:
        self.loaded = [item for item in found if isinstance(item, Loaded)]
        self.broken = [item for item in found if isinstance(item, Broken)]

    @classmethod
    def discover(cls, disabled: Collection[str] = ()) -> Registry:
        """Look at every installed distribution, leaving out what is `disabled` (see `discover`)."""
        return cls(discover(disabled))

    def names(self, kind: str) -> list[str]:
        """Names of all usable plugins of a kind, sorted."""
        return sorted({item.name for item in self.loaded if item.kind == kind})

    def find(self, kind: str, name: str) -> Loaded:
        """The one plugin of this kind and name.

        PluginError: unknown (with near names), broken (with the reason), or two distributions claim
        it.
        """
        matches = [item for item in self.loaded if item.kind == kind and item.name == name]
        if len(matches) > 1:
            owners = " and ".join(str(item.distribution) for item in matches)
            raise PluginError(
                f"{kind} '{name}' is offered by {owners}: "
                "uninstall one, or leave one out with --disable DISTRIBUTION"
            )
        if matches:
            return matches[0]
        for item in self.broken:
            if item.name == name:
                raise PluginError(f"{kind} '{name}' of {item.distribution} is broken: {item.error}")
        raise PluginError(
            f"no {kind} is called '{name}'; {suggestion(name, self.names(kind), kind)}"
        )

    def named(self, name: str) -> list[Loaded | Broken]:
        """Every plugin of this name, whatever its kind, and broken entry points called so.

        PluginError: there is none (with near names).
        """
        everything: list[Loaded | Broken] = [*self.loaded, *self.broken]
        if found := [item for item in everything if item.name == name]:
            return found
        known = sorted({item.name for item in everything})
        raise PluginError(f"no plugin is called '{name}'; {suggestion(name, known, 'plugin')}")

    def clashes(self) -> list[tuple[Loaded, ...]]:
        """Groups of plugins that claim one kind and name."""
        groups: dict[tuple[str, str], list[Loaded]] = {}
        for item in self.loaded:
            groups.setdefault((item.kind, item.name), []).append(item)
        return [tuple(group) for group in groups.values() if len(group) > 1]

    def build(
        self, interface: type[P], name: str, settings: Mapping[str, Any], **context: Any
    ) -> P:
        """Build the plugin of that name and of the kind whose interface is given (`Detector`, ...).

        `context` is what its class takes beside its settings: `body` and `camera` of a detector,
        `body` of a solver, `address` and `run` of a sink. PluginError: as `find`; or it cannot be
        built, or refuses the body. ConfigError: the settings, or a sink's address, do not fit.
        An estimator "A after B" learns what B leaves; the settings are those of A.
        """
        kind = next(kind.name for kind in hooks.KINDS if kind.interface is interface)
        last, after, first = name.partition(" after ")
        if after:
            built, before = self.build(interface, last, settings), self.build(interface, first, {})
            if isinstance(built, Estimator) and isinstance(before, Estimator):
                return built.after(before)
            raise PluginError(f"{kind} '{last}' cannot learn what '{first}' leaves")
        loaded = self.find(kind, name)
        config = read_settings(loaded.plugin.Config, settings, f"{kind} '{name}'")
        plugin: Any = loaded.plugin
        try:
            with redirect_stdout(sys.stderr):
                return cast("P", plugin(config, **context))
        except MeasureError:
            raise
        except Exception as error:
            raise PluginError(
                f"{kind} '{name}' of {loaded.distribution} cannot be built: "
                f"{type(error).__name__}: {error}"
            ) from error


def failure(kind: str, plugin: Plugin, place: str, error: Exception) -> PluginError:
    """The error to raise from a plugin's own; `place` is what it was doing, or where."""
    distribution = origin(type(plugin))
    owner = "" if distribution is None else f" of {distribution}"
    reason = " ".join(f"{type(error).__name__}: {error}".split())
    return PluginError(
        f"{kind} '{plugin.name}'{owner} fails ({place}): {reason} ({_line(plugin, error)})"
    )


@contextmanager
def named(kind: str, plugin: Plugin, place: str) -> Iterator[None]:
    """Name a plugin that fails in here; PluginError: it fails."""
    try:
        yield
    except MeasureError:
        raise
    except Exception as error:
        raise failure(kind, plugin, place, error) from error


def _line(plugin: Plugin, error: Exception) -> str:
    """The plugin's own line that led to an error; the last of all, if none is its own."""
    stack = list(traceback.walk_tb(error.__traceback__))
    module = type(plugin).__module__
    package = module.rpartition(".")[0] or module
    names = [(step, f"{step[0].f_globals.get('__name__', '')}.") for step in stack]
    own = [step for step, name in names if name.startswith(f"{package}.")]
    frame, line = (own or stack)[-1]
    return f"{Path(frame.f_code.co_filename).name}, line {line}"
