from __future__ import annotations

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from measure.checking import (
    ColorCount,
    ExposureCount,
    Finding,
    Level,
    coverage_findings,
    expected_accuracy,
    search_sample,
    stamp_findings,
    with_velocities,
)
from measure.checking.body import Compared
from measure.checking.causes import Cause, Word
from measure.checking.pictures import (
    burst_causes,
    rate_causes,
    seen_causes,
    step_causes,
    without_step,
)
from measure.errors import DegenerateGeometryError
from measure.estimation.pose_fit import PoseObservations, fit_pose
from measure.geometry import RigidTransform
from measure.measuring.image_faults import BallSteps, SmearedImages, WovenImages
from measure.model import Detection, FrameSet, Image
from tests.scenes import RAVEN, TARGET, moved, ring, see

CAMERAS = ring()
RIG = list(CAMERAS.values())


def path(time_s):
    shift = 25 * np.array([np.sin(2.4 * time_s), np.cos(1.7 * time_s), np.sin(1.1 * time_s)])
    return RigidTransform.from_rotvec(0.3 * np.sin([time_s, 2 * time_s, 0.5]), TARGET + shift)


def samples(count=20, real=lambda k: CAMERAS, phases=None, hide=()):
    """Every frame set searched; `real(k)` says where the cameras truly stand."""
    out = []
    for k in range(count):
        rng = np.random.default_rng(k)
        times = k / 30 + (np.zeros(4) if phases is None else phases)
        seen = see(real(k), RAVEN, path, 0.1, rng, times, skip=hide)
        by_camera = {name: [d for d in seen if d.camera == name] for name in CAMERAS}
        out.append(search_sample(by_camera, RAVEN, RIG, float(times.mean())))
    return with_velocities(out)


def test_a_pose_that_every_witness_contradicts_is_undetermined():
    seen = see(CAMERAS, RAVEN, path, 0.0, np.random.default_rng(0), np.zeros(4))
    rng = np.random.default_rng(1)
    scattered = [
        replace(d, center_px=d.center_px + rng.normal(0, 60, 2), covariance_px=np.eye(2) * 1e-6)
        for d in seen
    ]
    sightings = PoseObservations.of(scattered, RAVEN, CAMERAS, 0.0)
    with pytest.raises(DegenerateGeometryError, match="do not determine a pose"):
        fit_pose(path(0.0), sightings)


def test_coverage_counts_what_is_hidden():
    hidden = {("red", "cam0"), ("green", "cam0")}
    table, findings = coverage_findings(samples(hide=hidden), RAVEN, RIG)
    by_key = {(row.camera, row.ball): row for row in table}
    assert by_key["cam0", "red"].seen == 0
    assert by_key["cam0", "red"].expected == 20
    assert by_key["cam1", "red"].seen == 20
    missing = {f.text.split(" in ")[0] for f in findings if f.topic == "coverage"}
    assert missing == {"cam0 sees ball red", "cam0 sees ball green"}


def test_balls_behind_others_are_counted_and_longer_arms_are_weighed():
    """Against rays through points of each ball: from cam0, two balls are partly behind others."""
    camera, line = CAMERAS["cam0"], RAVEN.with_centers(RAVEN.centers * [[1], [1], [0]])
    rng, turned = np.random.default_rng(0), RigidTransform.from_rotvec([0.3, 0.5, 0.1], TARGET)
    places = turned.apply(line.centers)
    found = camera.hides(places, line.radii, 1.0)
    for i, j in np.ndindex(found.shape):
        on = rng.normal(size=(4000, 3))
        on *= line.radii[i] / np.linalg.norm(on, axis=1)[:, None]
        way = places[i] + on - camera.center
        way /= np.linalg.norm(way, axis=1)[:, None]
        depth = way @ (places[j] - camera.center)
        off = np.linalg.norm(camera.center + depth[:, None] * way - places[j], axis=1)
        nearer = np.linalg.norm(places - camera.center, axis=1)
        assert found[i, j] == (bool((off < line.radii[j]).any()) and nearer[j] < nearer[i])
    (note,) = (f for f in coverage_findings(samples(), RAVEN, RIG)[1] if "partly behind" in f.text)
    assert note.level is Level.NOTE
    assert "with arms" in note.text
    wide = RAVEN.with_centers(4 * RAVEN.centers)
    alone = [replace(s, world_from_body=path(s.time_s)) for s in samples(3)]
    assert not any("partly behind" in f.text for f in coverage_findings(alone, wide, RIG)[1])


def test_cameras_in_a_row_are_called_weak():
    first = CAMERAS["cam0"]
    near = [
        moved(first, first.world_from_camera.perturb([40.0 * k, 0, 0, 0, 0, 0])) for k in range(4)
    ]
    one = search_sample({}, RAVEN, RIG, 0.0)
    standing = replace(one, world_from_body=path(0.0), reason="")
    _, findings = coverage_findings([standing], RAVEN, near)
    assert any("nearly the same line" in f.text for f in findings)
    assert not any("same line" in f.text for f in coverage_findings([standing], RAVEN, RIG)[1])


@pytest.mark.parametrize(("shown", "level"), [(2, None), (6, Level.WEAK), (14, Level.WRONG)])
def test_a_second_body_is_wrong_where_most_frame_sets_show_one(shown, level):
    """Candidates that noise and compression make lie as far apart as its balls, now and then."""
    flag = "there may be a second body near (16, -283, 161) mm"
    seen = [replace(s, flags=(flag,) * (k < shown)) for k, s in enumerate(samples(24))]
    _, findings = coverage_findings(seen, RAVEN, RIG)
    strangers = [f for f in findings if f.topic == "balls"]
    assert [(f.level, f"{flag} (so in {shown} of 24" in f.text) for f in strangers] == (
        [] if level is None else [(level, True)]
    )


@pytest.mark.parametrize(("found", "level"), [(0, Level.WRONG), (2, Level.WRONG), (4, Level.WEAK)])
def test_a_body_that_is_found_now_and_then_is_hidden_in_between(found, level):
    """Two cameras before which balls hide each other were said to be calibrated wrongly."""
    nothing = search_sample({}, RAVEN, RIG, 0.0)
    _, findings = coverage_findings([*samples(found), *[nothing] * (24 - found)], RAVEN, RIG)
    (finding,) = [f for f in findings if "no pose" in f.text]
    assert finding.level is level
    assert ("check the calibration" in finding.text) == (level is Level.WRONG)


@pytest.mark.parametrize(("off_mm", "level"), [(0.0, Level.WEAK), (9.0, Level.WRONG)])
def test_nothing_found_is_wrong_unless_two_balls_are_as_far_apart_as_they_should(off_mm, level):
    nothing = search_sample({}, RAVEN, RIG, 0.0)
    distances = [Compared(RAVEN.names[:2], 53.7 + off_mm, 0.1, 53.7, 3)]
    _, (finding,) = coverage_findings([nothing] * 3, RAVEN, RIG, distances)
    assert finding.level is level
    assert "no pose in 3 of 3 frame sets" in finding.text
    assert "no ball in view" in finding.text


def test_expected_accuracy_agrees_with_monte_carlo():
    fine = expected_accuracy(path(0.0), 30.0, RAVEN, RIG, 0.1)
    coarse = expected_accuracy(path(0.0), 30.0, RAVEN, RIG, 0.2)
    assert fine.shape == (27, 5)
    np.testing.assert_allclose(coarse[:, 3], 2 * fine[:, 3], rtol=1e-6)
    np.testing.assert_allclose(coarse[:, 4], 2 * fine[:, 4], rtol=1e-6)
    from measure.estimation.pose_fit import PoseObservations, fit_pose

    errors = []
    for seed in range(200):
        seen = see(CAMERAS, RAVEN, path(0.0), 0.1, np.random.default_rng(seed))
        fit = fit_pose(path(0.0), PoseObservations.of(seen, RAVEN, CAMERAS, 0.0))
        errors.append(fit.world_from_body.difference(path(0.0))[:3])
    scatter = np.sqrt(np.mean(np.sum(np.square(errors), axis=1)))
    assert fine[13, 3] == pytest.approx(scatter, rel=0.15)


def test_expected_accuracy_is_unknown_out_of_sight():
    far = RigidTransform(np.eye(3), np.array([5000.0, 0, 0]))
    assert np.all(np.isnan(expected_accuracy(far, 10.0, RAVEN, RIG, 0.1)[:, 3:]))


def test_even_stamps_are_fine():
    assert stamp_findings("cam0", np.arange(100) / 30, np.arange(100)) == []


def test_dropped_frames_are_counted_and_placed():
    kept = np.delete(np.arange(100), [40, 41, 42, 70])
    (finding,) = stamp_findings("cam0", kept / 30, kept)
    assert finding.level is Level.WEAK
    assert "4 frames dropped (4.0 %)" in finding.text
    assert (finding.code, finding.text.values["lost"]) == ("dropped-frames", 4)
    assert "0.133 s after frame 39" in finding.text


def test_uneven_stamps_are_called_arrival_times():
    rng = np.random.default_rng(0)
    times = np.sort(np.arange(200) / 30 + rng.normal(scale=0.005, size=200))
    findings = stamp_findings("cam0", times, np.arange(200))
    assert any("uneven" in f.text and f.topic == "clock" for f in findings)


def test_stamps_in_milliseconds_are_asked_about():
    (finding,) = stamp_findings("cam0", np.arange(100) * 1000 / 30, np.arange(100))
    assert finding.level is Level.WEAK
    assert "33.3 s from picture to picture: are the times milliseconds?" in finding.text
    assert stamp_findings("cam0", np.arange(100) * 5.0, np.arange(100)) == [], "time lapse"


def _frame_set(pictures):
    images = {name: Image(name, 0, 0.0, lambda p=p: p) for name, p in pictures.items()}
    return FrameSet(0, 0.0, images)


def test_grey_pictures_are_told_by_camera():
    rng, count = np.random.default_rng(0), ColorCount()
    grey = rng.integers(0, 256, (240, 320), np.uint8)
    through_jpeg = cv2.imdecode(cv2.imencode(".jpg", grey)[1], cv2.IMREAD_COLOR)
    noisy = np.repeat(grey[..., None] // 2, 3, axis=2) + rng.integers(0, 9, (240, 320, 3), np.uint8)
    for _ in range(2):
        count.add(_frame_set({"cam0": noisy, "cam1": through_jpeg}))
    (finding,) = count.findings()
    assert finding.level is Level.WRONG
    assert "cam1: 2 of 2 pictures are grey" in finding.text


@pytest.mark.parametrize(("gains", "drifts"), [((0.7, 1, 1.4), True), ((1.3, 1.3, 1.3), False)])
def test_colors_that_drift_are_named_and_brightness_is_not(rng, gains, drifts):
    """A ball that moves, and grain, change nothing of it."""
    count, still = ColorCount(), rng.integers(30, 150, (240, 320, 3))
    for k in range(5):
        picture = still * np.array(gains) ** (k / 4) + rng.normal(0, 4, still.shape)
        cv2.circle(picture, (60 + 50 * k, 120), 40, (20, 20, 220), -1)
        count.add(_frame_set({"cam0": picture.astype(np.uint8)}))
    causes = count.causes()
    assert [(cause.cause, cause.of) for cause in causes] == [("exposure", "cam0")] * drifts
    for cause in causes:
        assert [*map(int, re.findall(r"by (.\d+) %", cause.text))] == pytest.approx([-30, 40], 0.1)


def _ball(camera, center, radius):
    return Detection("red", camera, 0.0, np.array(center), radius, np.eye(2))


def test_overexposed_balls_are_told_by_camera():
    """Not those with a highlight, nor a lamp beside them; one at the border counts by its part."""
    pictures = {name: np.full((120, 160, 3), 40, np.uint8) for name in ("full", "lit", "border")}
    for name, where in (("full", (80, 60)), ("lit", (80, 60)), ("border", (0, 60))):
        cv2.circle(pictures[name], where, 20, (30, 30, 200), -1)
    cv2.ellipse(pictures["full"], (80, 60), (20, 20), 0, 180, 260, (30, 30, 255), -1)
    cv2.circle(pictures["lit"], (72, 52), 4, (255, 255, 255), -1)
    cv2.circle(pictures["lit"], (130, 60), 25, (255, 255, 255), -1)
    cv2.circle(pictures["border"], (0, 60), 12, (30, 30, 255), -1)
    balls = [_ball("full", (80.0, 60), 20.0), _ball("lit", (80.0, 60), 20.0)]
    balls.append(_ball("border", (0.0, 60), 20.0))
    count = ExposureCount()
    for _ in range(3):
        count.add(_frame_set(pictures), balls)
    full, border = count.causes()
    assert full.level is Level.WEAK
    assert "full: balls are overexposed (red in 3 of 3 pictures)" in full.text
    assert border.text.startswith("border: ")


@pytest.mark.parametrize(("share", "is_dark"), [(1.0, False), (0.7, False), (0.3, True)])
def test_dark_pictures_are_named(share: float, is_dark: bool):
    picture = np.full((120, 160, 3), 36, np.uint8)
    cv2.circle(picture, (80, 60), 20, (30, 30, 170), -1)
    count = ExposureCount()
    for _ in range(3):
        count.add(_frame_set({"cam0": (share * picture).astype(np.uint8)}), [])
    causes = count.causes()
    assert [(cause.cause, cause.of) for cause in causes] == [("exposure", "cam0")] * is_dark


def test_occasional_overexposure_is_no_finding():
    dark, bright = (np.full((120, 160, 3), value, np.uint8) for value in (90, 255))
    count, ball = ExposureCount(), _ball("cam0", (80.0, 60), 20.0)
    for picture in (dark, bright, dark):
        count.add(_frame_set({"cam0": picture}), [ball])
    assert count.causes() == []


def test_too_short_a_recording_is_weak():
    (finding,) = stamp_findings("cam0", np.array([0.0, 0.1]), np.arange(2))
    assert "only 2 frames" in finding.text


def test_bursts_are_no_dropped_frames():
    times = np.repeat(np.arange(20) / 5, 6) + np.tile(np.arange(6), 20) * 4e-4
    (cause,) = burst_causes({"cam0": np.arange(120) / 30, "cam1": times})
    assert "bursts of 6 every 2" in cause.text
    assert (cause.of, cause.level) == ("cam1", Level.WRONG)
    assert stamp_findings("cam1", times, np.arange(120)) == []


def test_as_many_pictures_that_last_longer_run_at_another_rate():
    even = {f"cam{k}": np.arange(30) / 30 for k in range(4)}
    assert rate_causes(even) == []
    assert rate_causes({**even, "cam1": np.arange(24) / 30}) == [], "it stopped earlier"
    assert rate_causes({**even, "cam1": np.arange(25) / 25}) == [], "it is slower"
    (cause,) = rate_causes({**even, "cam1": np.arange(30) / 25})
    assert (cause.cause, cause.of) == ("clock", "cam1")
    assert "1.200 times as fast" in cause.text


def ball_at(x_px: float) -> np.ndarray:
    pixels = np.full((120, 160, 3), 20, np.uint8)
    cv2.circle(pixels, (round(16 * x_px), 60 * 16), 30 * 16, (30, 30, 180), -1, 16, 4)
    return pixels


def woven(x_px: float, step_px: float) -> np.ndarray:
    """Odd rows are half a picture later."""
    pixels = ball_at(x_px)
    pixels[1::2] = ball_at(x_px + step_px / 2)[1::2]
    return pixels


def grainy(x_px: float, along_px: float = 0.0) -> np.ndarray:
    """As a cheap camera's in the dark; its grain may be smoothed along the rows."""
    grain = np.random.default_rng(round(1e3 * x_px)).normal(0, 1, (120, 160, 3))
    grain = cv2.GaussianBlur(grain, (9, 1), along_px) if along_px else grain
    return np.clip(ball_at(x_px) + 18 * grain / grain.std(), 0, 255).astype(np.uint8)


def coarse(pixels: np.ndarray, quality: int = 20) -> np.ndarray:
    coded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR))


@pytest.mark.parametrize(
    ("show", "is_woven"),
    [
        (woven, True),
        (lambda x, step: coarse(woven(x, step), 60), True),
        (lambda x, _: ball_at(x), False),
        (lambda x, _: grainy(x), False),
        (lambda x, _: grainy(x, 1.0), False),
        (lambda x, _: coarse(grainy(x)), False),
        (lambda x, _: np.repeat(ball_at(x)[::2], 2, axis=0), False),
    ],
)
def test_rows_of_two_instants_are_told_from_grain(show, is_woven: bool) -> None:
    steps, images, step_px = BallSteps(), WovenImages(), 3.0
    for index in range(15):
        x_px = 60 + step_px * index
        image = Image("cam0", index, index / 30, lambda x=x_px: show(x, step_px))
        ball = Detection("red", "cam0", 0.0, np.array([x_px, 60.0]), 30.0, 0.01 * np.eye(2))
        images.add(steps.of(FrameSet(index, index / 30, {"cam0": image}), [ball], look=True))
    assert images.cameras == ["cam0"] * is_woven
    found = [(c.cause, c.of) for c in seen_causes(images.flags, 3)]
    assert found == [("interlaced", "cam0")] * is_woven


OTHERS = {f"cam{k}": np.arange(60) / 30 + 0.004 * k for k in (0, 2, 3)}


@pytest.mark.parametrize("step_s", [0.15, 2.0, 3600.0])
def test_a_clock_that_was_set_is_told_from_lost_pictures_by_their_number(step_s):
    frames = np.arange(60)
    own = frames / 30 + step_s * (frames >= 25)
    (cause,) = step_causes({**OTHERS, "cam1": own})
    assert (cause.cause, cause.of, cause.unit) == (Word.CLOCK_STEP, "cam1", "ms")
    assert cause.estimate == pytest.approx(1e3 * step_s, abs=0.1)
    assert cause.since_s == pytest.approx(24 / 30)
    np.testing.assert_allclose(without_step(own, cause), frames / 30, atol=1e-6)
    kept = np.delete(frames, slice(25, 25 + min(round(30 * step_s), 30)))
    assert not step_causes({**OTHERS, "cam1": kept / 30}), "pictures were lost"
    assert not step_causes(OTHERS)


@pytest.mark.parametrize(("size", "apart_s"), [(2, 0.01), (4, 0.012), (6, 0.0003)])
def test_pictures_that_arrive_in_bursts_are_told_from_lost_ones(size, apart_s):
    frames = np.arange(60)
    arrival = frames // size * size / 30 + apart_s * (frames % size)
    (cause,) = burst_causes({**OTHERS, "cam1": arrival})
    assert f"bursts of {size} " in cause.text
    kept = frames[frames % 5 != 4]
    assert not burst_causes({**OTHERS, "cam1": kept / 30}), "every fifth picture was lost"


def test_a_cause_is_a_finding_with_code_subject_and_what_can_be_told_apart():
    rivals = ("moved of cam2", "scale of all")
    cause = Cause(
        Word.ZOOM, "cam1", "zoomed by 2 %", "calibrate it", Level.WEAK, 2.0, 0.5, "%", 0.0, 0.9,
        rivals, 0.4,
    )  # fmt: skip
    finding = cause.finding
    told = (finding.code, finding.subject, finding.level, finding.estimate, finding.sd)
    assert told == ("zoom", "cam1", "weak", 2.0, 0.5)
    assert (finding.unit, finding.since_s) == ("%", 0.4)
    assert finding.remedy == "calibrate it; or `measure mend SESSION -o MENDED`"
    assert finding.rivals == rivals
    assert "or cam2 was moved, or the scale of the calibration is off" in finding.text
    assert Finding(Level.NOTE, "frames", "none", camera="cam1").code == "frames"


def way(index: float) -> np.ndarray:
    """Where a ball is in a picture, on its way round."""
    return np.array([80 + 20 * np.cos(0.3 * index), 60 + 20 * np.sin(0.3 * index)])


def ball_on(index: float, kernel: np.ndarray | float = 1.0) -> np.ndarray:
    pixels = np.full((120, 160, 3), 20, np.uint8)
    cv2.circle(
        pixels, tuple(np.rint(16 * way(index)).astype(int).tolist()), 400, (30, 60, 180), -1, 16, 4
    )
    soft = cv2.filter2D(cv2.GaussianBlur(pixels, (0, 0), 0.9), -1, np.atleast_2d(kernel))
    grain = np.random.default_rng(round(8 * index)).normal(0, 4, pixels.shape)
    return np.clip(soft + grain, 0, 255).astype(np.uint8)


def in_motion(index: float) -> np.ndarray:
    return np.mean([ball_on(index + k / 16) for k in range(-4, 5)], axis=0).astype(np.uint8)


@pytest.mark.parametrize(
    ("show", "width_px", "angle_deg"),
    [
        (lambda k: ball_on(k, np.ones((1, 13)) / 13), 13, 0),
        (lambda k: ball_on(k, np.ones((9, 1)) / 9), 9, 90),
        (lambda k: ball_on(k, np.eye(7) / 7), 9.9, 45),
        (lambda k: ball_on(k, np.ones((11, 11)) / 121), None, None),
        (in_motion, None, None),
        (ball_on, None, None),
    ],
)
def test_a_blur_along_one_direction_is_told_from_motion_and_focus(show, width_px, angle_deg):
    steps, images, alone = BallSteps(), SmearedImages(), SmearedImages()
    for index in range(14):
        image = Image("cam0", index, index / 30, lambda k=index: show(k))
        balls = [Detection(n, "cam0", 0.0, way(index), 25.0, 0.01 * np.eye(2)) for n in "ab"]
        found = steps.of(FrameSet(index, index / 30, {"cam0": image}), balls, look=True)
        images.add(found)
        alone.add([one for one in found if one.ball.ball == "a"])
    assert alone.smear is None, "one ball may be shaded so"
    smear = images.smear
    assert (smear is None) == (width_px is None), smear
    if smear is not None:
        assert smear.values["width_px"] == pytest.approx(width_px, rel=0.2)
        assert abs((smear.values["angle_deg"] - angle_deg + 90) % 180 - 90) < 5
        (cause,) = seen_causes(images.doubt({"cam0"})[0], 3)
        assert (cause.cause, cause.of) == ("blurred", "cam0")
        assert cause.estimate == smear.values["width_px"]
        assert images.doubt({"cam0", "cam1", "cam2"}) == ([smear], False)
        assert images.doubt({"cam1"}) == ([], False)
