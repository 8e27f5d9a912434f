"""`measure rests`: where a body stood still, and how far apart these places are."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter

from measure.cli import console
from measure.cli.console import JsonFlag
from measure.cli.options import command
from measure.metrology.rests import Rest, Rests
from measure_lab import api

_From = Annotated[
    int, Parameter(help="print the displacements from this rest; --json has those between any two.")
]


@command(api.rests)
def rests(found: Rests, run: Path, from_: _From = 0, json: JsonFlag = False) -> None:
    """Print the rests, and the displacements from one of them."""
    if json:
        console.print_json({"run": str(run), **_values(found)})
        return
    console.print_text(f"{run}: {found.listed()}")
    if not found.rests:
        return
    console.print_text(
        f"noise at rest: {100 * np.sqrt(found.noise_share):.0f} % of the stated standard deviation"
    )
    heads = ("rest", "start_s", "end_s", "poses", "x_mm", "y_mm", "z_mm", "sd_mm", "scatter_mm")
    console.print_table(heads, [_row(found, n, rest) for n, rest in enumerate(found.rests)])
    found.rest(from_)
    ends = [n for n in range(len(found)) if n != from_]
    moves = [(n, found.displacement(from_, n)) for n in ends]
    rows = [(n, *_digits(*d.shift_mm, d.distance_mm, d.distance_sd_mm, d.turned_deg))
            for n, d in moves]  # fmt: skip
    columns = ("to", "dx_mm", "dy_mm", "dz_mm", "distance_mm", "sd_mm", "turned_deg")
    console.print_table(columns, rows, f"from {from_}")


def _row(found: Rests, number: int, rest: Rest) -> tuple[object, ...]:
    scatter = float(np.sqrt(np.trace(rest.scatter[:3, :3])))
    times, place = _digits(rest.start_s, rest.end_s), _digits(*rest.world_from_body.translation)
    return (number, *times, rest.poses, *place, found.sds(number)[0], scatter)


def _digits(*values: float) -> list[str]:
    """Micrometres, whatever the length: four significant digits would be too few."""
    return [f"{value:.3f}" for value in values]


def _values(found: Rests) -> dict[str, Any]:
    """As JSON: rests, and the displacement between any two of them."""
    rests = [
        {
            "rest": n,
            "translation_mm": rest.world_from_body.translation,
            "quat_wxyz": rest.world_from_body.quat_wxyz,
            **dict(zip(("position_sd_mm", "rotation_sd_deg"), found.sds(n), strict=True)),
            "covariance": found.block(n, n),
            **{key: value for key, value in vars(rest).items() if key != "world_from_body"},
        }
        for n, rest in enumerate(found.rests)
    ]
    pairs = [(a, b) for a in range(len(found)) for b in range(a + 1, len(found))]
    moved = [{"from": a, "to": b, **vars(found.displacement(a, b))} for a, b in pairs]
    return {"noise_share": found.noise_share, "rests": rests, "displacements": moved}
