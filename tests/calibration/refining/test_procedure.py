"""Cameras and clocks together, from measurements."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.calibration import refine_measured, rough_cameras
from measure.calibration.refining.recording import calibration_disagrees, recording_of
from measure.errors import CalibrationError
from measure.measuring import Status
from measure.model.observations import Reason, State
from tests.checking.test_clocks import CAMERAS, OFFSETS, moving, recorded, still
from tests.scenes import RAVEN

FIRST = tuple(CAMERAS.values())


def slipped(seed: int = 1) -> tuple:
    rng = np.random.default_rng(seed)
    slip = np.repeat([0.3, np.deg2rad(0.05)], 3)
    return tuple(
        replace(c, world_from_camera=c.world_from_camera.perturb(rng.normal(0, slip)))
        for c in FIRST
    )


@pytest.fixture(scope="module")
def late():
    return list(recorded(moving, OFFSETS))


@pytest.fixture(scope="module")
def in_step():
    return list(recorded(moving))


def test_frame_sets_in_which_two_balls_are_seen_play_no_part(in_step) -> None:
    """Their poses have a turn that nothing fixes, and would leave the adjustment singular."""
    hidden = RAVEN.names[0]

    def without(measured):
        views = tuple(
            replace(v, state=State.SUSPENDED, reason=Reason.NOT_FOUND) if v.ball == hidden else v
            for v in measured.views
        )
        return replace(measured, views=views)

    kept = recording_of([without(m) if k < 5 else m for k, m in enumerate(in_step)], RAVEN)
    whole = recording_of(in_step, RAVEN)
    assert len(kept.times_s) == len(whole.times_s) - 5
    assert kept.times_s[0] == whole.times_s[5]


def test_clocks_that_are_off_are_found_and_applied(late) -> None:
    found = refine_measured(slipped(), RAVEN, late)
    assert found.clocks_applied
    for clock, true in zip(found.clocks, OFFSETS, strict=True):
        assert abs(clock.offset_s - true) < 4 * clock.offset_sd_s + 1e-5
    leads = {c: t.lead_s[0] for c, t in found.recording.tracks.items()}
    plain = {c: t.lead_s[0] for c, t in recording_of(late, RAVEN).tracks.items()}
    moved = np.array([leads[c] - plain[c] for c in CAMERAS])
    np.testing.assert_allclose(moved, OFFSETS, atol=1e-3)


def test_cameras_in_step_are_left_in_step(in_step) -> None:
    found = refine_measured(slipped(), RAVEN, in_step)
    assert not found.clocks_applied
    for clock in found.clocks:
        assert abs(clock.offset_s) < 3 * clock.offset_sd_s


def test_cameras_come_closer_to_the_truth(in_step) -> None:
    first = slipped()
    found = refine_measured(first, RAVEN, in_step).refinement.cameras

    def off(cameras):
        turns = [
            a.world_from_camera.difference(b.world_from_camera)[3:]
            for a, b in zip(cameras, FIRST, strict=True)
        ]
        return np.linalg.norm(turns - np.mean(turns, axis=0))

    assert off(found) < 0.5 * off(first)


def test_a_body_that_stands_still_is_refused() -> None:
    with pytest.raises(CalibrationError, match=r"the body moved \d+\.\d mm only"):
        refine_measured(FIRST, RAVEN, list(recorded(still, count=20)))


def set_aside(measurements, camera: str):
    """As when a camera disagrees: its views are inconsistent, and the poses flagged."""
    out = []
    for m in measurements:
        views = tuple(
            replace(v, state=State.SUSPENDED, reason=Reason.INCONSISTENT)
            if v.camera == camera
            else v
            for v in m.views
        )
        pose = replace(m.pose, flags=(f"camera {camera} contradicts the others",))
        out.append(replace(m, views=views, pose=pose, status=Status.FLAGGED))
    return out


def test_cameras_too_far_off_to_agree_are_refined_roughly_first(in_step) -> None:
    doubtful = set_aside(in_step, "cam1")
    assert calibration_disagrees(doubtful)
    with pytest.raises(CalibrationError, match=r"unflagged pose.*camera cam1 sees the"):
        refine_measured(slipped(), RAVEN, doubtful)
    first = list(slipped())
    turn = [0, 0, 0, 0, 0, np.deg2rad(0.5)]
    first[1] = replace(first[1], world_from_camera=first[1].world_from_camera.perturb(turn))
    rough = rough_cameras(tuple(first), RAVEN, doubtful)
    error = rough[1].world_from_camera.difference(FIRST[1].world_from_camera)
    assert np.degrees(np.linalg.norm(error[3:])) < 0.2


def test_cameras_that_agree_need_no_rough_refinement(in_step) -> None:
    assert rough_cameras(FIRST, RAVEN, in_step) is None


@pytest.mark.parametrize("flagged", [False, True])
def test_a_camera_that_sees_nothing_where_the_others_do_is_named(in_step, flagged) -> None:
    """As after a search: what does not fit is set aside with no detection to tell where it was."""
    blind = []
    for m, aside in zip(in_step, set_aside(in_step, "cam2"), strict=True):
        views = tuple(
            replace(view, detection=None) if view.camera == "cam2" else view for view in aside.views
        )
        blind.append(replace(aside if flagged else m, views=views))
    with pytest.raises(CalibrationError, match=r"camera cam2 sees the balls elsewhere .* in 90 of"):
        (rough_cameras if flagged else refine_measured)(slipped(), RAVEN, blind)
