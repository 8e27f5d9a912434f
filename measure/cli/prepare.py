"""`measure prepare`: compile now what is compiled at the first measurement otherwise."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from measure import api
from measure.cli import console
from measure.cli.options import InjectedRegistry


def prepare(*, registry: InjectedRegistry) -> None:
    """Compile the hot loops now: for container images and shared installations.

    It runs the demonstration with each profile. Whoever may write the installation does it once;
    all users of it, on processors of this kind, start without waiting.
    """
    for name in ("precise", "paper"):
        with TemporaryDirectory() as folder, console.progress(name, "steps") as report:
            api.demo(Path(folder), api.load_profile(name), registry, 10, report)
    console.print_text("compiled: measurements begin at once from now on")
