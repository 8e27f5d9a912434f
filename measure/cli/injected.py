"""What a command is given rather than typed by the user."""

from __future__ import annotations

from typing import Annotated, TypeAlias

from cyclopts import Parameter

from measure.host import Registry

InjectedRegistry: TypeAlias = Annotated[Registry, Parameter(parse=False)]
"""Type of a command's keyword `registry`: all plugins but those left out with `--disable`."""
