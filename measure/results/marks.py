"""Ball centres marked by hand in images."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TypeAlias

import numpy as np

from measure.arrays import Floats
from measure.errors import RunError
from measure.session.timestamps import read_number_table

Marks: TypeAlias = dict[tuple[str, int, str], Floats]
"""(2,) px by camera, the camera's frame number, and ball."""


def read_marks(path: Path | str) -> Marks:
    """Read ball centres marked by hand: `camera,frame,ball,u_px,v_px`, frame numbers per camera.

    Raises:
        RunError: with file and line where it cannot be used.
    """
    path = Path(path)
    table = read_number_table(path, ("frame", "u_px", "v_px"), "", RunError)
    with path.open(newline="", encoding="utf-8-sig") as file:
        rows = [row for row in csv.DictReader(file) if any(row.values())]
    if missing := [name for name in ("camera", "ball") if name not in rows[0]]:
        raise RunError(f"{path}:1: the header lacks {', '.join(missing)}")
    pixels = np.stack([table.columns["u_px"], table.columns["v_px"]], axis=1)
    frames = table.columns["frame"].astype(int).tolist()
    return {
        (row["camera"].strip(), frame, row["ball"].strip()): pixel
        for row, frame, pixel in zip(rows, frames, pixels, strict=True)
    }
