"""A doubt about which body is tracked ends when the body is seen alone, and not before."""

from __future__ import annotations

import numpy as np

from measure.geometry import RigidTransform
from measure.measuring import Status
from tests.scenes import RAVEN, TARGET, ring
from tests.tracking_rig import run

CAMERAS = ring()
HERE = RigidTransform.from_rotvec(np.array([0.1, -0.2, 0.3]), TARGET)
FAR = RigidTransform.from_rotvec(np.array([0.4, 0.1, -0.3]), TARGET + np.array([90.0, 60.0, 20.0]))


def doubted(measured):
    return [any("another body" in f or "second body" in f for f in m.pose.flags) for m in measured]


def put_elsewhere(time_s):
    """Taken away at 0.5 s and put down 110 mm further, within a tenth of a second."""
    if time_s < 0.5:
        return [(RAVEN, HERE)]
    return [] if time_s < 0.6 else [(RAVEN, FAR)]


def test_a_body_put_elsewhere_is_doubted_until_it_was_seen_alone_for_a_while():
    measured, _, _ = run(RAVEN, put_elsewhere, CAMERAS, count=120)
    later = [m for m in measured if m.time_s > 0.75 and m.pose is not None]
    flags = doubted(later)
    assert all(f for m, f in zip(later, flags, strict=True) if m.time_s < 1.5)
    assert not any(f for m, f in zip(later, flags, strict=True) if m.time_s > 2.4)
    assert [m.status for m in later if m.time_s > 2.4] == [Status.OK] * len(
        [m for m in later if m.time_s > 2.4]
    )


def test_it_stays_doubted_while_another_body_is_in_view():
    def world(time_s):
        """The body is hidden but for two balls once the other has come."""
        return [(RAVEN, HERE)] if time_s < 0.5 else [(RAVEN, FAR), (RAVEN, HERE)]

    def hidden(detection):
        if detection.time_s < 0.5 or detection.ball != "green":
            return False
        camera = CAMERAS[detection.camera]
        (at,) = camera.project(HERE.apply(RAVEN.centers)[[RAVEN.index("green")]])
        return bool(np.linalg.norm(at - detection.center_px) < 15)

    measured, _, _ = run(RAVEN, world, CAMERAS, count=120, start_s=0.6, hide_one=hidden)
    posed = [m for m in measured if m.pose is not None]
    assert posed
    assert all(doubted(posed))


def test_without_a_doubt_whole_images_are_searched_once():
    _, detectors, _ = run(RAVEN, lambda _: [(RAVEN, HERE)], CAMERAS, count=60)
    assert all(detector.searched == 1 for detector in detectors.values())
