"""Distributions that exist only during one test, with entry points of the group "measure"."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from measure.host import Broken, Loaded, discover

Install = Callable[..., None]

DETECTOR = """
from measure.host import Detector, hookimpl

class {cls}(Detector):
    "Finds nothing."
    name = "{name}"

    def detect(self, image, expected):
        return []

@hookimpl
def measure_detectors():
    return [{cls}]
"""


def detector_source(name: str = "blob", cls: str = "Blob") -> str:
    """A module that offers one correct detector."""
    return DETECTOR.format(name=name, cls=cls)


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Install a distribution: `install("acme", source)`; its module is called like it.

    `offers` is an object of the module that another `group` than that of plugins names.
    """
    modules: list[str] = []

    def install(distribution, source, *, entry_point="", version="1.0", group="measure", offers=""):
        module = distribution.lower().replace("-", "_") + "_plugin"
        place = tmp_path / f"site-{len(modules)}"
        info = place / f"{distribution.replace('-', '_')}-{version}.dist-info"
        info.mkdir(parents=True)
        (place / f"{module}.py").write_text(textwrap.dedent(source))
        (info / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: {distribution}\nVersion: {version}\n"
        )
        name = entry_point or distribution
        (info / "entry_points.txt").write_text(f"[{group}]\n{name} = {module}{offers}\n")
        monkeypatch.syspath_prepend(str(place))
        modules.append(module)

    yield install
    for module in modules:
        sys.modules.pop(module, None)


def strangers(**options) -> list[Loaded | Broken]:
    """Everything found but our own."""
    return [item for item in discover(**options) if item.distribution.name != "triball"]


def the_broken(**options) -> Broken:
    """The one stranger, which is broken."""
    (item,) = strangers(**options)
    assert isinstance(item, Broken)
    assert "\n" not in item.error
    return item
