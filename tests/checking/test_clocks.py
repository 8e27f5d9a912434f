from __future__ import annotations

from dataclasses import replace

import numpy as np

from measure.checking.clocks import estimate_clocks
from measure.checking.explaining import fitted
from measure.estimation.pose_fit import PoseObservations, fit_pose
from measure.geometry import RigidTransform
from measure.geometry.covariance import symmetric_inverse
from measure.measuring import Measurement, Status
from measure.model import BallView, Pose
from measure.model.observations import State
from tests.scenes import RAVEN, TARGET, ring, see

CAMERAS = ring()
OFFSETS = np.array([0.002, -0.007, 0.007, -0.002])


def moving(time_s):
    shift = 30 * np.array([np.sin(2.1 * time_s), np.cos(1.6 * time_s), 0.8 * np.sin(1.3 * time_s)])
    turn = 0.4 * np.array([np.sin(1.2 * time_s), np.cos(0.9 * time_s), np.sin(1.7 * time_s)])
    return RigidTransform.from_rotvec(turn, TARGET + shift)


def still(time_s):
    return moving(0.3)


def recorded(path, offsets=(0, 0, 0, 0), readout_s=0.0, count=90, sd_px=0.1, seed=0):
    """Measurements of a recording whose stamps are late by `offsets` and whose rows roll."""
    rng = np.random.default_rng(seed)
    for index in range(count):
        stamps = index / 30 + np.array([0.0, 0.008, 0.016, 0.024])
        detections = []
        for number, (name, camera) in enumerate(CAMERAS.items()):
            exposed = stamps[number] + offsets[number]
            clean = see({name: camera}, RAVEN, path, 0.0, None, np.array([exposed]))
            for k, d in enumerate(clean):
                row = (d.center_px[1] - 359.5) / 720
                pose = path(exposed + readout_s * row)
                seen = see({name: camera}, RAVEN, pose, sd_px, rng, stamps[number])[k]
                detections.append(seen)
        time_s = float(np.mean(stamps))
        start = path(time_s)
        fit = fit_pose(
            start, PoseObservations.of(detections, RAVEN, CAMERAS, time_s), np.zeros(6), 1e3
        )
        views = tuple(BallView(d.ball, d.camera, State.EFFECTIVE, detection=d) for d in detections)
        pose = Pose(time_s, fit.world_from_body, fit.covariance, 0.0, 0.1, tuple(CAMERAS), ())
        yield Measurement(index, time_s, {}, views, (), pose, Status.OK)


def clocks(*args, **kwargs):
    return estimate_clocks(recorded(*args, **kwargs), RAVEN, list(CAMERAS.values()), extra_px=0.01)


def test_one_late_camera_is_the_only_one_that_is_off():
    found = clocks(moving, [0.0, 0.007, 0.0, 0.0])
    assert [clock.offset_visible for clock in found] == [False, True, False, False]
    assert abs(found[1].offset_s - 0.007) < 3 * found[1].offset_sd_s


def test_offsets_are_found():
    found = clocks(moving, OFFSETS)
    for clock, true in zip(found, OFFSETS, strict=True):
        assert abs(clock.offset_s - true) < 4 * clock.offset_sd_s + 1e-5
        assert clock.offset_sd_s < 5e-4
        assert clock.offset_visible == (abs(true) > 1e-9)


def test_rolling_shutter_is_seen():
    found = clocks(moving, OFFSETS, readout_s=0.020)
    for clock, true in zip(found, OFFSETS, strict=True):
        assert clock.rolling
        assert abs(clock.readout_s - 0.020) < 4 * clock.readout_sd_s + 2e-4
        assert abs(clock.offset_s - true) < 4 * clock.offset_sd_s + 5e-5


def test_a_global_shutter_is_not_called_rolling():
    assert not any(clock.rolling for clock in clocks(moving, OFFSETS))


def test_uncertainty_matches_scatter():
    scaled = []
    for seed in range(12):
        for clock, true in zip(clocks(moving, OFFSETS, count=30, seed=seed), OFFSETS, strict=True):
            scaled.append((clock.offset_s - true) / clock.offset_sd_s)
    assert 0.4 < np.std(scaled) < 1.5


def test_a_body_at_rest_tells_nothing():
    for clock in clocks(still, OFFSETS):
        assert not clock.offset_visible
        assert clock.offset_sd_s > 0.05


def test_too_short_a_recording_tells_nothing():
    for clock in clocks(moving, OFFSETS, count=3):
        assert clock.offset_sd_s == np.inf
        assert not clock.offset_visible


def test_a_constant_bias_is_within_the_clock_uncertainty():
    """A short one-way motion: edges seen 0.3 px off look like a clock that is wrong."""
    biased = []
    for m in recorded(moving, count=15, sd_px=0.02):
        views = tuple(
            replace(v, detection=replace(v.detection, center_px=v.detection.center_px + 0.21))
            if v.camera == "cam3"
            else v
            for v in m.views
        )
        biased.append(replace(m, views=views))
    estimated = estimate_clocks(biased, RAVEN, list(CAMERAS.values()), extra_px=0.3)
    assert not any(clock.offset_visible for clock in estimated)
    exact = estimate_clocks(biased, RAVEN, list(CAMERAS.values()), extra_px=0.01)
    pairs = list(zip(estimated, exact, strict=True))
    assert all(a.offset_sd_s > b.offset_sd_s for a, b in pairs)
    assert all(abs(a.offset_s) < 3 * a.offset_sd_s for a in estimated)


def test_clocks_that_diverge_are_unknown(monkeypatch) -> None:
    far = lambda *given: replace(found := fitted(*given), values=1e3 + found.values)
    monkeypatch.setattr("measure.checking.clocks.fitted", far)
    found = estimate_clocks(recorded(moving, OFFSETS, count=20), RAVEN, [*CAMERAS.values()])
    assert all(clock.offset_s == 0 and np.isinf(clock.offset_sd_s) for clock in found)


def test_what_a_matrix_does_not_determine_stays_put() -> None:
    inverse = symmetric_inverse(np.diag([4.0, 0.0, 1e-20]))
    assert np.allclose(np.diag(inverse), [0.25, 0.0, 1e20])
