"""Ways to change a file: as accidents do, as slips of the pen do, and as an enemy would."""

from __future__ import annotations

import json
import os
import random
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
from pyarrow import ipc, parquet

Mutation: TypeAlias = Callable[[Path, random.Random], str]
"""Changes a file and says what it did."""

_NUMBER = re.compile(rb"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_VALUES = (
    *("nan", "inf", "-inf", "-0.0", "0", "1e300", "-1e300", "1e-300", "1e999", "1" * 25),
    *("9" * 5000, "true", '"x"', "[[[[1]]]]", "[]", "{}", "", "0x10", "2024-13-45", "1,5"),
)
_CELLS = (float("nan"), float("inf"), -float("inf"), 1e300, -1e300, -0.0, 0.0, 1e-300, 2.0**63)
_DEEP = 3000


def special(path: Path, draw: random.Random) -> str:
    """Something else in the file's place."""
    what = draw.choice(["pipe", "folder", "device", "dangling link", "link to itself", "empty"])
    path.unlink()
    if what == "pipe":
        os.mkfifo(path)
    elif what == "folder":
        path.mkdir()
    elif what == "empty":
        path.touch()
    else:
        to = {"device": "/dev/zero", "dangling link": "nowhere", "link to itself": path.name}
        path.symlink_to(to[what])
    return what


def huge(path: Path, draw: random.Random) -> str:
    """Goes on with so many zeros that no memory holds them."""
    with path.open("r+b") as file:
        file.truncate(1 << draw.choice([33, 40]))
    return "a terabyte of zeros"


def damage(path: Path, draw: random.Random) -> str:
    """Bits flipped, parts lost, repeated or overwritten."""
    data = bytearray(path.read_bytes())
    at, length = draw.randrange(len(data)), draw.choice([1, 4, 64, 4096])
    what = draw.choice(["bits flipped", "truncated", "zeros", "part lost", "part twice", "noise"])
    if what == "bits flipped":
        for _ in range(draw.choice([1, 3, 30])):
            data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
    elif what == "truncated":
        del data[at:]
    elif what == "zeros":
        data[at : at + length] = bytes(len(data[at : at + length]))
    elif what == "part lost":
        del data[at : at + length]
    elif what == "part twice":
        data[at:at] = data[at : at + length]
    else:
        data[at : at + length] = draw.randbytes(len(data[at : at + length]))
    path.write_bytes(data)
    return what


def number(path: Path, draw: random.Random) -> str:
    """One number of a text becomes another value."""
    data = path.read_bytes()
    found = list(_NUMBER.finditer(data))
    if not found:
        return damage(path, draw)
    place, value = draw.choice(found), draw.choice(_VALUES)
    path.write_bytes(data[: place.start()] + value.encode() + data[place.end() :])
    return f"a number becomes {value[:12]}"


def digit(path: Path, draw: random.Random) -> str:
    """One digit of a text becomes another: what it says may be as likely as before."""
    data = bytearray(path.read_bytes())
    places = [k for k, byte in enumerate(data) if 48 <= byte <= 57]
    if not places:
        return damage(path, draw)
    data[draw.choice(places)] = draw.randrange(48, 58)
    path.write_bytes(data)
    return "a digit changed"


def lines(path: Path, draw: random.Random) -> str:
    """Lines removed, repeated, exchanged; words misspelt."""
    rows = path.read_bytes().splitlines(keepends=True)
    at, other = draw.randrange(len(rows)), draw.randrange(len(rows))
    what = draw.choice(["line removed", "line twice", "lines exchanged", "word misspelt", "quote"])
    if what == "line removed":
        del rows[at]
    elif what == "line twice":
        rows.insert(other, rows[at])
    elif what == "lines exchanged":
        rows[at], rows[other] = rows[other], rows[at]
    elif what == "quote":
        rows[at] = rows[at].replace(b"=", b'= "', 1) if b"=" in rows[at] else b'"' + rows[at]
    else:
        rows[at] = rows[at].replace(b"e", b"o", 1)
    path.write_bytes(b"".join(rows))
    return what


def encoding(path: Path, draw: random.Random) -> str:
    """Another encoding, or characters that belong into no text."""
    text = path.read_bytes().decode("utf-8", "replace")
    what = draw.choice(["utf-16", "utf-8-sig", "nul", "latin-1", "carriage returns", "controls"])
    if what in ("utf-16", "utf-8-sig"):
        path.write_bytes(text.encode(what))
    elif what == "carriage returns":
        path.write_bytes(text.replace("\n", "\r").encode())
    else:
        sign = {"nul": b"\0", "latin-1": b"\xe9", "controls": b"\x1b\x07"}[what]
        data, at = text.encode(), draw.randrange(len(text))
        path.write_bytes(data[:at] + sign + data[at:])
    return what


def deep(path: Path, draw: random.Random) -> str:
    """Values nested beyond reason."""
    text = path.read_text("utf-8", "replace")
    opened, closed = draw.choice([("[", "]"), ("{a=", "}"), ("a.", "")])
    nested = opened * _DEEP + "1" + closed * draw.choice([0, _DEEP])
    extra = nested if opened == "[" or not text.startswith("{") else '{"a":' * _DEEP
    path.write_text(draw.choice([f"{text}\nx = {extra}\n", f"x = {extra}\n{text}", extra]), "utf-8")
    return "nested too deep"


TEXT: tuple[Mutation, ...] = (special, huge, damage, number, number, digit, lines, encoding, deep)
BINARY: tuple[Mutation, ...] = (special, huge, damage, damage, damage)


def table(path: Path, draw: random.Random) -> str:
    """A Parquet table, or a stream of Arrow's, with other cells, types, columns or rows."""
    stream = path.suffix == ".arrows"
    data = pa.py_buffer(path.read_bytes())  # not a map of what is written over
    content = ipc.open_stream(data).read_all() if stream else parquet.read_table(data)
    changed, what = _other_table(content, draw)
    if stream:
        with path.open("wb") as out, ipc.new_stream(out, changed.schema) as writer:
            writer.write_table(changed)
    else:
        parquet.write_table(changed, path)
    return what


def _other_table(content: pa.Table, draw: random.Random) -> tuple[pa.Table, str]:
    name = draw.choice(content.column_names)
    at = content.column_names.index(name)
    what = draw.choice(["cell", "cell", "cell", "type", "gone", "renamed", "rows", "none", "twice"])
    if what == "gone" or not len(content):
        return content.drop_columns([name]), f"column {name} removed"
    if what == "renamed":
        names = [n if n != name else f"{n}_" for n in content.column_names]
        return content.rename_columns(names), f"column {name} renamed"
    if what == "rows":
        order = draw.sample(range(len(content)), len(content))
        return content.take(order), "rows shuffled"
    if what == "none":
        return content.slice(0, 0), "no rows"
    if what == "twice":
        return content.append_column(name, content[name]), f"column {name} twice"
    values = content[name].to_pylist()
    if what == "type":
        kind = draw.choice([pa.string(), pa.list_(pa.float64()), pa.binary()])
        return content.set_column(at, name, pa.nulls(len(values), kind)), f"{name} of {kind}"
    row = draw.randrange(len(values))
    values[row] = _other_cell(values[row], draw)
    try:
        column = pa.array(values, content[name].type)
    except (pa.ArrowException, OverflowError, ValueError, TypeError):
        column = pa.array(list(map(str, values)))
    return content.set_column(at, name, column), f"a cell of {name}"


def _other_cell(value: Any, draw: random.Random) -> Any:
    if isinstance(value, str):
        return draw.choice([None, "", "\0", "x" * 1000, value[:-1] + "\u00e9", "ok", "lost"])
    if isinstance(value, list):
        return draw.choice([None, [], value[:-1], [_other_cell(v, draw) for v in value]])
    if isinstance(value, int) and not isinstance(value, bool):
        return draw.choice([None, -1, 0, 2**31 - 1, -(2**31), value + 1])
    return draw.choice([None, *_CELLS])


def other_values(values: Any, draw: random.Random) -> Any:
    """Nested values of JSON with one of them of another type, gone, or nested too deep."""
    values = json.loads(json.dumps(values))
    here = values
    while True:
        keys = list(here) if isinstance(here, dict) else range(len(here))
        key = draw.choice(list(keys))
        inner = here[key]
        if isinstance(inner, dict | list) and inner and draw.random() < 0.6:
            here = inner
            continue
        if draw.random() < 0.2:
            del here[key]
        else:
            odd: tuple[Any, ...] = (
                None,
                -1,
                0,
                1.5,
                10**30,
                "x",
                [],
                {},
                [[1]],
                True,
                1e300,
                float("nan"),
            )
            here[key] = draw.choice(odd)
        return values


def other_json(path: Path, draw: random.Random) -> str:
    """A JSON file one of whose values is of another type, gone, or nested too deep."""
    path.write_text(json.dumps(other_values(json.loads(path.read_text("utf-8")), draw)), "utf-8")
    return "another value"


def resealed(path: Path, draw: random.Random) -> str:
    """An ONNX file whose metadata say something else, and whose checksum is right all the same."""
    import onnx

    from measure_learning.onnx.graph import seal

    model = onnx.load_from_string(path.read_bytes())
    kept = {one.key: one.value for one in model.metadata_props if one.key != "sha256"}
    key = draw.choice(["measure", "measure", "card"])
    if draw.random() < 0.15:
        kept[key] = draw.choice(["", "[]", "{", "1", "[" * _DEEP, '{"format": 1}'])
    else:
        kept[key] = json.dumps(other_values(json.loads(kept[key]), draw))
    onnx.helper.set_model_props(model, kept)
    path.write_bytes(seal(model.SerializeToString()))
    return f"metadata {key} resealed"


def restored(path: Path, draw: random.Random) -> str:
    """A checkpoint of the same fit that holds other values."""
    import torch

    state = torch.load(path, weights_only=True)
    name = draw.choice([key for key in state if key != "key"])
    odd: tuple[Any, ...] = (None, 1, "x", [], {}, torch.zeros(3), torch.full((2, 2), float("nan")))
    if draw.random() < 0.3:
        del state[name]
    else:
        state[name] = draw.choice(odd)
    torch.save(state, path)
    return f"{name} of other values"


def changed_picture(path: Path, draw: random.Random) -> str:
    """A picture of another size, kind or depth."""
    import cv2

    sizes = [(64, 48), (1, 1), (9000, 20)]
    pixels = np.zeros((*draw.choice(sizes), 3), np.uint8)
    kind = draw.choice([".png", ".jpg", ".bmp", ".tiff"])
    path.write_bytes(cv2.imencode(kind, pixels)[1].tobytes())
    return f"another picture, {kind}"
