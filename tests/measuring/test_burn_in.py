"""Before a recording is measured, detectors that learn see how it begins; others see it once."""

from __future__ import annotations

from itertools import pairwise

import pytest
from measurements import BODY, CAMERAS

from measure.api import load_profile, measure_session
from measure.errors import SessionError
from measure.geometry import RigidTransform
from measure.host import Loaded, Registry, SelfCalibratingDetector
from measure.host.registry import Distribution
from measure.measuring import Pipeline, Stages, burn_in
from measure.measuring.tracking.predictive import PredictiveTracker
from measure.measuring.tracking.settings import PredictiveConfig
from measure.session import open_session
from measure_plugins.pose_solvers.kabsch import KabschConfig, KabschSolver
from measure_plugins.triangulators.reprojection import ReprojectionConfig, ReprojectionTriangulator
from tests.session.conftest import write_recording
from tests.tracking_rig import Oracle, frame_sets

_FRAMES = 6


class Blind(SelfCalibratingDetector):
    """Finds nothing, and remembers the numbers of the pictures it is shown."""

    name = "blind"
    needs_burn_in = False
    instances: list[Blind] = []  # noqa: RUF012

    def __init__(self, config, body, camera):
        super().__init__(config, body, camera)
        self.shown, self.heard = [], []
        self.instances.append(self)

    def detect(self, image, expected):
        self.shown.append(image.frame)
        return []

    @property
    def calibration_state(self):
        return self.camera.name, len(set(self.shown))

    def fuse_calibration(self, states):
        self.heard.append(states)

    def enter_realtime(self):
        raise AssertionError("a recording is not measured in real time")


class Curious(Blind):
    """The same, and wants to see three pictures first."""

    name = "curious"
    wants = 3

    @property
    def needs_burn_in(self):
        return len(set(self.shown)) < self.wants


class Insatiable(Oracle, SelfCalibratingDetector):
    """Knows the truth, and still wants to see more."""

    needs_burn_in, calibration_state, shown = True, None, 0

    def fuse_calibration(self, states):
        assert states == [None, None]

    def enter_realtime(self):
        raise AssertionError("a recording is not measured in real time")

    def detect(self, image, expected):
        self.shown = max(self.shown, image.frame + 1)
        return super().detect(image, expected)


@pytest.fixture
def recording(tmp_path):
    return write_recording(tmp_path / "recording", frames=_FRAMES)


def measurements(folder, detector):
    """The measurements of a recording by a detector, one by one."""
    Blind.instances.clear()
    acme = Distribution("acme", "1")
    registry = Registry([*Registry.discover().loaded, Loaded("detector", "any", acme, detector)])
    profile = load_profile("precise").with_stage("detector", "any").with_stage("solver", "kabsch")
    with open_session(folder) as session:
        for _, measured in measure_session(session, profile, registry):
            yield measured


def measure(folder, detector):
    """The indices of what was measured, and the detectors that were shown anything."""
    measured = [one.index for one in measurements(folder, detector)]
    return measured, [one for one in Blind.instances if one.shown]


def test_without_burn_in_time_never_runs_backwards(recording):
    _, detectors = measure(recording.path, Blind)
    for detector in detectors:
        assert sorted(set(detector.shown)) == list(range(_FRAMES))
        assert all(before <= after for before, after in pairwise(detector.shown))
        assert len(detector.heard) == 0


def test_a_stateful_detector_gets_no_burn_in(recording, monkeypatch):
    monkeypatch.setattr(Curious, "stateful", True)
    _, detectors = measure(recording.path, Curious)
    assert _in_turn(detectors[0].shown) == list(range(_FRAMES))


def test_burn_in_shows_the_first_images_then_all(recording):
    measured, detectors = measure(recording.path, Curious)
    assert measured == list(range(_FRAMES))
    assert len(detectors) == 3, "the detectors that learnt measure"
    for detector in detectors:
        assert _in_turn(detector.shown) == [*range(3), *range(_FRAMES)]
        assert detector.heard == [[("cam0", 3), ("cam1", 3), ("cam2", 3)]]


def test_a_short_recording_is_used_whole_for_burn_in(recording, monkeypatch):
    monkeypatch.setattr(Curious, "wants", 100)
    measured, detectors = measure(recording.path, Curious)
    assert len(measured) == _FRAMES
    assert _in_turn(detectors[0].shown) == [*range(_FRAMES), *range(_FRAMES)]


def test_a_picture_that_cannot_be_read_is_told_when_it_is_due(recording):
    """Not before the pictures in front of it have been measured."""
    (recording.path / "cam1" / "000001.jpg").write_bytes(b"no picture")
    measured = measurements(recording.path, Curious)
    assert next(measured).index == 0
    with pytest.raises(SessionError, match="000001"):
        next(measured)


@pytest.mark.parametrize(("hidden", "shown"), [(False, 16), (True, 64)])
def test_a_burn_in_ends_whatever_the_detectors_want(hidden, shown):
    """Sooner where the body is there: a camera that has not seen it by then hardly will."""
    pose = RigidTransform.identity()

    def world(_):
        return [] if hidden else [(BODY, pose)]

    cameras = {camera.name: camera for camera in CAMERAS}
    detectors = {name: Insatiable(BODY, camera, world) for name, camera in cameras.items()}
    stages = Stages(
        detectors,
        PredictiveTracker(PredictiveConfig(), BODY, CAMERAS),
        ReprojectionTriangulator(ReprojectionConfig()),
        KabschSolver(KabschConfig(), BODY),
        per_image_timestamps=True,
        smoothing=False,
        remeasure_after_search=True,
    )
    burn_in.burn_in(Pipeline(BODY, CAMERAS, stages), frame_sets(cameras, 100))
    assert [detector.shown for detector in detectors.values()] == [shown, shown]


def _in_turn(numbers):
    """Numbers without those that repeat the one before: a picture may be looked at again."""
    return [b for a, b in pairwise([None, *numbers]) if a != b]
