from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field

from measure.errors import ConfigError
from measure.session import FileModel, dump_toml, load_toml
from measure.session.files import find_line

SCALARS = (
    st.text(st.characters(exclude_categories=["Cs"]))
    | st.integers(-(2**60), 2**60)
    | st.booleans()
    | st.floats(allow_nan=False)
)
LISTS = st.lists(SCALARS, max_size=4)
VALUES = SCALARS | LISTS | st.lists(LISTS, max_size=3)
KEYS = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
TABLES = st.recursive(
    st.dictionaries(KEYS, VALUES, max_size=4),
    lambda inner: st.dictionaries(
        KEYS, VALUES | inner | st.lists(inner, min_size=1, max_size=3), max_size=4
    ),
    max_leaves=12,
)


@given(TABLES)
def test_what_is_written_is_read_back(values: dict) -> None:
    assert tomllib.loads(dump_toml(values)) == values


def test_matrices_are_one_row_a_line_and_none_is_left_out() -> None:
    text = dump_toml({"a": np.eye(2), "b": None, "c": {"d": Path("x/y"), "e": np.float64(0.1)}})
    assert text == "\n".join(
        ["a = [", "    [1.0, 0.0],", "    [0.0, 1.0],", "]", "", "[c]", 'd = "x/y"', "e = 0.1", ""]
    )


TEXT = """\
name = "x"
[session]
body = 1
[[cameras]]
name = "a"
  [[cameras.marks]]
  u = 1
  [[cameras.marks]]
  u = 2
[[cameras]]
name = "b"
lens.matrix = 3
  [[cameras.marks]]
  u = 3
"""


@pytest.mark.parametrize(
    ("keys", "line"),
    [
        (("name",), 1),
        (("session", "body"), 3),
        (("session", "missing"), 2),
        (("cameras", 0, "name"), 5),
        (("cameras", 1, "name"), 11),
        (("cameras", 1, "missing"), 10),
        (("cameras", 0, "marks", 1, "u"), 9),
        (("cameras", 1, "marks", 0, "u"), 14),
        (("cameras", 1, "lens", "matrix"), 12),
        (("nowhere",), None),
    ],
)
def test_the_line_of_a_key(keys: tuple[int | str, ...], line: int | None) -> None:
    assert find_line(TEXT, keys) == line


class _Lens(FileModel):
    focal_px: float = Field(gt=0)


class _Camera(FileModel):
    name: str
    lens: _Lens | None = None


class _File(FileModel):
    cameras: list[_Camera]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("cameras = 3", ":1: 'cameras': input should be a valid list, got 3"),
        ('[[cameras]]\nname = "a"\n[[cameras]]\n', ":3: 'cameras[1].name' is missing"),
        (
            '[[cameras]]\nname = "a"\n[cameras.lens]\nfocal_mm = 3.0\n',
            ":4: unknown key 'cameras[0].lens.focal_mm'; did you mean focal_px?",
        ),
        (
            '[[cameras]]\nname = "a"\nlens = {focal_px = -1.0}\n',
            ":3: 'cameras[0].lens.focal_px': input should be greater than 0, got -1.0",
        ),
        ("[[cameras]]\nname = \n", ":2: not valid TOML: invalid value"),
    ],
)
def test_mistakes_have_file_line_and_key(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "f.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_toml(path, _File, ConfigError)
    assert f"{path}{words}" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_is_no_text_file(tmp_path: Path) -> None:
    (tmp_path / "f.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="not a text file"):
        load_toml(tmp_path / "f.toml", _File, ConfigError)
    with pytest.raises(ConfigError, match="is a folder, not an ordinary file"):
        load_toml(tmp_path, _File, ConfigError)
    with pytest.raises(ConfigError, match="does not exist either"):
        load_toml(tmp_path / "no" / "f.toml", _File, ConfigError)


def test_a_byte_order_mark_does_no_harm(tmp_path: Path) -> None:
    (tmp_path / "f.toml").write_bytes(b"\xef\xbb\xbfcameras = []\n")
    assert load_toml(tmp_path / "f.toml", _File).cameras == []
