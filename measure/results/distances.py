"""The body measured with itself: its balls' distances and radii against the body file."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from measure.arrays import Floats
from measure.checking.body import Compared, layout_causes, size_causes, twin_findings
from measure.checking.causes import ALL, Cause, Word, beside, with_weak
from measure.checking.diagnosis import diagnose
from measure.checking.evidence import Evidence, Sighting
from measure.checking.finding import Finding, Level
from measure.checking.pictures import gaps_alone, repeated_causes, same_pictures_cause, seen_causes
from measure.checking.sightings import MOST_INSTANTS
from measure.geometry import RigidTransform
from measure.limits import MAX_PAUSE_S
from measure.measuring.body_size import outline_growth
from measure.model import Body, Camera, Detection, Doubt
from measure.model.observations import Reason, State
from measure.results.tables import PLACE, doubts_of, integers, matrices, numbers

MIN_FRAME_SETS = 5  # Of fewer frame sets the scatter is not known well enough


@dataclass(frozen=True, eq=False)
class BallDistance:
    """One pair of balls over a run, or of bodies' origins."""

    balls: tuple[str, str]  # their names
    nominal_mm: float  # by the body file; NaN of bodies
    measured_mm: Floats  # (n,) in every frame set; NaN where one of them has no position
    # (n,) standard deviations by the positions' covariances, which hold what all frame sets err by
    # alike; so is NaN.
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


def rig_findings(
    body: Body,
    cameras: Sequence[Camera],
    distances: Sequence[BallDistance],
    detections: pa.Table,
    poses: pa.Table,
    known: Collection[str] = (),
) -> tuple[Finding, ...]:
    """What may be wrong with the rig, the likeliest first; by a run's tables.

    Nothing of cameras whose stamps are `known` to be wrong.
    """
    seen, sightings = _sightings(detections, poses)
    enough = len(sightings) >= MIN_FRAME_SETS
    gaps_s = gaps_alone({camera.name: _stamps(detections, camera.name) for camera in cameras})
    evidence = Evidence.of(sightings, body, cameras, gaps_s=gaps_s) if enough else None
    diagnosis = diagnose(evidence)
    said = () if diagnosis.doubtful else diagnosis.causes
    causes = [_told(cause, evidence) for cause in said if evidence]
    doubts = doubts_of(poses)
    shared, repeated = _duplicates(doubts, poses)
    pictures = [*shared, *seen_causes([one for row in doubts for one in row], len(cameras))]
    if not causes and not pictures:
        causes = _contradicting(body, distances)
    if not causes:
        causes = size_causes(body, outline_growth(seen, body, cameras))
    if diagnosis.doubtful and not causes:
        causes = [_unclear(Level.WEAK, ALL, "the balls are not quite where they should be")]
    every = with_weak(beside(pictures, causes), repeated)
    return (*(cause.finding for cause in every if cause.of not in known), *twin_findings(body))


def _duplicates(
    doubts: Sequence[Sequence[Doubt]], poses: pa.Table
) -> tuple[list[Cause], list[Cause]]:
    """Cameras that show another one's pictures, and those that repeat their own."""
    places: dict[Doubt, list[int]] = {}
    for place, row in enumerate(doubts):
        for one in row:
            places.setdefault(one, []).append(place)
    index, times_s = integers(poses, "index"), numbers(poses, "time_s")
    shared, repeated = [], []
    for one, own in places.items():
        names, many = one.values, f"in {len(own)} of {len(index)}"
        if one.code == "pictures-of-another":
            shared.append(same_pictures_cause(names["whose"], names["camera"], many))
        elif one.code == "repeated-pictures":
            camera = names["camera"]
            repeated += repeated_causes(camera, np.array(own), len(index) - 1, times_s, index)
    return shared, repeated


def _stamps(detections: pa.Table, camera: str) -> Floats:
    """Times (n,) of a camera's pictures."""
    own = detections.filter(pc.equal(detections["camera"], camera))["time_s"]
    return np.unique(own.drop_null().to_numpy())


_OF_A_CAMERA = Word.MOVED, Word.MOVED_AT, Word.ZOOM, Word.POINT, Word.UNKNOWN


def _told(cause: Cause, evidence: Evidence) -> Cause:
    """The same, unless its camera or another ball is hardly seen: then the cause is unclear."""
    if cause.cause is Word.PLACE and (balls := {*evidence.hardly_seen(balls=True)} - {cause.of}):
        text = f"the cameras hardly see {', '.join(sorted(balls))} where the body file says"
        return _unclear(Level.WRONG, ALL, text)
    if cause.cause in _OF_A_CAMERA and cause.of in evidence.hardly_seen():
        text = f"{cause.of} sees the balls elsewhere than the others do, or not at all"
        return _unclear(Level.WRONG, cause.of, text)
    return cause


def _unclear(level: Level, of: str, text: str) -> Cause:
    remedy = "`measure check` searches whole pictures, and tells why"
    return Cause(Word.UNKNOWN, of, text, remedy, level, explains=0.0)


def _sightings(
    detections: pa.Table, poses: pa.Table
) -> tuple[list[tuple[RigidTransform, Detection]], list[Sighting]]:
    """Effective detections with the pose of their frame set; and all that is seen at instants.

    Of frame sets, evenly spread, that have a pose.
    """
    place, times_s = numbers(poses, *PLACE), numbers(poses, "time_s")
    posed = np.flatnonzero(np.isfinite(place).all(axis=1))
    if not len(posed):
        return [], []
    motion = RigidTransform.from_quat_wxyz(place[posed, 3:], place[posed, :3])
    before, after = np.maximum(np.arange(len(posed)) - 1, 0), np.arange(1, len(posed) + 1)
    after = np.minimum(after, len(posed) - 1)
    lasts_s = np.maximum(times_s[posed[after]] - times_s[posed[before]], 1e-9)
    steps = RigidTransform(motion.rotation[after], motion.translation[after]).difference(
        RigidTransform(motion.rotation[before], motion.translation[before])
    )
    velocity = np.where(lasts_s[:, None] < MAX_PAUSE_S, steps / lasts_s[:, None], 0.0)
    chosen = np.unique(np.linspace(0, len(posed) - 1, MOST_INSTANTS).round().astype(int))
    order = poses["index"].to_numpy()[posed[chosen]]
    wanted = pc.is_in(detections["index"], value_set=pa.array(order))
    by_index: dict[int, list[Detection]] = {int(index): [] for index in order}
    seen = []
    at = {int(index): int(k) for index, k in zip(order, chosen, strict=True)}
    for row in detections.filter(wanted).to_pylist():
        if row["u_px"] is None or not np.isfinite(row["u_px"]) or row["reason"] == Reason.COLOR:
            continue
        detection = _detection(row)
        by_index[row["index"]].append(detection)
        if row["state"] == State.EFFECTIVE:
            seen.append((motion[at[row["index"]]], detection))
    sightings = [
        Sighting(float(times_s[posed[k]]), motion[int(k)], velocity[k], by_index[int(index)])
        for index, k in zip(order, chosen, strict=True)
    ]
    return seen, sightings


def _detection(row: Mapping[str, Any]) -> Detection:
    uu, uv, vv = (row[f"var_{which}_px2"] for which in ("uu", "uv", "vv"))
    return Detection(
        row["ball"],
        row["camera"],
        row["time_s"],
        np.array([row["u_px"], row["v_px"]]),
        row["radius_px"],
        np.array([[uu, uv], [uv, vv]]),
    )


def contradictions(body: Body, distances: Sequence[BallDistance]) -> tuple[Finding, ...]:
    """Distances that contradict the body file by more than both uncertainties.

    Distances come from rays alone: a calibration of the wrong scale contradicts it as well.
    """
    return tuple(cause.finding for cause in _contradicting(body, distances))


def _contradicting(body: Body, distances: Sequence[BallDistance]) -> list[Cause]:
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
    remedy = "the body file or the calibration is off, and poses with it"
    return [replace(cause, remedy=remedy) for cause in layout_causes(known, body)]
