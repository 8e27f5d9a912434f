"""A run in a few numbers."""

from __future__ import annotations

import pyarrow as pa

from measure.results.summary import summarise

SEEN = pa.table(
    {"ball": ["red"], "camera": ["cam0"], "state": ["effective"], "index": [0], "reason": [""]}
)


def test_reasons_are_counted_without_their_numbers():
    reasons = [
        "poorly determined: 85 mm, 1.8e+02 deg (1 sd); one camera only (cam3): its distance rests",
        "poorly determined: 1.6e+02 mm, 3 deg (1 sd)",
        "",
        "one camera only (cam1): its distance rests",
    ]
    poses = pa.table(
        {
            "status": ["flagged", "flagged", "ok", "flagged"],
            "reason": reasons,
            "position_sd_mm": [1.0] * 4,
            "rotation_sd_deg": [1.0] * 4,
            "rms_px": [1.0] * 4,
        }
    )
    assert summarise(SEEN, poses).reasons == {
        "poorly determined: … mm, … deg (… sd)": 2,
        "one camera only (cam3): its distance rests": 1,
        "one camera only (cam1): its distance rests": 1,
    }


def _poses(*rows: tuple[str, float]) -> pa.Table:
    """A status and a position's standard deviation each."""
    statuses, sds = zip(*rows, strict=True)
    numbers = {"position_sd_mm": sds, "rotation_sd_deg": sds, "rms_px": sds}
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


def test_a_camera_that_took_part_in_no_pose_is_named():
    rows = [("cam0", "effective", ""), ("cam1", "suspended", "not found")]
    rows += [("cam1", "suspended", "no image"), ("cam1", "suspended", "not found")]
    cameras, states, reasons = zip(*rows, strict=True)
    columns = {"camera": cameras, "state": states, "reason": reasons}
    seen = pa.table({"ball": ["red"] * 4, "index": [0] * 4, **columns})
    poses = _poses(("ok", 0.1))
    (note,) = summarise(seen, poses).notes
    assert "camera cam1 took part in no pose (its balls: not found)" in note
    assert summarise(seen, poses, ["cam0 lost a picture"]).notes == ("cam0 lost a picture", note)
    assert summarise(SEEN, poses).notes == ()
    assert summarise(seen.slice(1), poses).notes == (), "nobody saw anything: not this camera's"
