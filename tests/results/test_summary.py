"""A run in a few numbers."""

from __future__ import annotations

import pyarrow as pa

from measure.results.summary import summarise


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
    seen = pa.table(
        {"ball": ["red"], "camera": ["cam0"], "state": ["effective"], "index": [0], "reason": [""]}
    )
    assert summarise(seen, poses).reasons == {
        "poorly determined: … mm, … deg (… sd)": 2,
        "one camera only (cam3): its distance rests": 1,
        "one camera only (cam1): its distance rests": 1,
    }
