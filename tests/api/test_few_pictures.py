"""Recordings of a few pictures a second: the body moves by half a ball or more between two."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest

from measure.api import build_pipeline, load_profile
from measure.host import Registry
from measure.session import open_session, read_trajectory, session_truth
from measure_plugins.detectors import outline


def seen_every(folder, step):
    """Errors in mm where every so many frame sets are left, and the share of sightings believed."""
    truth, errors, believed = read_trajectory(session_truth(folder)), [], []
    with open_session(folder) as session:
        pipeline = build_pipeline(
            load_profile("precise"), Registry.discover(), session.body, session.cameras
        )
        for measured in pipeline.measure(islice(session.frame_sets(), None, None, step)):
            believed += [view.effective for view in measured.views]
            errors.append(np.inf)
            if measured.pose is not None:
                at = truth.at([measured.pose.time_s])[0]
                errors[-1] = np.linalg.norm(measured.pose.world_from_body.difference(at)[:3])
    return np.array(errors), np.mean(believed)


@pytest.mark.parametrize(("name", "step"), [("still", 2), ("occluded", 1)])
def test_hardly_any_camera_loses_the_body(renders, name, step):
    """At five and 7.5 pictures a second, and up to 60 mm/s; of `occluded` a fifth is hidden."""
    errors, believed = seen_every(renders / name, step)
    assert np.sqrt(np.mean(errors**2)) < 0.12
    assert believed > 0.74


def test_without_colour_cameras_lose_it(renders, monkeypatch):
    """The control: looks across predicted outlines alone."""
    folder = renders / "occluded"
    with_colour, believed = seen_every(folder, 2)
    monkeypatch.setattr(outline, "lost_in_wide_windows", lambda *_: ())
    errors, without = seen_every(folder, 2)
    assert np.sqrt(np.mean(errors**2)) > 1.5 * np.sqrt(np.mean(with_colour**2))
    assert without <= believed
