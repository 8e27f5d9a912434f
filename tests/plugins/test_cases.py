"""One table: light, balls and cameras of every kind, and what the default method makes of them.

The compiled kernels are tested here, through the door that users take: a fault in one of them shows
as pixels, as millimetres, or as errors that the stated covariance does not hold.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from measure.api import load_profile, measure_session
from measure.host import Registry
from measure.session import open_session, read_trajectory
from tests.simulated.catalogue import scene_catalogue
from tests.simulated.sessions import rendered
from tests.simulated.unusual import unusual_scenes

pytestmark = pytest.mark.slow
TIMES_S = (0.0, 0.1, 0.2)


@dataclass(frozen=True)
class Case:
    """What is measured, and how far it may be off at most."""

    name: str  # of a scene
    centers_px: float  # RMS along an axis of the centres of balls that count
    position_mm: float  # RMS of the pose
    rotation_deg: float  # RMS of the pose


CASES = (
    Case("clutter", 0.44, 0.08, 0.35),
    Case("sharpened", 0.22, 0.04, 0.07),
    Case("desk-lamp", 0.54, 0.13, 0.19),
    Case("overexposed", 0.52, 0.07, 0.05),
    Case("far", 0.27, 0.14, 0.4),
    Case("out-of-round", 0.13, 0.02, 0.03),
)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_errors_stay_within_bounds_and_within_what_is_stated(case):
    off_px, off, squares = [], [], []
    scene = {**scene_catalogue(), **unusual_scenes()}[case.name]
    with open_session(rendered(scene, TIMES_S)) as session:
        truth = read_trajectory(session.truth_path)
        cameras = {camera.name: camera for camera in session.cameras}
        measured = measure_session(session, load_profile("precise"), Registry.discover())
        for _, one in measured:
            assert one.pose is not None, one.doubts
            delta = one.pose.world_from_body.difference(truth.at([one.pose.time_s])[0])
            off.append([np.linalg.norm(delta[:3]), np.degrees(np.linalg.norm(delta[3:]))])
            squares.append(delta @ np.linalg.solve(one.pose.covariance, delta) / 6)
            for d in (view.detection for view in one.views if view.effective):
                ball = session.body.balls[session.body.index(d.ball)]
                pose = truth.at([d.time_s])[0]
                off_px += list(
                    d.center_px - cameras[d.camera].project(pose.apply(ball.center_mm)[None])[0]
                )
    found = np.sqrt(np.mean(np.square(off_px))), *np.sqrt(np.mean(np.square(off), axis=0))
    assert len(off_px) >= 60
    assert np.all(np.array(found) < [case.centers_px, case.position_mm, case.rotation_deg])
    assert np.median(squares) < 4
