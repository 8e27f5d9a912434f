"""The body measured with itself: its balls' distances and radii against the body file."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from measure.arrays import Floats
from measure.checking.body import Compared, layout_findings, size_findings, twin_findings
from measure.checking.finding import Level
from measure.geometry import RigidTransform
from measure.measuring.ball_radii import outline_growth
from measure.model import Body, Camera, Detection
from measure.results.tables import PLACE, matrices, numbers

MIN_FRAME_SETS = 5  # Of fewer frame sets the scatter is not known well enough
_MOST_VIEWS = 1500  # Ball-views, evenly spread: their errors are alike, so that more say no more


@dataclass(frozen=True, eq=False)
class BallDistance:
    """One pair of balls over a run, or of bodies' origins."""

    balls: tuple[str, str]  # their names
    nominal_mm: float  # by the body file; NaN of bodies
    measured_mm: Floats  # (n,) in every frame set; NaN where one of them has no position
    # (n,) standard deviations by the positions' covariances, which hold what all frame sets err by
    # alike; NaN likewise.
    sd_mm: Floats

    @property
    def count(self) -> int:
        """In how many frame sets both have a position."""
        return int(np.count_nonzero(np.isfinite(self.measured_mm)))

    @property
    def mean_mm(self) -> float:
        """NaN without a frame set."""
        return float(np.nanmean(self.measured_mm)) if self.count else np.nan

    @property
    def off_mm(self) -> float:
        """Mean measured minus nominal."""
        return self.mean_mm - self.nominal_mm

    @property
    def uncertainty_mm(self) -> float:
        """Standard deviation of the mean with what all frame sets err by alike; NaN if unknown."""
        known = self.sd_mm[np.isfinite(self.sd_mm)]
        if not len(known):
            return np.nan
        standard_error = np.nanstd(self.measured_mm) / np.sqrt(self.count)
        return float(np.hypot(np.median(known), standard_error))


def ball_distances(body: Body, balls: pa.Table, poses: pa.Table) -> list[BallDistance]:
    """Every pair of the body's balls, from the tables of a run."""
    at = {name: np.full((poses.num_rows, 3), np.nan) for name in body.names}
    spread = {name: np.full((poses.num_rows, 3, 3), np.nan) for name in body.names}
    names = balls["ball"].to_numpy()
    rows = np.searchsorted(poses["index"].to_numpy(), balls["index"].to_numpy())
    place = numbers(balls, *PLACE[:3])
    covariances = matrices(balls, "covariance_mm2", 3)
    for name in body.names:
        its = names == name
        at[name][rows[its]], spread[name][rows[its]] = place[its], covariances[its]
    return [
        BallDistance((a, b), nominal, *_lengths(at[b] - at[a], spread[a] + spread[b]))
        for (a, b), nominal in body.distances().items()
    ]


def origin_distance(relative: pa.Table, body: str, reference: str) -> BallDistance:
    """Of two bodies' origins over a run, from its relative poses that are not flagged."""
    mine = pc.and_(pc.equal(relative["body"], body), pc.equal(relative["reference"], reference))
    table = relative.filter(mine)
    place = numbers(table, *PLACE[:3])
    place[table["status"].to_numpy() != "ok"] = np.nan
    covariances = matrices(table, "covariance", 6)[:, :3, :3]
    return BallDistance((body, reference), np.nan, *_lengths(place, covariances))


def _lengths(apart: Floats, covariances: Floats) -> tuple[Floats, Floats]:
    """Lengths (n,) of differences (n, 3), and their standard deviations by (n, 3, 3)."""
    lengths = np.linalg.norm(apart, axis=1)
    along = apart / lengths[:, None]
    return lengths, np.sqrt(np.einsum("ni,nij,nj->n", along, covariances, along))


def body_notes(
    body: Body,
    cameras: Sequence[Camera],
    distances: Sequence[BallDistance],
    detections: pa.Table,
    poses: pa.Table,
) -> tuple[str, ...]:
    """What is wrong or weak about the body file, a line each, with its level; by a run's tables."""
    sizes = outline_growth(_seen(detections, poses), body, cameras)
    weak = (*size_findings(body, sizes), *twin_findings(body))
    return (*contradictions(body, distances), *map(str, weak))


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


def contradictions(body: Body, distances: Sequence[BallDistance]) -> tuple[str, ...]:
    """Distances that contradict the body file by more than both uncertainties; a line each.

    Distances come from rays alone: a calibration of the wrong scale contradicts it as well.
    """
    known = [
        Compared(
            what=one.balls,
            measured_mm=one.mean_mm,
            sd_mm=math.hypot(one.uncertainty_mm, body.distance_sd_mm),
            file_mm=one.nominal_mm,
            frames=one.count,
            tolerance_mm=0.0,
        )
        for one in distances
        if one.count >= MIN_FRAME_SETS and np.isfinite(one.uncertainty_mm)
    ]
    return tuple(
        f"{Level.WRONG}: {finding}; the body file or the calibration is off, and poses with it"
        for finding in layout_findings(known, body)
    )
