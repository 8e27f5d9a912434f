"""`measure plugins`: installed plugins, their settings, and what is broken."""

from __future__ import annotations

import inspect
from typing import Any

from cyclopts import App

from measure.cli import console
from measure.cli.console import JsonFlag
from measure.cli.options import InjectedRegistry
from measure.host import Broken, Loaded, Registry, describe_settings

plugins = App(name="plugins", help="List and describe the installed plugins.")


@plugins.default
def list_(*, json: JsonFlag = False, registry: InjectedRegistry) -> None:
    """List all plugins, broken ones with the reason."""
    if json:
        console.print_json(_listing(registry))
        return
    rows = [(p.kind, p.name, str(p.distribution), _summary(p)) for p in _sorted(registry)]
    console.print_table(("kind", "name", "distribution", "does"), rows)
    for broken in registry.broken:
        console.print_text(f"broken: {broken.name} of {broken.distribution}: {broken.error}")
    for clash in registry.clashes():
        owners = " and ".join(str(item.distribution) for item in clash)
        console.print_text(f"clash: {clash[0].kind} '{clash[0].name}' is offered by {owners}")


plugins.command(list_, name="list")


@plugins.command
def show(name: str, /, *, json: JsonFlag = False, registry: InjectedRegistry) -> None:
    """Describe one plugin and its settings.

    Args:
        name: as listed; every plugin of that name is shown, whatever its kind.
    """
    found = registry.named(name)
    if json:
        console.print_json({"plugins": [_describe(item) for item in found]})
        return
    for item in found:
        _print(item)


def _print(item: Loaded | Broken) -> None:
    if isinstance(item, Broken):
        console.print_text(f"{item.name} of {item.distribution} is broken: {item.error}")
        return
    console.print_text(f"{item.kind} '{item.name}' of {item.distribution}")
    console.print_text(inspect.getdoc(item.plugin) or "")
    rows = [
        (s.name, s.default, s.unit, s.type, s.description)
        for s in describe_settings(item.plugin.Config)
    ]
    if rows:
        console.print_table(("setting", "default", "unit", "type", "what it does"), rows)
    else:
        console.print_text("It has no settings.")


def _listing(registry: Registry) -> dict[str, Any]:
    clashes = [
        {
            "kind": clash[0].kind,
            "name": clash[0].name,
            "distributions": [item.distribution for item in clash],
        }
        for clash in registry.clashes()
    ]
    usable, broken = map(_describe, _sorted(registry)), map(_describe, registry.broken)
    return {"plugins": list(usable), "broken": list(broken), "clashes": clashes}


def _describe(item: Loaded | Broken) -> dict[str, Any]:
    if isinstance(item, Broken):
        return {"name": item.name, "distribution": item.distribution, "error": item.error}
    return {
        "kind": item.kind,
        "name": item.name,
        "distribution": item.distribution,
        "summary": _summary(item),
        "settings": describe_settings(item.plugin.Config),
    }


def _sorted(registry: Registry) -> list[Loaded]:
    return sorted(registry.loaded, key=lambda item: (item.kind, item.name))


def _summary(item: Loaded) -> str:
    """First line of the plugin's own docstring."""
    return (item.plugin.__doc__ or "").strip().partition("\n")[0]
