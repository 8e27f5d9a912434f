"""A run in a few numbers."""

from __future__ import annotations

import pyarrow as pa

from measure.checking import Finding, Level
from measure.results.summary import summarise

SEEN = pa.table(
    {"ball": ["red"], "camera": ["cam0"], "state": ["effective"], "index": [0], "reason": [""]}
)


def test_reasons_of_one_kind_are_counted_together():
    reasons = [
        "poorly determined: 85 mm, 1.8e+02 deg (1 sd); one camera only (cam3): its distance rests",
        "poorly determined: 1.6e+02 mm, 3 deg (1 sd)",
        "",
        "one camera only (cam1): its distance rests; ball red sits 2 px off",
        "ball green is seen elsewhere by cam0, cam2",
        "ball red is seen elsewhere by cam1",
    ]
    seen = pa.table(
        {
            "ball": ["red", "green", "red", "red"],
            "camera": ["cam0", "cam1", "cam2", "cam3"],
            "state": ["effective"] * 4,
            "index": [0] * 4,
            "reason": [""] * 4,
        }
    )
    poses = pa.table(
        {
            "status": ["flagged", "flagged", "ok", *["flagged"] * 3],
            "reason": reasons,
            "position_sd_mm": [1.0] * 6,
            "rotation_sd_deg": [1.0] * 6,
            "rms_px": [1.0] * 6,
        }
    )
    assert summarise(seen, poses).reasons == {
        "poorly determined: 85-1.6e+02 mm, 3-1.8e+02 deg (1 sd)": 2,
        "one camera only (cam1, cam3): its distance rests": 2,
        "ball green, red is seen elsewhere by cam0, cam1, cam2": 2,
        "ball red sits 2 px off": 1,
    }


def _poses(*rows: tuple[str, float]) -> pa.Table:
    """A status and a position's standard deviation each."""
    statuses, sds = zip(*rows, strict=True)
    numbers = {"position_sd_mm": sds, "rotation_sd_deg": sds, "rms_px": sds}
    numbers |= dict.fromkeys(("x_mm", "y_mm"), [0.0] * len(rows)) | {"z_mm": [250.0] * len(rows)}
    return pa.table({"status": statuses, "reason": [""] * len(rows), **numbers})


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
