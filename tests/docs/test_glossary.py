"""Every name in the glossary's last column exists."""

from __future__ import annotations

import importlib
import re
from functools import cache

import pytest

from tests.docs.pages import ROOT

PAGE = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8")
TERMS = {row[0].strip(): row[-1] for row in re.findall(r"^\|([^|]+)\|(.*)\|([^|]+)\|$", PAGE, re.M)}


@pytest.mark.parametrize("term", list(TERMS)[2:])
def test_a_term_occurs_where_the_glossary_says(term: str):
    names = re.findall(r"`([^`]+)`", TERMS[term])
    assert names
    for name in names:
        assert _found(name), name


def test_there_are_about_thirty_terms():
    assert 30 <= len(TERMS) - 2 <= 45


def _found(name: str) -> bool:
    """A dotted name can be imported; another word stands in the sources."""
    if name.startswith("measure"):
        return _imported(name)
    return re.search(rf"(?<![\w-]){re.escape(name)}(?![\w-])", _sources()) is not None


def _imported(name: str) -> bool:
    try:
        importlib.import_module(name)
    except ModuleNotFoundError:
        parent, _, last = name.rpartition(".")
        return bool(parent) and (_attribute(parent, last) or _member(parent, last))
    return True


def _attribute(module: str, name: str) -> bool:
    try:
        return hasattr(importlib.import_module(module), name)
    except ModuleNotFoundError:
        return False


def _member(owner: str, name: str) -> bool:
    module, _, class_name = owner.rpartition(".")
    return _attribute(module, class_name) and hasattr(
        getattr(importlib.import_module(module), class_name), name
    )


@cache
def _sources() -> str:
    paths = [p for top in ("measure", "plugins") for p in (ROOT / top).rglob("*.py")]
    return "\n".join(path.read_text(encoding="utf-8") for path in sorted(paths))
