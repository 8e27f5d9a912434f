"""Doubts of poses: one table of sentences, and every doubt that is made fits it."""

from __future__ import annotations

import ast
import json
import pickle
import re
import string
from pathlib import Path

import pytest

from measure.model import Doubt
from measure.model.doubts import counted, sentences

ROOT = Path(__file__).parents[2]


def places(code):
    """The places of a sentence, with their formats."""
    found = string.Formatter().parse(sentences()[code]["text"])
    return {name: form for _, name, form, _ in found if name}


def examples():
    """A doubt of every code; in each place of a name cam0, of a number 3."""
    for code in sentences():
        forms = places(code).items()
        yield Doubt(
            code, **{name: 3.0 if form[-1:] in "fg" and form else "cam0" for name, form in forms}
        )


def made():
    """The code and the places of every doubt that some line makes."""
    for file in (file for room in ("measure", "plugins") for file in (ROOT / room).rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            if (
                getattr(getattr(node, "func", None), "id", "") == "Doubt"
                and file.name != "doubts.py"
            ):
                yield node.args[0].value, {one.arg for one in node.keywords}


def given_beside():
    """Codes of findings whose sentence is made elsewhere."""
    found = (path.read_text("utf-8") for path in (ROOT / "measure").rglob("*.py"))
    return {code for text in found for code in re.findall(r'\bcode="([\w-]+)"', text)}


def test_every_doubt_fits_its_sentence_and_every_sentence_is_used():
    every = list(made())
    assert [(code, names) for code, names in every if names != set(places(code))] == []
    used = {code for code, _ in every} | given_beside()
    assert used == sentences().keys() - {"other"}
    assert all(set(row) == {"text", "known", "remedy"} for row in sentences().values())


def test_a_doubt_comes_back_from_tables_and_processes():
    stall = Doubt("stall", cameras=("a", "b")).of_body("tool")
    assert stall.startswith("tool: the pictures of a, b repeat")
    for doubt in (*examples(), stall):
        for again in (Doubt.read(json.dumps(doubt.plain)), pickle.loads(pickle.dumps(doubt))):
            assert (again, again.code, again.values) == (doubt, doubt.code, doubt.values)


NONE = ("", "too dark", "{", "3", "[]", "{}", "[" * 9999)
UNKNOWN = ('"of a later version"', '["shape"]', '"stall"', '"stall", "cameras": []')


@pytest.mark.parametrize("text", [*NONE, *(f'{{"code": {rest}}}' for rest in UNKNOWN)])
def test_what_is_no_doubt_stands_as_it_is(text):
    found = Doubt.read(text)
    assert (found, found.code) == (text, "other")


def test_numbers_have_six_digits_and_sentences_are_made_of_them():
    doubt = Doubt("scale", times=1.00312345678, sd=0.0006)
    assert doubt.plain == {"code": "scale", "times": 1.00312, "sd": 0.0006}
    assert doubt.startswith("the balls are 1.0031 +- 0.0006 times as far apart")


def test_a_row_counts_once_for_each_kind_and_shows_all_of_it():
    red, green = (Doubt("ball-aside", ball=n, off_mm=mm) for n, mm in (("red", 2), ("green", 1)))
    pairs = [Doubt("distance", balls=("red", name), measured_mm=70, file_mm=76) for name in "ab"]
    found = counted([(red, green), (green, *pairs), ("x",), ("y",)])
    (aside, rows), (apart, once), *own = found.items()
    assert (aside.values, rows) == ({"ball": ("green", "red"), "off_mm": (1.0, 2.0)}, 2)
    assert aside.startswith("ball green, red is 1.0-2.0 mm from where")
    assert (apart, once) == ("balls a, b and red are 70.0 mm apart, the body says 76.0 mm", 1)
    assert own == [("x", 1), ("y", 1)], "plain sentences are of one kind if they are the same"
    other = counted([(red.of_body("one"), red.of_body("two"))])
    assert [one.values["body"] for one in other] == ["one", "two"]
