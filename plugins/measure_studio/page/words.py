"""What the program says, as a page says it: without options, commands, paths and unix times."""

from __future__ import annotations

import os
import re
from datetime import datetime
from pathlib import Path

_UNIX_S = re.compile(r"\b1[5-9]\d{8}\.\d+\b")
_OPTION = re.compile(r"(?:^|\s)`?(?:--[a-z][\w-]*|measure [a-z]+\b)")
_GIVEN = re.compile(r"^--[a-z][\w-]*(?:[ =]\S*)?: ")
"""How a message begins that names the option whose value is wrong."""


def plain(text: str, folder: Path | None = None) -> str:
    """A message for a page.

    Files of the folder go by their names in it, times are those of a clock. A clause (up to a
    semicolon) that names an option or a command is left out if another one remains; else only what
    follows its last colon, if it stands there.
    """
    if folder is not None:
        text = text.replace(f"{folder}{os.sep}", "").replace(str(folder), folder.name)
    text = _GIVEN.sub("", text)
    text = _UNIX_S.sub(_clock, text)
    clauses = text.split("; ")
    left = [clause for clause in clauses if not _OPTION.search(clause)]
    return "; ".join(left or map(_without_command, clauses))


def named(name: str, text: str) -> str:
    """A text of a camera, with its name if that is not in it already."""
    return text if name in text else f"{name}: {text}"


def _without_command(clause: str) -> str:
    """A clause without what follows its last colon, if that names an option or a command."""
    what, _, cure = clause.rpartition(": ")
    return what if what and _OPTION.search(cure) and not _OPTION.search(what) else clause


def _clock(found: re.Match[str]) -> str:
    return f"{datetime.fromtimestamp(float(found[0])):%H:%M:%S.%f}"[:-3]
