"""The balls' radii, as the outlines of a whole run show them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from measure.geometry import RigidTransform
from measure.measuring.ball_radii import OutlineGrowth, outline_growth
from measure.model import Body, Camera, Detection
from measure.results.columns import numbers
from measure.results.tables import PLACE

_MOST_VIEWS = 1500
"""Ball-views, evenly spread: their errors are alike, so that more say no more."""


def outline_sizes(
    body: Body, cameras: Sequence[Camera], detections: pa.Table, poses: pa.Table
) -> OutlineGrowth:
    """How much larger outlines are than those of the body file's balls, from a run's tables."""
    return outline_growth(_seen(detections, poses), body, cameras)


def _seen(detections: pa.Table, poses: pa.Table) -> Iterator[tuple[RigidTransform, Detection]]:
    """Effective detections, evenly spread, with the poses of their frame sets."""
    used = detections.filter(pc.equal(detections["state"], "effective"))
    chosen = np.unique(
        np.linspace(0, used.num_rows - 1, min(used.num_rows, _MOST_VIEWS), dtype=int)
    )
    place = numbers(poses, *PLACE)
    order = poses["index"].to_numpy()
    for seen in used.take(chosen).to_pylist():
        at = place[np.searchsorted(order, seen["index"])]
        if np.isfinite(at).all():
            uu, uv, vv = (seen[f"var_{which}_px2"] for which in ("uu", "uv", "vv"))
            yield (
                RigidTransform.from_quat_wxyz(at[3:], at[:3]),
                Detection(
                    seen["ball"],
                    seen["camera"],
                    seen["time_s"],
                    np.array([seen["u_px"], seen["v_px"]]),
                    seen["radius_px"],
                    np.array([[uu, uv], [uv, vv]]),
                ),
            )
