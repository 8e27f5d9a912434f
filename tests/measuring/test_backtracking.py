"""From where the body is found, back to the pictures in which it was not."""

from __future__ import annotations

import numpy as np
import pytest

from measure.geometry import RigidTransform
from measure.measuring import Status
from tests.tracking_rig import Oracle, run

_LATE = 3
"""The number of frame sets in which a search finds nothing."""


def moving(body):
    """A body that drifts and turns."""

    def world(time_s):
        place = [60.0 * time_s, -20.0 * time_s, 5.0]
        return [(body, RigidTransform.from_rotvec([0.0, 0.3 * time_s, 0.1], place))]

    return world


@pytest.fixture
def searches_fail(monkeypatch):
    """Searches of whole images find nothing before frame set `_LATE`, windows do."""
    see = Oracle.detect

    def detect(self, image, expected):
        self.frames = [*getattr(self, "frames", []), image.frame]
        return see(self, image, expected) if expected or image.frame >= _LATE else []

    monkeypatch.setattr(Oracle, "detect", detect)


def measure(body, rig, **options):
    cameras = {camera.name: camera for camera in rig}
    return run(body, moving(body), cameras, 8, remeasure_after_search=True, **options)


@pytest.mark.usefixtures("searches_fail")
def test_backtracking_finds_what_a_search_missed(paper_body, rig, monkeypatch):
    monkeypatch.setattr(Oracle, "stateful", False)
    measured, detectors, _ = measure(paper_body, rig, smoothing=True)
    assert [one.index for one in measured] == list(range(8))
    assert [one.status for one in measured] == [Status.OK] * 8
    for one in measured:
        ((_, true),) = moving(paper_body)(one.time_s)
        assert np.linalg.norm(one.pose.world_from_body.translation - true.translation) < 0.1
        assert bool(one.searched) == (one.index <= _LATE)
    assert detectors[rig[0].name].frames == [0, 1, 2, 3, 3, 2, 1, 0, 4, 5, 6, 7]


@pytest.mark.usefixtures("searches_fail")
@pytest.mark.parametrize(("stateful", "smoothing"), [(True, True), (False, False)])
def test_no_backtracking_when_stateful_or_without_smoothing(
    paper_body, rig, monkeypatch, stateful, smoothing
):
    monkeypatch.setattr(Oracle, "stateful", stateful)
    measured, detectors, _ = measure(paper_body, rig, smoothing=smoothing)
    assert [one.status for one in measured] == [Status.LOST] * _LATE + [Status.OK] * 5
    frames = detectors[rig[0].name].frames
    assert frames == sorted(frames)


@pytest.mark.usefixtures("searches_fail")
def test_backtracking_ends_where_the_body_came_into_view(paper_body, rig, monkeypatch):
    """The search was right: there is nothing in the first pictures."""
    monkeypatch.setattr(Oracle, "stateful", False)
    measured, _, _ = measure(
        paper_body, rig, smoothing=True, hide=lambda _ball, _camera, time_s: time_s < 2 / 30 - 0.01
    )
    wanted = [Status.LOST] * 2 + [Status.OK] * 6
    assert [one.status for one in measured] == wanted


@pytest.mark.usefixtures("searches_fail")
def test_the_number_of_waiting_frame_sets_is_limited(paper_body, rig, monkeypatch):
    monkeypatch.setattr(Oracle, "stateful", False)
    monkeypatch.setattr("measure.measuring.backtracking.MAX_WAITING", 2)
    measured, _, _ = measure(paper_body, rig, smoothing=True)
    assert [one.status for one in measured] == [Status.LOST] + [Status.OK] * 7
