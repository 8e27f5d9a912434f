"""`measure prepare`: compile now what is compiled at the first measurement otherwise."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from measure import api
from measure.api.profiles import DEFAULT_PROFILE
from measure.cli import console
from measure.cli.options import InjectedRegistry
from measure.errors import PluginError


def prepare(*, registry: InjectedRegistry) -> None:
    """Compile the numerical code now, for container images and shared installations.

    It runs the demonstration with each profile. Whoever may write the installation does it once;
    all users of it, on processors of this kind, start without waiting.
    """
    for name in sorted(api.profile_names(), key=lambda name: name != DEFAULT_PROFILE):
        try:
            with TemporaryDirectory() as folder, console.progress(name, "steps") as report:
                api.demo(Path(folder), api.load_profile(name), registry, 10, report)
        except PluginError as error:
            if name == DEFAULT_PROFILE:
                raise
            console.print_text(f"left out profile {name}: {error}")
    console.print_text("compiled: measurements begin at once from now on")
