"""Formulas are numbered, and written so that the site and a code host show the same."""

from __future__ import annotations

import re

import pytest

from tests.docs.pages import PAGES, ROOT, name_of

_DISPLAYED = re.compile(r"^\$\$\n(.*?)\n\$\$$", re.DOTALL | re.MULTILINE)
_INLINE = re.compile(r"\$([^$\n]+)\$")
_CODE = re.compile(r"```.*?```|`[^`\n]*`", re.DOTALL)
_POINTER = re.compile(r"explanation/(\w+)\.md,\s+formulas?\s+([\d, andto]*\d)")
SOURCES = [*sorted((ROOT / "measure").rglob("*.py")), *sorted((ROOT / "plugins").rglob("*.py"))]

with_formulas = pytest.mark.parametrize(
    "page", [page for page in PAGES if "$$" in page.read_text(encoding="utf-8")], ids=name_of
)


def _displayed(page):
    return _DISPLAYED.findall(_CODE.sub("", page.read_text(encoding="utf-8")))


def _inline(page):
    """Formulas in running text, each with the characters on either side."""
    text = _DISPLAYED.sub("", _CODE.sub("x", page.read_text(encoding="utf-8")))
    return [
        (text[found.start() - 1], found[1], text[found.end()]) for found in _INLINE.finditer(text)
    ]


@with_formulas
def test_displayed_formulas_are_numbered_in_order(page):
    numbers = [re.findall(r"\\tag\{(\d+)\}", formula) for formula in _displayed(page)]
    assert numbers == [[str(1 + i)] for i in range(len(numbers))]


@with_formulas
def test_formulas_hold_nothing_that_markdown_takes_for_its_own(page):
    """A code host reads Markdown first: it eats escapes, and sees lists, quotes and tags."""
    for formula in [*_displayed(page), *(text for _, text, _ in _inline(page))]:
        assert not re.search(r"\\[^a-zA-Z\s]", formula), formula
        assert not re.search(r"<\w|\\operatorname", formula), formula
        assert formula.count("{") == formula.count("}"), formula
    for formula in _displayed(page):
        assert not re.search(r"^\s*([-+*>#=]|$)", formula, re.MULTILINE), formula


@with_formulas
def test_formulas_in_the_text_are_seen_as_such(page):
    """The dollars must stand at a word's borders on the outside, and at no space inside."""
    for before, formula, after in _inline(page):
        assert re.match(r"[\s(|]", before), before + formula
        assert re.match(r"[\s.,;:)|]", after), formula + after
        assert formula == formula.strip(), formula


def test_sources_point_at_formulas_that_exist():
    for source in SOURCES:
        for page, numbers in _POINTER.findall(source.read_text(encoding="utf-8")):
            known = len(_displayed(ROOT / "docs" / "explanation" / f"{page}.md"))
            assert all(1 <= int(n) <= known for n in re.findall(r"\d+", numbers)), source
