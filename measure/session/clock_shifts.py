"""Clock offsets of a refined calibration, applied to the recording it was refined from.

A clock's offset differs from recording to recording, so it is added to the stamps it was estimated
from only.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from measure.errors import CalibrationError
from measure.session.streams import Stream


def clock_digest(streams: Iterable[Stream]) -> str:
    """A fingerprint of all cameras' stamps."""
    found = hashlib.sha256()
    for stream in streams:
        found.update(stream.name.encode() + stream.frames.tobytes() + stream.times_s.tobytes())
    return found.hexdigest()


def clock_values(digest: str, shifts_s: Mapping[str, float]) -> dict[str, object]:
    """The entries on clocks in a calibration's provenance; `shift_clocks` reads them."""
    return {"clock_digest": digest, "clock_shifts_s": dict(shifts_s)} if shifts_s else {}


def shift_clocks(
    streams: Mapping[str, Stream], digest: str, provenance: Mapping[str, Any], path: Path
) -> dict[str, float]:
    """Add the clock offsets of a calibration to the stamps.

    Args:
        streams: by camera; their times are changed.

    Returns:
        What was added, by camera; empty if the calibration is not from these stamps.

    Raises:
        CalibrationError: an offset is no number.
    """
    if provenance.get("clock_digest") != digest:
        return {}
    try:
        offsets = {str(n): float(s) for n, s in dict(provenance["clock_shifts_s"]).items()}
    except (KeyError, TypeError, ValueError):
        raise CalibrationError(
            f"{path}: provenance.clock_shifts_s must name cameras and seconds; refine again, or "
            "remove clock_digest"
        ) from None
    shifts = {name: seconds for name, seconds in offsets.items() if name in streams}
    for name, seconds in shifts.items():
        streams[name].times_s = streams[name].times_s + seconds
    return shifts


def shift_notes(shifts_s: Mapping[str, float]) -> tuple[str, ...]:
    """A line for the user, if anything was added."""
    if not shifts_s:
        return ()
    offsets = ", ".join(f"{name} {1e3 * seconds:+.1f} ms" for name, seconds in shifts_s.items())
    return (f"clocks set right as the calibration found them: {offsets}",)
