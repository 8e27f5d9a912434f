"""Which columns of a table hold the time, and in what unit: by their headings."""

from __future__ import annotations

import re
from collections.abc import Sequence

TIME = "time_s"
"""Our own heading."""
_SECONDS_AND_NANOSECONDS = (
    ("secs", "nsecs"),
    ("sec", "nanosec"),
    ("header.stamp.secs", "header.stamp.nsecs"),
    ("header.stamp.sec", "header.stamp.nanosec"),
)
"""What ROS 1 and ROS 2 call the parts of a stamp."""
_UNITS = {
    r"s|secs?|seconds?": 1.0,
    r"ms|msecs?|millis|milliseconds?": 1e-3,
    r"[uµμ]s|usecs?|micros|microseconds?": 1e-6,
    r"ns|nsecs?|nanos|nanoseconds?": 1e-9,
}
_WHOSE = (
    "frame|image|capture|exposure|sensor|camera|device|host|system|recording|elapsed|unix|epoch"
)
_HEADING = re.compile(
    rf"((?:{_WHOSE})[ _.]?)*(?:time[ _]?stamps?|times?|stamps?|ts?)"
    rf"(?:[ _]*[(\[]?(?P<unit>{'|'.join(_UNITS)})[)\]]?)?"
)


TimeColumns = tuple[tuple[int, float], ...]
"""Where the time stands: the sum of columns, each with its position and its unit in s."""


def time_columns(header: Sequence[str], named: str | None = None) -> TimeColumns | None:
    """Find the time by the headings; None if none of them, or several, may be it.

    Args:
        named: the one that holds the time, if that is known.
    """
    if named is not None or TIME in header:
        name = TIME if named is None else named
        return ((header.index(name), _unit_s(name)),) if name in header else None
    for pair in _SECONDS_AND_NANOSECONDS:
        if all(name in header for name in pair):
            return (header.index(pair[0]), 1.0), (header.index(pair[1]), 1e-9)
    found = candidates(header)
    return ((header.index(found[0]), _unit_s(found[0])),) if len(found) == 1 else None


def candidates(header: Sequence[str]) -> list[str]:
    """The headings that may be of times."""
    return [name for name in header if _HEADING.fullmatch(name.lower())]


def _unit_s(heading: str) -> float:
    """The unit that a heading states; seconds if it states none."""
    found = re.search(r"(?:[ _(\[]|time|stamp|ts?)([a-zµμ]+)[)\]]?$", heading.lower())
    unit = found.group(1) if found else ""
    return next((s for names, s in _UNITS.items() if re.fullmatch(names, unit)), 1.0)
