"""A recording read back, entity by entity."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import pyarrow as pa
from rerun.chunk import RrdReader


def read_recording(path: Path) -> dict[str, list[pa.RecordBatch]]:
    """The batches of every entity; also of a file whose writer was killed before its end."""
    stored: dict[str, list[pa.RecordBatch]] = {}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "RRD file has no footer")
        chunks = list(RrdReader(path).stream())
    for chunk in chunks:
        entity = str(chunk.entity_path).lstrip("/")
        stored.setdefault(entity, []).append(chunk.to_record_batch())
    return stored


def column(batches: list[pa.RecordBatch], name: str) -> dict[int, Any]:
    """One component's values by frame set, in their order."""
    rows: list[tuple[int, Any]] = []
    for batch in batches:
        names = batch.schema.names
        if name in names and "frame" in names:
            frames = batch.column(names.index("frame")).to_pylist()
            rows += zip(frames, batch.column(names.index(name)).to_pylist(), strict=True)
    return dict(sorted(rows, key=lambda row: row[0]))
