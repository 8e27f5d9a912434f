"""A run in a few numbers."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from measure.checking.finding import Finding, Level
from measure.model import Doubt, Reason
from measure.model.doubts import counted
from measure.results.tables import doubts_of

WHICH_ACCURACY = {
    "forecast": (
        "this is a forecast, from geometry and the noise of a search of whole pictures; the poses "
        "of `measure run` are measured finer and state their own, and `measure evaluate` compares "
        "with a truth"
    ),
    "stated": (
        "this is what poses state of themselves, 3-D, one standard deviation; `measure check` "
        "forecasts from coarser detections, and `measure evaluate` compares with a truth"
    ),
    "measured": (
        "these are differences from the truth; what poses state counts all that calibration, body "
        "and light may err by; one recording shows one case of it"
    ),
}
"""Which accuracy a command tells: three questions, so three figures for one rig."""


@dataclass(frozen=True)
class Summary:
    """The contents of `summary.json`."""

    frame_sets: int  # how many there are
    ok: int  # with an unflagged pose
    flagged: int  # with a flagged pose
    lost: int  # without a pose
    skipped: int  # not tried, while tracking restarts
    # median standard deviation of the position, of the unflagged poses; NaN without any.
    position_sd_mm: float
    rotation_sd_deg: float  # the same of the rotation
    rms_px: float  # median reprojection error
    scale_sd: float  # standard deviation of the world's scale, which `position_sd_mm` is without
    # what that makes of the median distance from the world's origin.
    scale_sd_mm: float
    # share of frame sets in which a camera saw a ball effectively, by "ball@camera".
    effective: dict[str, float]
    suspended: dict[str, int]  # how often each reason suspended a view
    # how often each kind of reason, with its numbers' range and all names, kept a frame set from
    # being "ok"; and how often a camera of a live run was away.
    reasons: dict[Doubt, int]
    # what the session left to be known: missing pictures and the like; cameras that took part in no
    # pose; and what is wrong with stamps, pictures and rig.
    notes: tuple[Finding, ...] = field(default=(), compare=False)
    # those of the notes that `measure check` gives as well, likeliest cause first.
    findings: tuple[Finding, ...] = field(default=(), compare=False)
    # of a run of several bodies, the summary of each by its name. A frame set then counts by its
    # worst body, and standard deviations are those of the worst.
    bodies: Mapping[str, Summary] = field(default_factory=dict)

    def sentence(self) -> str:
        """The run in one sentence; never more than the data say."""
        parts = [f"{self.ok} of {self.frame_sets} frame sets measured"]
        for count, what in (
            (self.flagged, "with a pose to doubt"),
            (self.lost, "without a pose"),
            (self.skipped, "skipped"),
        ):
            parts += [f"{count} {what}"] if count else []
        text = ", ".join(parts)
        if math.isnan(self.position_sd_mm):
            return f"{text}; no position is known"
        return (
            f"{text}; position known to {self.position_sd_mm:.2g} mm, rotation to "
            f"{self.rotation_sd_deg:.2g} deg within this rig (median standard deviation)"
            + self._scale()
        )

    def _scale(self) -> str:
        if not self.scale_sd:
            return ""
        return (
            f"; its scale is known to {100 * self.scale_sd:.2g} %, {self.scale_sd_mm:.2g} mm at "
            "the body"
        )

    def values(self) -> dict[str, Any]:
        """As written: NaN becomes null."""
        values = {
            key: None if isinstance(value, float) and math.isnan(value) else value
            for key, value in vars(self).items()
        }
        del values["bodies"]
        values["doubts"] = [one.plain | {"frame_sets": n} for one, n in self.reasons.items()]
        values["notes"] = [str(note) for note in self.notes]
        values["findings"] = [asdict(finding) for finding in self.findings]
        if self.bodies:
            values["bodies"] = {name: one.values() for name, one in self.bodies.items()}
        return values


def summarise(
    detections: pa.Table,
    poses: pa.Table,
    notes: Sequence[Finding] = (),
    findings: Sequence[Finding] = (),
    scale_sd: float = 0.0,
) -> Summary:
    """Count and average the tables of a run; notes are the session's, and findings on the rig."""
    statuses = Counter(poses["status"].to_pylist())
    seen = detections.group_by(["ball", "camera", "state"], use_threads=False)
    used = [
        row
        for row in seen.aggregate([("index", "count")]).to_pylist()
        if row["state"] == "effective"
    ]
    effective = {
        f"{row['ball']}@{row['camera']}": row["index_count"] / poses.num_rows for row in used
    }
    suspended = detections.filter(pc.equal(detections["state"], "suspended"))
    unflagged = poses.filter(pc.equal(poses["status"], "ok"))
    return Summary(
        frame_sets=poses.num_rows,
        ok=statuses["ok"],
        flagged=statuses["flagged"],
        lost=statuses["lost"],
        skipped=statuses["skipped"],
        position_sd_mm=_median(unflagged["position_sd_mm"]),
        rotation_sd_deg=_median(unflagged["rotation_sd_deg"]),
        rms_px=_median(unflagged["rms_px"]),
        scale_sd=scale_sd,
        scale_sd_mm=scale_sd * _median_distance(unflagged) if scale_sd else 0.0,
        effective=dict(sorted(effective.items())),
        suspended=dict(Counter(suspended["reason"].to_pylist()).most_common()),
        reasons=counted(doubts_of(poses)),
        notes=(*notes, *_idle(suspended, {row["camera"] for row in used}), *findings),
        findings=(*(note for note in notes if note.level is not Level.NOTE), *findings),
    )


def together(bodies: Mapping[str, Summary], poses: pa.Table) -> Summary:
    """The summary of a run of several bodies, by those of each and the table of all poses."""
    ranks = {"ok": 0, "flagged": 1, "skipped": 2, "lost": 3}
    worst = dict[int, str]()
    for index, status in zip(poses["index"].to_pylist(), poses["status"].to_pylist(), strict=True):
        worst[index] = max(status, worst.get(index, "ok"), key=ranks.__getitem__)
    counts = Counter(worst.values())

    def named(what: str, name: Callable[[str, Any], Any] = "{}: {}".format) -> dict[Any, Any]:
        return {name(n, key): v for n, s in bodies.items() for key, v in getattr(s, what).items()}

    return Summary(
        frame_sets=len(worst),
        ok=counts["ok"],
        flagged=counts["flagged"],
        lost=counts["lost"],
        skipped=counts["skipped"],
        position_sd_mm=float(np.max([one.position_sd_mm for one in bodies.values()])),
        rotation_sd_deg=float(np.max([one.rotation_sd_deg for one in bodies.values()])),
        rms_px=float(np.max([one.rms_px for one in bodies.values()])),
        scale_sd=float(np.max([one.scale_sd for one in bodies.values()])),
        scale_sd_mm=float(np.max([one.scale_sd_mm for one in bodies.values()])),
        effective=named("effective"),
        suspended=named("suspended"),
        reasons=named("reasons", lambda body, doubt: doubt.of_body(body)),
        notes=tuple(
            dict.fromkeys(
                note
                if all(note in one.notes for one in bodies.values())
                else replace(note, text=f"{name}: {note.text}")
                for name, summary in bodies.items()
                for note in summary.notes
            )
        ),
        findings=tuple(finding for one in bodies.values() for finding in one.findings),
        bodies=bodies,
    )


def _idle(suspended: pa.Table, used: set[str]) -> Iterator[Finding]:
    """A line for every camera without an effective view, where another had one."""
    reasons: dict[str, Counter[str]] = {}
    for row in suspended.select(["camera", "reason"]).to_pylist():
        reasons.setdefault(row["camera"], Counter())[row["reason"]] += 1
    main = {name: counts.most_common(1)[0][0] for name, counts in reasons.items()}
    question = "does its calibration fit, and does it see the body? "
    for name, reason in main.items():
        if used and name not in used:
            asked = "" if reason == Reason.NO_IMAGE else question
            text = Doubt("camera-unused", camera=name, reason=reason, asked=asked)
            yield Finding(Level.NOTE, "cameras", text, subject=name)


def _median_distance(poses: pa.Table) -> float:
    """Median distance, in mm, of poses from the world's origin."""
    place = np.stack([poses[f"{axis}_mm"].to_numpy() for axis in "xyz"], axis=1)
    return float(np.median(np.linalg.norm(place, axis=1))) if len(place) else float("nan")


def _median(column: pa.ChunkedArray) -> float:
    values = column.to_numpy()
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else float("nan")
