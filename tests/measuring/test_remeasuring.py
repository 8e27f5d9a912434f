"""After a search the balls are measured once more, where they were found."""

from __future__ import annotations

import pytest
from measurements import BODY, CAMERAS, measurement

from measure.host import Conclusion
from measure.measuring import Pipeline, Stages
from measure.measuring.tracking import Memoryless
from measure.model import Detection, Expectation, FrameSet, Image, Pose


class _Tracker(Memoryless):
    """Predicts nothing at first, and every ball after the first measurement."""

    def __init__(self, loses=()):
        super().__init__(Memoryless.Config(), BODY, CAMERAS)
        self.known, self.loses = False, list(loses)

    def expect(self, frame_set):
        if not self.known:
            return super().expect(frame_set)
        around = [Expectation(name, [0, 0], (1, 9), 5.0, 3.0) for name in BODY.names]
        return dict.fromkeys(frame_set.images, around)

    def conclude(self, frame_set, views, positions, pose, residuals_px):
        if self.known and frame_set.index in self.loses:
            self.loses.remove(frame_set.index)
            self.known = False
            return Conclusion(None, "lost")
        self.known = pose is not None
        return super().conclude(frame_set, views, positions, pose, residuals_px)


class _Detector:
    """Finds every ball for a number of calls; counts the windows of each call."""

    def __init__(self, camera, calls=99):
        self.camera, self.calls, self.expected = camera, calls, []

    def detect(self, image, expected):
        self.expected.append(len(expected))
        views = measurement(image.frame).views if len(self.expected) <= self.calls else ()
        return [v.detection for v in views if v.camera == self.camera]


class _Solver:
    def solve(self, positions, detections, cameras, time_s, prior=None):
        assert all(isinstance(d, Detection) for d in detections)
        return measurement(0).pose


class _Triangulator:
    def triangulate_all(self, detections, cameras):
        return [measurement(0).positions[0] for _ in {d.ball for d in detections}]


def _measure(remeasure_after_search, calls=99, loses=()):
    detectors = {camera.name: _Detector(camera.name, calls) for camera in CAMERAS}
    stages = Stages(
        detectors, _Tracker(loses), _Triangulator(), _Solver(), False, False, remeasure_after_search
    )
    images = {c.name: Image(c.name, 0, 0.0, lambda: None) for c in CAMERAS}
    sets = [FrameSet(index, index / 30, images) for index in range(3)]
    measured = list(Pipeline(BODY, CAMERAS, stages).measure(sets))
    return measured, detectors["cam0"].expected


def test_the_first_frame_is_detected_twice_and_counts_once():
    measured, expected = _measure(remeasure_after_search=True)
    assert expected == [0, 3, 3, 3]
    assert [m.index for m in measured] == [0, 1, 2]
    assert measured[0].searched == ("cam0", "cam1")
    assert measured[1].searched == ()
    assert all(isinstance(m.pose, Pose) for m in measured)


def test_without_remeasuring_every_frame_is_detected_once():
    assert _measure(remeasure_after_search=False)[1] == [0, 3, 3]


@pytest.mark.parametrize("remeasure_after_search", [True, False])
def test_a_search_that_finds_nothing_is_not_repeated(remeasure_after_search):
    measured, expected = _measure(remeasure_after_search, calls=0)
    assert expected == [0, 0, 0]
    assert all(m.pose is None for m in measured)


def test_images_in_which_the_body_is_lost_are_searched():
    """The search used to wait for the next frame set: each loss cost one that shows the body."""
    measured, expected = _measure(remeasure_after_search=True, loses=[1])
    assert expected[:3] == [0, 3, 3]
    assert expected[3:] == [0, 3, 3]  # searched, measured there, and on with the next
    assert all(isinstance(m.pose, Pose) for m in measured)
    assert measured[1].searched == ("cam0", "cam1")
    assert measured[1].reason == ""


def test_a_body_out_of_sight_is_searched_for_once_a_frame_set():
    measured, expected = _measure(remeasure_after_search=True, calls=2)
    assert expected == [0, 3, 3, 0, 0]
    assert [m.pose is None for m in measured] == [False, True, True]
    assert all(m.reason for m in measured[1:])


def test_without_remeasuring_nothing_is_searched_twice():
    measured, expected = _measure(remeasure_after_search=False, loses=[1])
    assert expected == [0, 3, 0]
    assert measured[1].pose is None
