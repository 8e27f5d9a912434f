"""TOML as text: writing it readably, and finding the line a key stands on."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np


def dump_toml(values: Mapping[str, Any]) -> str:
    """TOML text of nested mappings; lists of mappings become `[[...]]`, None is left out.

    Written here because matrices must stay readable: one row a line, numbers to the last digit.
    """
    return "\n".join(_table_lines(values, "")).strip("\n") + "\n"


def _table_lines(values: Mapping[str, Any], prefix: str) -> list[str]:
    lines = [
        f"{_key(key)} = {_value(value)}"
        for key, value in values.items()
        if value is not None and not _is_table(value)
    ]
    for key, value in values.items():
        if not _is_table(value):
            continue
        name = f"{prefix}{_key(key)}"
        tables = [value] if isinstance(value, Mapping) else value
        header = f"[{name}]" if isinstance(value, Mapping) else f"[[{name}]]"
        for table in tables:
            lines += ["", header, *_table_lines(table, f"{name}.")]
    return lines


def _is_table(value: Any) -> bool:
    if isinstance(value, Mapping):
        return True
    return isinstance(value, list | tuple) and bool(value) and isinstance(value[0], Mapping)


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _value(key)


def _value(value: Any) -> str:
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, str | Path):
        return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007F")
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list | tuple):
        rows = [_value(item) for item in value]
        nested = any(isinstance(item, list | tuple) for item in value)
        return "[\n    " + ",\n    ".join(rows) + ",\n]" if nested else "[" + ", ".join(rows) + "]"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + "}"
    return repr(value)


def find_line(text: str, keys: tuple[int | str, ...]) -> int | None:
    """The line of the deepest part of a key path that stands in TOML text, counted from 1.

    Good enough for messages: it knows tables, arrays of tables and `key = ...` lines.
    """
    best, depth = None, 0
    table: tuple[int | str, ...] = ()
    counts: dict[tuple[str, ...], int] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        if header := re.match(r"\s*\[(\[?)([^\]\[]+)\]", line):
            table = _table_path(_split(header.group(2)), bool(header.group(1)), counts)
            here = table
        elif assignment := re.match(r"\s*([\w.\"'-]+(?:\s*\.\s*[\w\"'-]+)*)\s*=", line):
            here = (*table, *_split(assignment.group(1)))
        else:
            continue
        if len(here) > depth and tuple(keys[: len(here)]) == here:
            best, depth = number, len(here)
    return best


def _split(dotted: str) -> tuple[str, ...]:
    return tuple(part.strip().strip("\"'") for part in dotted.split("."))


def _table_path(
    names: tuple[str, ...], repeated: bool, counts: dict[tuple[str, ...], int]
) -> tuple[int | str, ...]:
    if repeated:
        counts[names] = counts.get(names, -1) + 1
        for longer in [k for k in counts if len(k) > len(names) and k[: len(names)] == names]:
            del counts[longer]
    path: list[int | str] = []
    for i, name in enumerate(names, start=1):
        path.append(name)
        if names[:i] in counts:
            path.append(counts[names[:i]])
    return tuple(path)
