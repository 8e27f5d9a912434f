"""Why a pose is missing or doubtful, or what a check finds: a code, names, numbers, a sentence."""

from __future__ import annotations

import json
import tomllib
from collections import Counter, defaultdict
from collections.abc import Hashable, Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Self


class Doubt(str):
    """A sentence that knows what it is made of; `doubts.toml` holds the sentence of each code.

    Wherever a plugin gives a sentence of its own, it may give a doubt.

    Attributes:
        code: what it is; `other` of a plain sentence.
        values: by the names of their places in it, what varies: a name, a number, or several of
            them (of two numbers a range).
    """

    __slots__ = ("code", "values")
    code: str
    values: dict[str, Any]

    def __new__(cls, code: str, /, **values: Any) -> Self:
        """Numbers are kept to six digits. With a `body` the sentence begins with its name."""
        kept = {name: _kept(value) for name, value in values.items()}
        text = sentences()[code]["text"].format(**{name: _Shown(one) for name, one in kept.items()})
        self = super().__new__(cls, f"{kept['body']}: {text}" if "body" in kept else text)
        self.code, self.values = code, kept
        return self

    @classmethod
    def of(cls, text: str) -> Doubt:
        """The same; a plain sentence as one without names and numbers."""
        return text if isinstance(text, Doubt) else cls("other", text=text)

    @classmethod
    def read(cls, text: str) -> Doubt:
        """One from a table, of `plain` as JSON; of what is none or not known, the text itself."""
        try:
            return _made(json.loads(text))
        except (ValueError, LookupError, TypeError, OverflowError, RecursionError):
            return cls.of(text)

    def __reduce__(self) -> tuple[Any, ...]:
        return _made, (self.plain,)

    @property
    def plain(self) -> dict[str, Any]:
        """As JSON knows it: `code`, and the values."""
        return {"code": self.code, **self.values}

    @property
    def kind(self) -> Hashable:
        """The same of doubts that differ by numbers and by names of cameras and balls alone."""
        return self.code, *self.values, self.values.get("text"), self.values.get("body")

    def names(self, place: str) -> tuple[str, ...]:
        """The names at a place of the sentence."""
        return tuple(map(str, _several(self.values[place])))

    def of_body(self, name: str) -> Doubt:
        """The same of one of several bodies."""
        return _made(self.plain | {"body": name})


def _made(plain: dict[str, Any]) -> Doubt:
    return Doubt(plain["code"], **{name: plain[name] for name in plain if name != "code"})


@cache
def sentences() -> dict[str, dict[str, str]]:
    """By code: its sentence, how it is known, and what mends it."""
    return tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8"))


def counted(rows: Iterable[Iterable[str]]) -> dict[Doubt, int]:
    """How many rows give each kind of doubt, the commonest first.

    One stands for all of its kind: with the ranges of their numbers and all of their names.
    """
    every, counts = defaultdict[Hashable, list[Doubt]](list), Counter[Hashable]()
    for doubts in ([*map(Doubt.of, row)] for row in rows):
        for one in doubts:
            every[one.kind].append(one)
        counts.update(dict.fromkeys(one.kind for one in doubts).keys())
    return {_together(every[kind]): count for kind, count in counts.most_common()}


def _together(doubts: Sequence[Doubt]) -> Doubt:
    plain = doubts[0].plain
    return _made({name: _range([one.plain[name] for one in doubts]) for name in plain})


def _range(values: Sequence[Any]) -> Any:
    if len(set(values)) == 1:
        return values[0]
    every = {one for value in values for one in _several(value)}
    numbers = [one for one in every if isinstance(one, float)]
    return (min(numbers), max(numbers)) if numbers else tuple(sorted(every))


def _kept(value: Any) -> Any:
    if isinstance(value, str):
        return str(value)
    return tuple(map(_kept, value)) if isinstance(value, Sequence) else float(f"{value:.6g}")


def _several(value: Any) -> tuple[Any, ...]:
    return value if isinstance(value, tuple) else (value,)


class _Shown:
    """A value in a sentence: names with commas ("and" before the last, by that format), a range."""

    def __init__(self, value: Any) -> None:
        self._each = _several(value)

    def __format__(self, form: str) -> str:
        *most, last = self._each
        if isinstance(last, float):
            return "-".join(dict.fromkeys(format(one, form) for one in self._each))
        return f"{', '.join(most)} and {last}" if form == "and" and most else ", ".join(self._each)
