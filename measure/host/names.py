"""The names of bodies where a format restricts names: one rule for every sink and export."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable

_LETTERS = 60  # ROS advises short names; what is longer is cut, and numbered where alike


def plain_name(name: str, nothing: str = "body") -> str:
    """A name of ASCII letters, digits and `_`, which begins with a letter.

    Accents are dropped, all else becomes `_`; `nothing` stands for a name without anything
    left, and before one that begins with a digit.
    """
    plain = unicodedata.normalize("NFKD", name.replace("ß", "ss")).encode("ascii", "ignore")
    word = re.sub("[^A-Za-z0-9]+", "_", plain.decode()).strip("_")[:_LETTERS]
    return word if word[:1].isalpha() else "_".join(filter(None, (nothing, word)))


def plain_names(names: Iterable[str], nothing: str = "body") -> dict[str, str]:
    """`plain_name` of each; of names that would be alike the later ones end in a number."""
    out: dict[str, str] = {}
    for name in dict.fromkeys(names):
        word = made = plain_name(name, nothing)
        number = 1
        while made in out.values():
            number += 1
            made = f"{word}_{number}"
        out[name] = made
    return out
