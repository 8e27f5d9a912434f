"""The registry: plugins by kind and name, refusing what is unknown, broken or ambiguous."""

from __future__ import annotations

import sys
from collections.abc import Collection, Mapping, Sequence
from contextlib import redirect_stdout
from typing import Any, cast

from measure.errors import MeasureError, PluginError
from measure.host.discovery import Broken, Loaded, discover, suggestion
from measure.host.estimator import Estimator
from measure.host.interfaces import Detector, Plugin, PoseSolver, Triangulator
from measure.host.settings import read_settings
from measure.model import Body, Camera


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

        Raises:
            PluginError: unknown (with near names), broken (with the reason), or two distributions
                claim it.
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

        Raises:
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

    def detector(
        self, name: str, settings: Mapping[str, Any], body: Body, camera: Camera
    ) -> Detector:
        """Build a detector for one camera.

        Raises:
            PluginError: as `find`; or the plugin cannot be built, or refuses the body.
            ConfigError: the settings do not fit.
        """
        return cast("Detector", self._build("detector", name, settings, body=body, camera=camera))

    def triangulator(self, name: str, settings: Mapping[str, Any]) -> Triangulator:
        """Build a triangulator; raises as `detector` does."""
        return cast("Triangulator", self._build("triangulator", name, settings))

    def solver(self, name: str, settings: Mapping[str, Any], body: Body) -> PoseSolver:
        """Build a pose solver; raises as `detector` does."""
        return cast("PoseSolver", self._build("solver", name, settings, body=body))

    def estimator(self, name: str, settings: Mapping[str, Any]) -> Estimator:
        """Build an estimator; raises as `detector` does."""
        return cast("Estimator", self._build("estimator", name, settings))

    def _build(self, kind: str, name: str, settings: Mapping[str, Any], **context: Any) -> Plugin:
        loaded = self.find(kind, name)
        config = read_settings(loaded.plugin.Config, settings, f"{kind} '{name}'")
        plugin: Any = loaded.plugin
        try:
            with redirect_stdout(sys.stderr):
                return cast("Plugin", plugin(config, **context))
        except MeasureError:
            raise
        except Exception as error:
            raise PluginError(
                f"{kind} '{name}' of {loaded.distribution} cannot be built: "
                f"{type(error).__name__}: {error}"
            ) from error
