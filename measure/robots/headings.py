"""Headings that hold a robot's names with something before and behind them, or by place alone."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

_SEPARATORS = "/_.:- "
_LEAST_LETTERS = 5  # of a name that is sought inside others; `q1` is part of too many
_OTHER_QUANTITY = re.compile(
    r"vel|speed|rate|acc|eff|torque|current|temp|target|command|desired|error"
)
_BY_PLACE = re.compile(r"(?:.*[/.])?position[_.\[/]?\d+\]?")


def affixes(names: Sequence[str], there: Sequence[str]) -> list[tuple[str, str]]:
    """What stands before and behind all of `names` in headings: `left_`, or `/js/` and `/position`.

    Of several that say which quantity they are, those of positions.
    """
    if any(len(name) < _LEAST_LETTERS for name in names):
        return []
    held = set(there)
    found = [
        (before, behind)
        for before, behind in _around(names[0], there)
        if held.issuperset(f"{before}{name}{behind}" for name in names)
        and not _OTHER_QUANTITY.search(behind.lower())
    ]
    stated = [pair for pair in found if "pos" in pair[1].lower()]
    return stated or found


def _around(name: str, there: Sequence[str]) -> Iterator[tuple[str, str]]:
    for heading in there:
        before, inside, behind = heading.partition(name)
        if (
            inside
            and (not before or before[-1] in _SEPARATORS)
            and (not behind or behind[0] in _SEPARATORS)
        ):
            yield before, behind


def by_place(there: Sequence[str]) -> list[str]:
    """Headings that number the positions of a message, whose order they do not say."""
    return [name for name in there if _BY_PLACE.fullmatch(name)]
