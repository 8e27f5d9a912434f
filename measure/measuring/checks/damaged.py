"""Pictures that are damaged, and decode all the same."""

from __future__ import annotations

from collections.abc import Sequence

from measure.measuring.checks.finding import Finding, Level

_NAMED = 8


def damage_findings(camera: str, frames: Sequence[int], count: int) -> list[Finding]:
    """One line if pictures are damaged.

    Args:
        camera: its name.
        frames: the numbers of those that are.
        count: how many pictures were looked at.
    """
    if not frames:
        return []
    named = ", ".join(map(str, frames[:_NAMED])) + (", ..." if len(frames) > _NAMED else "")
    which = "frames" if len(frames) > 1 else "frame"
    text = (
        f"{camera}: {len(frames)} of {count} pictures are damaged ({which} {named}): a part is "
        "missing, and what decodes in its place is grey or shifted; copy them again from where "
        "they were recorded, or remove the files, and their frames count as missing"
    )
    return [Finding(Level.WRONG, "frames", text)]
