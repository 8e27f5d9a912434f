"""`measure rests`: where a body stood still, and how far apart these places are."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from cyclopts import Parameter

from measure.cli import console
from measure.cli.console import JsonFlag

if TYPE_CHECKING:
    from measure.metrology.rests import Displacement, Rest, Rests


def rests(
    run: Path,
    /,
    *,
    shortest_s: float = 0.5,
    from_: Annotated[int, Parameter(name="--from")] = 0,
    body: str | None = None,
    json: JsonFlag = False,
) -> None:
    """List where the body stood still, with the displacements between.

    A rest is a stretch in which poses scatter no more than twice as much as where they are
    quietest. Its pose is their mean; what all poses err by alike (cameras, body file, light) stays
    in its uncertainty. Between rests that cancels as far as it is alike at both places. Rests are
    numbered from 0.

    Args:
        run: the run's folder.
        shortest_s: shortest rest.
        from_: print the displacements from this rest; --json has those between any two.
        body: which body, of a run of several.
    """
    from measure import api

    found = api.rests(run, shortest_s, body)
    if json:
        console.print_json({"run": str(run), **_values(found)})
        return
    console.print_text(f"{run}: {found.told()}")
    if not found.rests:
        return
    console.print_text(
        f"noise at rest: {100 * np.sqrt(found.noise_share):.0f} % of the stated standard deviation"
    )
    heads = ("rest", "start_s", "end_s", "poses", "x_mm", "y_mm", "z_mm", "sd_mm", "scatter_mm")
    console.print_table(heads, [_row(found, n, rest) for n, rest in enumerate(found.rests)])
    if len(found) > 1:
        found.rest(from_)
        rows = [
            (n, *d.shift_mm.tolist(), d.distance_mm, d.distance_sd_mm, d.turned_deg)
            for n in range(len(found))
            if n != from_
            for d in [found.displacement(from_, n)]
        ]
        columns = ("to", "dx_mm", "dy_mm", "dz_mm", "distance_mm", "sd_mm", "turned_deg")
        console.print_table(columns, [tuple(map(_digits, row)) for row in rows], f"from {from_}")


def _row(found: Rests, number: int, rest: Rest) -> tuple[object, ...]:
    sd = float(np.sqrt(np.trace(found.block(number, number)[:3, :3])))
    scatter = float(np.sqrt(np.trace(rest.scatter[:3, :3])))
    place = (_digits(value) for value in rest.world_from_body.translation.tolist())
    times = (f"{rest.start_s:.3f}", f"{rest.end_s:.3f}")
    return (number, *times, rest.poses, *place, sd, scatter)


def _digits(value: float) -> object:
    """Micrometres, whatever the length: four significant digits would be too few."""
    return f"{value:.3f}" if isinstance(value, float) else value


def _values(found: Rests) -> dict[str, Any]:
    """As JSON: rests, and the displacement between any two of them."""
    pairs = [(a, b) for a in range(len(found)) for b in range(a + 1, len(found))]
    return {
        "noise_share": found.noise_share,
        "rests": [_rest_values(found, n, rest) for n, rest in enumerate(found.rests)],
        "displacements": [_pair_values(a, b, found.displacement(a, b)) for a, b in pairs],
    }


def _rest_values(found: Rests, number: int, rest: Rest) -> dict[str, Any]:
    P = found.block(number, number)
    return {
        "rest": number,
        "start_s": rest.start_s,
        "end_s": rest.end_s,
        "poses": rest.poses,
        "independent": rest.independent,
        "translation_mm": rest.world_from_body.translation,
        "quat_wxyz": rest.world_from_body.quat_wxyz,
        "position_sd_mm": np.sqrt(np.trace(P[:3, :3])),
        "rotation_sd_deg": np.degrees(np.sqrt(np.trace(P[3:, 3:]))),
        "scatter_mm": np.sqrt(np.trace(rest.scatter[:3, :3])),
        "covariance": P,
    }


def _pair_values(start: int, end: int, found: Displacement) -> dict[str, Any]:
    return {
        "from": start,
        "to": end,
        "shift_mm": found.shift_mm,
        "distance_mm": found.distance_mm,
        "distance_sd_mm": found.distance_sd_mm,
        "turned_deg": found.turned_deg,
        "turned_sd_deg": found.turned_sd_deg,
        "covariance": found.covariance,
    }
