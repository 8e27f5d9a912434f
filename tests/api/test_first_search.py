"""Rendered sessions searched from nothing: what is recognised, and among how many candidates."""

from __future__ import annotations

import numpy as np
import pytest

from measure.api import build_pipeline, load_profile
from measure.host import Registry
from measure.measuring.association import associate
from measure.session import open_session, read_trajectory, session_truth

_FRAME_SETS = 4
_MOST_CANDIDATES = 40
"""Per frame set: the dim room with distractor balls has about thirty."""


@pytest.mark.parametrize(
    ("name", "least"),
    [("still", 0.7), ("occluded", 0.5), ("clutter", 0.7), ("async", 0.7)],
)
def test_every_first_frame_set_shows_the_body(shared, name, least):
    """By far more sightings than a pose needs, and nowhere near a wrong place.

    Cameras of `async` see a moving body up to 30 ms apart: hence the millimetres.
    """
    folder = shared / "renders" / name
    truth = read_trajectory(session_truth(folder))
    with open_session(folder) as session:
        stages = build_pipeline(
            load_profile("precise"), Registry.discover(), session.body, session.cameras
        ).stages
        sightings = len(session.body.balls) * len(session.cameras)
        recognised = []
        for frame_set, _ in zip(session.frame_sets(), range(_FRAME_SETS), strict=False):
            found = {n: stages.detectors[n].detect(im, ()) for n, im in frame_set.images.items()}
            body = associate(session.body, session.cameras, found)
            assert body.reason == ""
            assert body.doubts == ()
            assert sum(map(len, found.values())) <= _MOST_CANDIDATES
            time_s = np.mean([d.time_s for d in body.detections])
            off = body.world_from_body.translation - truth.at(time_s).translation
            assert np.linalg.norm(off) < 4
            recognised.append(len(body.detections) / sightings)
    assert np.mean(recognised) > least
