"""Reasons of a run's rows, those alike in one line: by what they say, not by numbers and names."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

_NUMBER = r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.]*\w)"
"""A number that stands alone: not part of a name such as cam0."""


def counted(rows: Iterable[Sequence[str]], names: Iterable[str]) -> dict[str, int]:
    """How many rows give each kind of reason, the commonest first.

    Reasons are of one kind if they differ by numbers or by names of balls and cameras alone. A kind
    is reported with the range of its numbers ("12-15 px") and all of its names.

    Args:
        rows: reasons of each row.
        names: of balls and cameras.
    """
    varying = _varying(names)
    kinds: dict[tuple[str, ...], list[list[str]]] = {}
    counts: dict[tuple[str, ...], int] = {}
    for reasons in rows:
        kept = {}
        for reason in reasons:
            pieces = varying.split(reason)  # fixed words at even places, what varies at odd ones
            kept[tuple(pieces[::2])] = pieces[1::2]
        for kind, given in kept.items():
            kinds.setdefault(kind, []).append(given)
            counts[kind] = counts.get(kind, 0) + 1
    order = sorted(counts, key=lambda kind: -counts[kind])
    return {_sentence(kind, kinds[kind]): counts[kind] for kind in order}


def _varying(names: Iterable[str]) -> re.Pattern[str]:
    """Numbers, and lists of names: one group, so that `split` keeps what it finds."""
    longest_first = sorted(set(names), key=lambda name: (-len(name), name))
    either = "|".join(map(re.escape, longest_first)) or r"(?!)"
    one = rf"(?<!\w)(?:{either})(?!\w)"
    return re.compile(rf"({one}(?:(?:, | and ){one})*|{_NUMBER})")


def _sentence(fixed: Sequence[str], given: Sequence[Sequence[str]]) -> str:
    """The words of a kind with, at each varying place, what its reasons have there."""
    kept = [_together(values) for values in zip(*given, strict=True)]
    return "".join(piece for pair in zip(fixed, [*kept, ""], strict=True) for piece in pair)


def _together(values: Sequence[str]) -> str:
    """Several numbers as their range, several lists of names as one list."""
    if len(set(values)) == 1:
        return values[0]
    if all(re.fullmatch(_NUMBER, value) for value in values):
        return "-".join(pick(values, key=float) for pick in (min, max))
    listed = sorted({name for value in values for name in re.split(r", | and ", value)})
    return ", ".join(listed)
