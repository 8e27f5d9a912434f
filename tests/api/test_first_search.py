"""Rendered sessions searched from nothing: what is recognised, and among how many candidates."""

from __future__ import annotations

import numpy as np
import pytest

from measure.api import build_pipeline, load_profile
from measure.host import Registry
from measure.measuring.association import associate
from measure.session import open_session, read_trajectory, session_truth

_FRAME_SETS = 4
_MOST_CANDIDATES = 48
"""Per frame set: the dim room with distractor balls has about forty."""


@pytest.mark.parametrize(
    ("name", "least"), [("still", 0.7), ("occluded", 0.5), ("clutter", 0.7), ("async", 0.7)]
)
def test_every_first_frame_set_shows_the_body(renders, name, least):
    """By far more sightings than a pose needs, and nowhere near a wrong place.

    Cameras of `async` see a moving body up to 30 ms apart: hence the millimetres.
    """
    folder = renders / name
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
            assert body.flags == ()
            assert sum(map(len, found.values())) <= _MOST_CANDIDATES
            time_s = np.mean([d.time_s for d in body.detections])
            off = body.world_from_body.translation - truth.at(time_s).translation
            assert np.linalg.norm(off) < 4
            recognised.append(len(body.detections) / sightings)
    assert np.mean(recognised) > least


_STANDARD = 2.45
"""95 % of two errors, independent and normal, lie within this many standard deviations."""
_OWN_RADII = 0.5
"""What is further from a ball's centre than this share of its radius is not that ball."""


def errors_of_outlines(folder, frame_sets):
    """How far the rough outlines of balls are from the true centres, and their sd, px."""
    truth = read_trajectory(session_truth(folder))
    off, sd = [], []
    with open_session(folder) as session:
        detectors = build_pipeline(
            load_profile("precise"), Registry.discover(), session.body, session.cameras
        ).stages.detectors
        cameras = {camera.name: camera for camera in session.cameras}
        for frame_set, _ in zip(session.frame_sets(), range(frame_sets), strict=False):
            for d in (d for n, im in frame_set.images.items() for d in detectors[n].detect(im, ())):
                center = session.body.balls[session.body.index(d.ball)].center_mm
                pixel = cameras[d.camera].project(truth.at(d.time_s).apply(center)[None])[0]
                error = float(np.linalg.norm(d.center_px - pixel))
                if error < _OWN_RADII * d.radius_px:
                    off.append(error)
                    sd.append(np.sqrt(d.variance_px2))
    return np.array(off), np.array(sd)


@pytest.mark.parametrize("name", ["still", "occluded", "clutter", "async"])
def test_a_rough_outline_says_how_far_it_may_be_off(renders, name):
    """Also where most of it is hidden: such outlines are off by pixels, and claim no less.

    Edges taken one by one would claim a tenth of a pixel, also of those.
    """
    off, sd = errors_of_outlines(renders / name, 12)
    assert len(off) > 25
    assert np.mean(off < _STANDARD * sd) > 0.7
    assert 0.4 < np.median(off / sd) < 1.8
    assert np.median(sd) < 0.8
    told, not_told = sd < np.quantile(sd, 0.5), sd > np.quantile(sd, 0.8)
    assert np.mean(off[not_told] ** 2) > 3**2 * np.mean(off[told] ** 2)
