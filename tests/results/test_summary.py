"""A run in a few numbers."""

from __future__ import annotations

import json

import pyarrow as pa

from measure.checking import Finding, Level
from measure.model import Doubt
from measure.results.summary import summarise

SEEN = pa.table(
    {"ball": ["red"], "camera": ["cam0"], "state": ["effective"], "index": [0], "reason": [""]}
)


def test_doubts_of_one_kind_are_counted_together():
    vague = [Doubt("poorly-determined", sd_mm=mm, sd_deg=deg) for mm, deg in ((85, 180), (160, 3))]
    rows = [("too dark",), (vague[0], Doubt("two-balls")), (vague[1],), ()]
    poses = _poses(*[("flagged", 1.0)] * len(rows))
    doubts = [[json.dumps(Doubt.of(one).plain) for one in row] for row in rows]
    poses = poses.set_column(poses.column_names.index("doubts"), "doubts", pa.array(doubts))
    found = summarise(SEEN, poses)
    assert list(found.reasons.items()) == [
        ("poorly determined: 85-1.6e+02 mm, 3-1.8e+02 deg (1 sd)", 2),
        ("too dark", 1),
        ("fewer than three balls in sight", 1),
    ]
    assert json.loads(json.dumps(found.values()["doubts"]))[:2] == [
        {"code": "poorly-determined", "sd_mm": [85, 160], "sd_deg": [3, 180], "frame_sets": 2},
        {"code": "other", "text": "too dark", "frame_sets": 1},
    ]


def _poses(*rows: tuple[str, float]) -> pa.Table:
    """A status and a position's standard deviation each."""
    statuses, sds = zip(*rows, strict=True)
    numbers = {"position_sd_mm": sds, "rotation_sd_deg": sds, "rms_px": sds}
    numbers |= dict.fromkeys(("x_mm", "y_mm"), [0.0] * len(rows)) | {"z_mm": [250.0] * len(rows)}
    words = {"status": statuses, "reason": [""] * len(rows), "doubts": [[]] * len(rows)}
    return pa.table({**words, **numbers})


def test_poses_to_doubt_make_no_position_known():
    some = summarise(SEEN, _poses(("ok", 0.1), ("flagged", 5.0), ("flagged", 6.0)))
    assert "position known to 0.1 mm" in some.sentence()
    assert (some.position_sd_mm, some.rotation_sd_deg, some.rms_px) == (0.1, 0.1, 0.1)
    none = summarise(SEEN, _poses(("flagged", 0.1), ("flagged", 0.1)))
    assert none.sentence() == (
        "0 of 2 frame sets measured, 2 with a pose to doubt; no position is known"
    )
    assert none.values()["position_sd_mm"] is None


def test_the_scale_of_the_rig_stands_beside_what_is_known_within_it():
    summary = summarise(SEEN, _poses(("ok", 0.1)), scale_sd=0.001)
    assert summary.sentence().endswith(
        "position known to 0.1 mm, rotation to 0.1 deg within this rig (median standard deviation);"
        " its scale is known to 0.1 %, 0.25 mm at the body"
    )
    assert (summary.values()["scale_sd"], summary.values()["scale_sd_mm"]) == (0.001, 0.25)


def test_a_camera_that_took_part_in_no_pose_is_named():
    rows = [("cam0", "effective", ""), ("cam1", "suspended", "not found")]
    rows += [("cam1", "suspended", "no image"), ("cam1", "suspended", "not found")]
    cameras, states, reasons = zip(*rows, strict=True)
    columns = {"camera": cameras, "state": states, "reason": reasons}
    seen = pa.table({"ball": ["red"] * 4, "index": [0] * 4, **columns})
    poses = _poses(("ok", 0.1))
    (note,) = summarise(seen, poses).notes
    assert "camera cam1 took part in no pose (its balls: not found)" in note.text
    lost = Finding(Level.NOTE, "frames", "cam0 lost a picture")
    late = Finding(Level.WRONG, "clock", "cam0: its clock is late", subject="cam0")
    summary = summarise(seen, poses, [lost, late])
    assert summary.notes == (lost, late, note)
    assert summary.findings == (late,)
    assert summary.values()["notes"][:2] == ["note: cam0 lost a picture", f"wrong: {late.text}"]
    assert summarise(SEEN, poses).notes == ()
    assert summarise(seen.slice(1), poses).notes == (), "nobody saw anything: not this camera's"
