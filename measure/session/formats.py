"""Files of other programs: packages beside this one read and write them.

Each declares a `Format` by an entry point of the group `measure.formats`. Content distinguishes
files: a reader returns None for what is not its own, and only then the next one is asked.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from measure.errors import ConfigError, MeasureError
from measure.neighbours import FORMATS, lacking, offers
from measure.session.calibration_file import Calibration
from measure.session.stated_rig import StatedRig
from measure.session.streams import Stream
from measure.session.timestamps import Stamps
from measure.session.tracked_body import TrackedBody


@dataclass(frozen=True)
class Format:
    """A format, and what can be done with it.

    Attributes:
        name: how a command's `--format` chooses it.
        does: what it is, for whom, in a line.
        read_calibration: takes a file's path and text (none of a bag), and gives its rig;
            CalibrationError: it is of this format, and broken.
        read_truth: takes path, text and a class of errors, and gives the rigid bodies by name; an
            error of that class: it is of this format, and broken.
        open_pictures: takes a camera's name, `file#topic` of a bag of ROS, its stamps or None with
            the file they are from, and an offset in s; gives its stream.
        write_calibration: takes a path and a calibration.
        write_run: takes runs, a path and, if it `holds_velocity`, their velocities or nothing.
        holds_poses: whether a run written in it holds poses, which can be smoothed.
        holds_velocity: whether it has a place for velocities.
        extra: of this program, that must be installed to write it.
    """

    name: str
    does: str
    read_calibration: Callable[[Path, str], StatedRig | None] | None = None
    read_truth: (
        Callable[[Path, str, type[MeasureError]], Mapping[str, TrackedBody] | None] | None
    ) = None
    open_pictures: Callable[[str, Path, Stamps | None, Path | None, float], Stream] | None = None
    write_calibration: Callable[[Path, Calibration], None] | None = None
    write_run: Callable[..., None] | None = None
    holds_poses: bool = True
    holds_velocity: bool = False
    extra: str = ""


@cache
def formats() -> Mapping[str, Format]:
    """All formats by name."""
    return {one.name: one for _, one in offers(FORMATS)}


def able(action: str) -> dict[str, Any]:
    """By the formats' names, what those that can do it do: such as all `write_run`."""
    found = {name: getattr(one, action) for name, one in formats().items()}
    return {name: doing for name, doing in found.items() if doing is not None}


def format_for(action: str, name: str) -> Format:
    """The format of this name; ConfigError: none of those that can do this is called so."""
    known = able(action)
    if not known:
        raise lacking("files of other programs", "measure_formats")
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean {near[0]}?" if near else f"there is {', '.join(known)}"
        what = "export format" if action == "write_run" else "format of calibrations"
        raise ConfigError(f"no {what} is called '{name}'; {hint}")
    return formats()[name]
