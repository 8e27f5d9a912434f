"""One model explains what is wrong with a rig: the smallest cause that does, and its rivals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.checking import Level, diagnosis, search_sample, with_velocities
from measure.checking.causes import ALL, Cause, Word, significant
from measure.checking.diagnosis import Diagnosis, diagnose
from measure.checking.search import loose_sample
from measure.checking.sightings import evidence_of
from measure.geometry import RigidTransform
from tests.scenes import FOUR, RAVEN, TARGET, moved, ring, see

CAMERAS = ring()
COUNT, RATE = 24, 30.0
PHASES = np.array([0.0, 0.008, 0.016, 0.024])


def path(time_s):
    shift = 40 * np.array([np.sin(5 * time_s), np.cos(3.7 * time_s), np.sin(2.1 * time_s)])
    turn = 0.4 * np.sin([3 * time_s, 5 * time_s, 0.5])
    return RigidTransform.from_rotvec(turn, TARGET + shift)


def diagnosed(
    real=lambda k: CAMERAS,
    stated=None,
    body=RAVEN,
    late=lambda k: np.zeros(4),
    gaps=None,
    seed=0,
    search=search_sample,
    stray=(),
    stray_px=(400.0, 90.0),
    aside_px=(0.0, 0.0),
    truth=RAVEN,
    rate=RATE,
):
    """`real(k)` says where cameras truly stand; `late(k)` how late their stamps are, in s.

    In frame sets that are `stray` one ball is seen `stray_px` beside; in all pictures the colours
    of balls lie `aside_px` of them.
    """
    cameras = list((stated or CAMERAS).values())
    found, samples = [], []
    for k in range(COUNT):
        rng = np.random.default_rng([seed, k])
        seen = see(real(k), truth, path, 0.1, rng, k / rate + np.zeros(4))
        stamps = dict(zip(CAMERAS, k / rate + late(k), strict=True))
        seen = [
            replace(d, time_s=stamps[d.camera], center_px=np.add(d.center_px, aside_px))
            for d in seen
        ]
        if k in stray:
            seen[-1] = replace(seen[-1], center_px=np.add(seen[-1].center_px, stray_px))
        names = [camera.name for camera in cameras]
        found.append({name: [d for d in seen if d.camera == name] for name in names})
        time_s = float(np.median([stamps[name] for name in names]))
        samples.append(search(found[-1], body, cameras, time_s))
    evidence = evidence_of(with_velocities(samples), found, (), body, cameras, gaps)
    return diagnose(evidence)


def turned(name, rotvec_camera, cameras=CAMERAS):
    camera = cameras[name]
    rotvec = camera.world_from_camera.rotate(rotvec_camera)
    return {**cameras, name: moved(camera, camera.world_from_camera.perturb([0, 0, 0, *rotvec]))}


def zoomed(share, *names):
    by = np.array([[share, share, 1], [share, share, 1], [1, 1, 1]])
    return {
        name: replace(c, intrinsics=replace(c.intrinsics, matrix=c.intrinsics.matrix * by))
        if name in names
        else c
        for name, c in CAMERAS.items()
    }


def first(diagnosis):
    assert diagnosis.causes
    return diagnosis.causes[0]


@pytest.mark.parametrize("seed", range(2))
def test_a_right_rig_has_no_cause(seed):
    found = diagnosed(seed=seed)
    assert found.causes == ()
    assert not found.unexplained
    late = diagnosed(late=lambda k: PHASES, real=lambda k: CAMERAS, seed=seed)
    assert first(late).cause in (Word.CLOCK, Word.ROLLING)  # pictures of one time, other stamps


@pytest.mark.parametrize("aside_px", [(-0.5, 0.5), (0.25, 0.0)])
def test_colours_that_a_codec_displaces_alike_in_all_pictures_are_no_cause(aside_px):
    """Half colours sampled at the corner of four pixels, or at the left of two, and spread."""
    assert not diagnosed(aside_px=aside_px).causes
    found = diagnosed(aside_px=aside_px, real=lambda k: turned("cam2", [0.002, 0, 0]))
    assert (first(found).cause, first(found).of) == (Word.MOVED, "cam2")


def stated(estimate, sd, level=Level.WRONG, nothing=0.0):
    return Cause(Word.SCALE, ALL, "", "", level, estimate, sd, nothing=nothing)


def test_an_estimate_that_may_be_chance_is_no_cause_and_an_unsure_one_not_wrong():
    sure, unsure, chance = stated(-0.61, 0.1), stated(0.59, 0.1), stated(0.29, 0.1)
    unmeasured = Cause(Word.MIRRORED, "cam1", "", "", Level.WRONG)
    kept = significant([chance, unmeasured, sure, unsure])
    assert kept == [unmeasured, sure, replace(unsure, level=Level.WEAK)]
    assert not significant([stated(1.002, 0.001, nothing=1.0)])
    assert significant([stated(0.993, 0.001, Level.NOTE, 1.0)])[0].level is Level.NOTE


@pytest.mark.parametrize("name", ["cam0", "cam2"])
def test_a_knocked_camera_is_named_with_amount_and_time(name):
    knocked = turned(name, [0.004, -0.003, 0])
    cause = first(diagnosed(real=lambda k: knocked if k >= 8 else CAMERAS))
    assert (cause.cause, cause.of, cause.level) == (Word.MOVED_AT, name, Level.WRONG)
    assert cause.estimate == pytest.approx(np.degrees(0.005), rel=0.1)
    assert abs(cause.estimate - np.degrees(0.005)) < 4 * cause.sd
    assert "0.27 s" in cause.text
    assert "measure up to there" in cause.remedy


def test_a_camera_that_drifts_is_named_with_its_rate():
    """In a minute; one that was knocked midway, or stands elsewhere from the start, does not."""
    name, slow, deg_a_minute = "cam2", COUNT / 60, 0.2
    way = np.radians(deg_a_minute) * np.array([0.6, -0.8, 0.0])
    cause = first(diagnosed(real=lambda k: turned(name, way * k / slow / 60), rate=slow))
    assert (cause.cause, cause.of, cause.unit) == (Word.DRIFT, name, "deg/min")
    assert abs(cause.estimate - deg_a_minute) < 2 * cause.sd
    assert cause.sd < deg_a_minute / 5
    assert diagnosed(rate=slow).causes == ()
    knocked = turned(name, way)
    midway = first(diagnosed(real=lambda k: knocked if k >= 12 else CAMERAS, rate=slow))
    assert (midway.cause, midway.of) == (Word.MOVED_AT, name)
    always = first(diagnosed(real=lambda _: knocked, rate=slow))
    assert (always.cause, always.of) == (Word.MOVED, name)


def test_what_is_no_ball_hides_no_cause():
    knocked, stray = turned("cam1", [0.004, -0.003, 0]), (3, 9)
    found = diagnosed(real=lambda k: knocked if k >= 12 else CAMERAS, stray=stray)
    assert (first(found).cause, first(found).of) == (Word.MOVED_AT, "cam1")
    assert not diagnosed(stray=stray).causes


def test_a_rolled_camera_is_not_said_to_point_elsewhere():
    cause = first(diagnosed(real=lambda k: turned("cam1", [0, 0, 0.03])))
    assert (cause.cause, cause.of) == (Word.MOVED, "cam1")
    assert cause.estimate == pytest.approx(np.degrees(0.03), abs=max(4 * cause.sd, 0.1))
    assert "is rolled by +1.7" in cause.text


def test_a_camera_wrong_from_the_start_is_named():
    found = diagnosed(real=lambda k: turned("cam2", [0.005, 0.004, 0]))
    assert (first(found).cause, first(found).of) == (Word.MOVED, "cam2")
    assert first(found).explains > 0.9
    assert len(found.causes) == 1


@pytest.mark.parametrize(("late_s", "name"), [(0.015, "cam1"), (-0.08, "cam3")])
def test_a_clock_is_told_from_a_turn(late_s, name):
    late = np.where([n == name for n in CAMERAS], late_s, 0.0)
    cause = first(diagnosed(late=lambda k: late))
    assert (cause.cause, cause.of, cause.unit) == (Word.CLOCK, name, "ms")
    assert cause.estimate == pytest.approx(-1e3 * late_s, abs=max(4 * cause.sd, 3))


def test_a_clock_that_steps_is_no_moved_camera():
    one = np.array([0.0, 0.1, 0.0, 0.0])
    gaps = {"cam1": np.array([[11 / RATE, 0.1]])}
    cause = first(diagnosed(late=lambda k: one * (k >= 12), gaps=gaps))
    assert (cause.cause, cause.of) == (Word.CLOCK_STEP, "cam1")
    assert cause.estimate == pytest.approx(100, abs=5)
    assert not diagnosed(gaps=gaps).causes, "pictures were lost, and its clock is right"


def test_stamps_that_run_fast_are_neither_a_step_nor_a_moved_camera():
    cause = first(diagnosed(late=lambda k: np.array([0.0, 0.0, 0.02, 0.0]) * k / RATE))
    assert (cause.cause, cause.of, cause.unit) == (Word.CLOCK, "cam2", "%")
    assert cause.estimate == pytest.approx(2.0, abs=max(4 * cause.sd, 0.3))
    assert "fast" in cause.text


def test_a_zoomed_camera_and_all_zoomed():
    cause = first(diagnosed(stated=zoomed(0.97, "cam1")))
    assert (cause.cause, cause.of) == (Word.ZOOM, "cam1")
    assert cause.estimate == pytest.approx(100 * (1 / 0.97 - 1), abs=0.3)
    cause = first(diagnosed(stated=zoomed(0.98, *CAMERAS)))
    assert (cause.cause, cause.of) == (Word.ZOOM, ALL)


def test_a_scale_is_told_from_the_lengths_of_the_body_file():
    far = {
        name: moved(c, RigidTransform(c.world_from_camera.rotation, 0.99 * c.center))
        for name, c in CAMERAS.items()
    }
    cause = first(diagnosed(stated=far))
    assert (cause.cause, cause.of) == (Word.SCALE, ALL)
    assert cause.estimate == pytest.approx(0.99, abs=0.002)
    small = RAVEN.with_centers(0.99 * RAVEN.centers)
    cause = first(diagnosed(body=small))
    assert cause.cause is Word.PLACE or f"{Word.PLACE} of {ALL}" in cause.rivals


def test_one_ball_out_of_its_place():
    off = RAVEN.with_centers(RAVEN.centers + np.array([[0, 0, 0], [0, 2.0, 0], [0, 0, 0]]))
    cause = first(diagnosed(body=off))
    assert (cause.cause, cause.of) == (Word.PLACE, RAVEN.names[1])
    assert cause.estimate == pytest.approx(2.0, abs=0.3)
    assert 0 < cause.sd < 0.3


def test_of_two_cameras_either_may_be_wrong():
    two = {name: CAMERAS[name] for name in ("cam0", "cam1")}
    found = diagnosed(stated=two, real=lambda k: turned("cam1", [0.004, 0, 0]))
    assert {cause.of for cause in found.causes} <= {"cam0, cam1"}


FLAT = FOUR.with_centers(np.array([[29.0, 2, 1], [1, 33, 10], [-31, -7, -1], [3, -31, -9]]))


@pytest.mark.parametrize(("a", "b"), [(0, 2), (1, 3)])
def test_two_exchanged_of_four_balls_are_named_and_not_two_others(a, b):
    """Nearly the body's own half turn: the pose hides most of it."""
    order = list(range(4))
    order[a], order[b] = b, a
    cause = first(diagnosed(truth=FLAT, body=FLAT.with_centers(FLAT.centers[order])))
    assert cause.cause is Word.EXCHANGED_BALLS
    assert cause.of == f"{FLAT.names[a]}, {FLAT.names[b]}"
    assert not diagnosed(truth=FLAT, body=FLAT).causes


def test_a_mirrored_file_of_a_nearly_flat_body_is_no_ball_out_of_its_place():
    cause = first(diagnosed(truth=FLAT, body=FLAT.with_centers(FLAT.centers * [-1, 1, 1])))
    assert (cause.cause, cause.of) == (Word.MIRRORED, "body")
    off = np.array([[0, 0, 1.5], [0, 0, 0], [0, 0, 0], [0, 0, 0]])
    cause = first(diagnosed(truth=FLAT, body=FLAT.with_centers(FLAT.centers + off)))
    assert cause.cause is Word.PLACE


@pytest.mark.parametrize("other", ["cam1", "cam2"])
def test_of_two_cameras_one_stands_14_mm_off(other):
    """No two rays meet: the body is found only if they need not."""
    camera = CAMERAS[other]
    step = camera.world_from_camera.rotate(np.array([14.0, 0, 0]))
    there = moved(camera, camera.world_from_camera.perturb([*step, 0, 0, 0]))
    two, real = {"cam0": CAMERAS["cam0"], other: camera}, lambda k: {**CAMERAS, other: there}
    assert not diagnosed(stated=two, real=real).causes
    cause = first(diagnosed(stated=two, real=real, search=loose_sample))
    assert (cause.cause, cause.of) == (Word.MOVED, f"cam0, {other}")
    assert "contradict each other" in cause.text


WANDERS = [(4, 1.0, 0.0013), (4, 0.85, 0.0013), (4, 0.0, 0.002), (2, 1.0, 0.0013)]


@pytest.mark.parametrize(("cameras", "returns", "step"), WANDERS)
def test_a_picture_that_wanders_or_is_stabilised_is_no_moved_camera(cameras, returns, step):
    rng, at = np.random.default_rng(3), np.zeros((COUNT, 2))
    for k in range(1, COUNT):
        at[k] = returns * at[k - 1] + rng.normal(0, step, 2)
    stated = {name: CAMERAS[name] for name in ("cam2", "cam1", "cam0", "cam3")[:cameras]}
    cause = first(diagnosed(stated=stated, real=lambda k: turned("cam2", [*at[k], 0])))
    assert (cause.cause, cause.of) == (Word.UNKNOWN, "cam2" if cameras > 2 else "cam2, cam1")
    assert "wanders" in cause.text


def test_a_camera_that_is_knocked_twice_does_not_wander():
    once, again = turned("cam1", [0.004, -0.003, 0]), turned("cam1", [0.002, -0.005, 0])
    found = diagnosed(real=lambda k: again if k >= 16 else once if k >= 8 else CAMERAS)
    assert {(c.cause, c.of) for c in found.causes} == {(Word.MOVED_AT, "cam1")}
    assert {round(c.since_s * RATE) for c in found.causes} == {8, 16}


def test_a_clock_and_a_moved_camera_are_both_named():
    late = np.array([0, 0.03, 0, 0])
    found = diagnosed(late=lambda k: late, real=lambda k: turned("cam3", [0.005, 0, 0]))
    assert [(c.cause, c.of) for c in found.causes] == [(Word.CLOCK, "cam1"), (Word.MOVED, "cam3")]


def test_what_nothing_explains_is_unknown():
    shake = np.random.default_rng(5).normal(0, 0.006, (COUNT, 2))
    found = diagnosed(real=lambda k: turned("cam1", [*shake[k], 0]))
    cause = first(found)
    assert (cause.cause, cause.of) == (Word.UNKNOWN, "cam1")
    assert found.unexplained


def test_a_few_views_of_other_things_are_no_contradiction_between_cameras():
    found = diagnosed(search=loose_sample, stray=range(COUNT // 3), stray_px=(14.0, 6.0))
    assert found.unexplained
    assert not found.causes


@pytest.mark.parametrize(("share", "kept"), [(0.6, True), (1.0, False)])
def test_whole_pictures_overrule_what_was_followed_if_they_explain_as_much(
    monkeypatch, share, kept
):
    words = ((Word.CLOCK_STEP, 1.0), (Word.MOVED_AT, share))
    causes = [Cause(word, "cam2", "", "", Level.WRONG, explains=of_all) for word, of_all in words]
    answers = iter([Diagnosis((cause,), 4.0, 0.5) for cause in causes])
    monkeypatch.setattr(diagnosis, "evidence_of", lambda *_: None)
    monkeypatch.setattr(diagnosis, "diagnose", lambda *_: next(answers))
    found = diagnosis.diagnose_recording(((), ()), [None], RAVEN, [], {}, squares=False)
    assert found.causes == (causes[not kept],)
