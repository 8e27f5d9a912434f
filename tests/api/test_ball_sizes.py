"""Balls of other sizes than their file says, in a rendered recording."""

from __future__ import annotations

import re

import numpy as np
import pytest

from measure.api import load_profile
from measure.api.measuring import calibrated_pipeline
from measure.checking.body import size_causes
from measure.host import Registry
from measure.measuring.body_size import outline_growth, seen_balls
from measure.session import open_session, read_trajectory
from tests.simulated.sessions import part_of

pytestmark = pytest.mark.slow
REGION_95 = 12.6
"""95 % of chi-square with six degrees of freedom."""


def stated(still, folder, *shares):
    """A part of the recording whose body file states radii that are off by these shares."""
    part_of(still, range(8), folder)
    text, share = (still / "body.toml").read_text("utf-8"), iter(shares)
    text = re.sub(r"(?<=radius_mm = )[\d.]+", lambda m: f"{float(m[0]) * next(share)}", text)
    (folder / "body.toml").write_text(text, "utf-8")
    return folder


@pytest.mark.parametrize(
    ("shares", "said"), [((1, 1, 1), None), ((1.01, 0.99, 1.01), "balls look larger or smaller")]
)
def test_a_wrong_size_is_found_told_and_does_no_harm(still, tmp_path, shares, said):
    folder = stated(still, tmp_path / "stated", *shares)
    with open_session(folder) as session:
        pipeline = calibrated_pipeline(session, load_profile(), Registry.discover())
        measured = list(pipeline.measure(session.frame_sets()))
        seen = outline_growth(seen_balls(measured), session.body, session.cameras)
        told = size_causes(session.body, seen)
        assert np.array_equal(pipeline.body.radii, session.body.radii) == (said is None)
    sd = np.sqrt(np.diag(pipeline.body.radius_covariance))
    assert np.all(np.abs(pipeline.body.radii - 20) < 2 * sd)
    assert np.all(sd < 0.07)
    assert said in told[0].text if said else not told
    truth = read_trajectory(folder / "truth.csv")
    off = [m.pose.world_from_body.difference(truth.at([m.time_s])[0]) for m in measured]
    inside = [
        e @ np.linalg.solve(m.pose.covariance, e) < REGION_95
        for e, m in zip(off, measured, strict=True)
    ]
    assert np.sqrt(np.mean(np.sum(np.square(off)[:, :3], axis=1))) < 0.04
    assert np.degrees(np.sqrt(np.mean(np.sum(np.square(off)[:, 3:], axis=1)))) < 0.06
    assert np.mean(inside) >= 0.9
