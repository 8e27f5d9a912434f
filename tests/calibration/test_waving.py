"""Pictures of a waved board that are taken by themselves."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from itertools import product

import cv2
import numpy as np
import pytest

from benchmarks.errors import body_cost
from benchmarks.waving import calibrated, errors_mm
from measure.arrays import rms_length
from measure.calibration import BoardWave, Charuco, Chessboard, Corners
from measure.calibration.board_views import LENS_MODELS, fit_lens, start_intrinsics
from measure.calibration.common_views import fit_common_views
from measure.calibration.intrinsics import LensCalibration
from measure.calibration.views import ALL_VIEWS, choose_views
from measure.estimation.expected_accuracy import body_pose_sd
from measure.geometry import RigidTransform, align_points
from measure.model import paper_body
from tests.studio import waved

CAMERAS = waved.rig()
NAMES = [camera.name for camera in CAMERAS]


seen = partial(waved.looked_at, CAMERAS)
"""What the cameras see of the waved board at a time."""


def wave_of(goal_mm=1.0):
    return BoardWave(waved.board(), dict.fromkeys(NAMES, waved.SIZE_WH), paper_body(), goal_mm)


def at_once(views, time_s):
    return dict.fromkeys(views, time_s)


def test_it_stops_asking_when_it_is_good_enough(rng):
    """And asks for everything before, in an order that can be followed."""
    wave, asked = wave_of(), []
    assert wave.state().advice[:2] == (
        "cam0: show the board to this camera",
        "cam1: show the board to this camera",
    )
    assert not wave.state().enough
    for time_s in np.arange(0.0, 120.0, 0.5):
        views = seen(time_s, rng)
        wave.add(views, at_once(views, time_s))
        state = wave.state()
        asked += state.advice
        if state.enough:
            break
    assert state.enough
    assert state.position_sd_mm <= 1.0
    told = {words.split(": ")[1] for words in asked}
    assert "show the board to both at once" in told
    assert any("left" in words or "right" in words for words in told)
    assert state.advice == ()
    assert len(wave.kept) < 20
    assert errors_mm(calibrated(NAMES, wave.kept), CAMERAS)[1] < 1.0


def test_the_same_view_again_adds_nothing(rng):
    wave, first = wave_of(), seen(0.0, rng)
    assert wave.add(first, at_once(first, 0.0))
    again = seen(0.0, rng)
    assert not wave.add(again, at_once(again, 1.0))
    assert not wave.add({}, {})


def test_a_board_that_is_never_tilted_is_to_be_tilted(rng):
    """Parallel to the picture, all over it, nearer and farther: tilt is what is missing."""
    wave, camera = wave_of(), CAMERAS[0]
    for number, (u, v, z) in enumerate(product((-140, 0, 140), (-110, 0, 110), (400, 600))):
        turn = np.eye(3)
        place = np.array([u, v, z]) - waved.board().points.mean(axis=0)
        at = camera.project(
            (camera.world_from_camera @ RigidTransform(turn, place)).apply(waved.board().points)
        )
        ids = np.flatnonzero(camera.intrinsics.contains(at))
        wave.add({"cam0": Corners(ids, at[ids], 0.4)}, {"cam0": float(number)})
    assert "cam0: tilt the board more" in wave.state().advice


def test_what_lacks_nothing_but_precision_is_not_called_enough(rng):
    wave = wave_of(goal_mm=0.01)
    for time_s in np.arange(0.0, 60.0, 1.0):
        views = seen(time_s, rng)
        wave.add(views, at_once(views, time_s))
    state = wave.state()
    assert state.position_sd_mm > 0.01
    assert not state.enough
    assert state.advice == ("every camera: show the board in other places and tilts",)


def test_a_blurred_view_is_not_kept(rng):
    wave, first = wave_of(), seen(0.0, rng)
    assert wave.add(first, at_once(first, 0.0))
    blurred, sharp = seen(4.0, rng, sharpness=0.1), seen(4.0, rng)
    assert not wave.add(blurred, at_once(blurred, 4.0))
    assert wave.add(sharp, at_once(sharp, 4.0))


@pytest.mark.parametrize(("apart_s", "kept"), [(0.0, 1), (1e-3, 1), (0.016, 0)])
def test_cameras_out_of_step_wait_till_the_board_rests(rng, apart_s, kept):
    """Pictures of a moving board, taken apart, do not show one board; of a resting one they do."""
    wave = wave_of()

    def offer(board_s, time_s):
        views = seen(board_s, rng)
        return wave.add(views, {name: time_s + apart_s * (name == "cam1") for name in views})

    offer(1.0, 1.0)
    moving = offer(1.1, 1.1)
    assert len(wave.kept) == (1 if apart_s == 0 else kept)
    assert moving == (apart_s > 0 and bool(kept))
    resting = [offer(1.1, time_s) for time_s in (1.2, 1.3)]
    assert len(wave.kept) == 1
    assert any(resting) == (not kept)


def test_the_expected_error_is_that_of_positions_once_the_world_is_set(rng):
    """Scatter over draws of noise, after the rigid motion that fits best; before, it is larger."""
    instants, model = [seen(time_s, rng) for time_s in np.arange(0.0, 40.0, 1.6)], LENS_MODELS[1]
    world = CAMERAS[0].world_from_camera.inverse()
    true = tuple(replace(c, world_from_camera=world @ c.world_from_camera) for c in CAMERAS)
    places = [world.apply(np.array(p)) for p in product((-60, 60), (-60, 60), (-80, 40.0))]
    poses = [RigidTransform(np.eye(3), place) for place in places]
    off, told, alone, first = [], [], [], []
    for _ in range(8):
        lenses = {}
        for camera in CAMERAS:
            views = [
                Corners(v.ids, at + rng.normal(0, waved.NOISE_PX, at.shape), 0.4, str(i))
                for i, one in enumerate(instants)
                if (v := one.get(camera.name)) is not None
                for at in [waved.corners(camera, waved.waved(1.6 * i))[v.ids]]
            ]
            chosen = choose_views(waved.board(), views, waved.SIZE_WH, camera.name, None, ALL_VIEWS)
            start = start_intrinsics(waved.SIZE_WH, waved.board().points, chosen.views)
            fit = fit_lens(start, waved.board().points, chosen.views, model)
            lenses[camera.name] = LensCalibration(fit, model, {}, (), chosen)
        cameras, _, joint = fit_common_views(waved.board(), lenses)
        found = np.stack(places) + body_cost(cameras, true, paper_body(), poses)
        off.append(align_points(np.stack(places), found).apply(found) - np.stack(places))
        first.append(found - np.stack(places))
        told.append(body_pose_sd(cameras, paper_body(), poses, joint)[0])
        alone.append(body_pose_sd(cameras, paper_body(), poses)[0])
    scatter = rms_length(np.concatenate(off))
    for expected in (told, alone):  # what a calibration file states is of each camera alone
        assert scatter == pytest.approx(rms_length(np.concatenate(expected)[:, None]), rel=0.3)
    assert rms_length(np.concatenate(first)) > 5 * scatter


def test_a_slow_computer_takes_a_board_that_rests(rng):
    """Looks are 1.5 s apart, cameras 50 ms out of step: rests are kept, or advice says why not."""
    wave = wave_of()

    def look(board_s, time_s):
        views = seen(board_s, rng)
        return wave.add(views, {name: time_s + 0.05 * (name == "cam1") for name in NAMES})

    assert not look(1.0, 0.0)
    assert not look(4.0, 1.5), "it moved by a hand's breadth since"
    advice = wave.state().advice
    assert advice[:2] == (
        "seen in cam0 and cam1: hold it still",
        "this computer looks every 1.5 s: hold it still for so long",
    )
    assert not any("show the board to this camera" in words for words in advice)
    assert look(4.0, 3.0)
    assert "hold it still" not in " ".join(wave.state().advice)


def test_a_camera_that_lost_the_board_does_not_know_how_fast_it_moves(rng):
    wave, times = wave_of(), {"cam0": 0.0, "cam1": 0.016}
    views = seen(1.0, rng)
    assert not wave.add(views, times)
    assert not wave.add({}, {n: s + 1.0 for n, s in times.items()})
    assert not wave.add(views, {n: s + 2.0 for n, s in times.items()})
    assert wave.add(views, {n: s + 3.0 for n, s in times.items()})


def test_advice_says_what_was_seen(rng):
    wave = wave_of()
    wave.add({}, at_once(NAMES, 0.0), ["cam0"])
    assert wave.state().advice[:2] == (
        "mirrored picture: switch off mirror mode in cam0",
        "cam1: show the board to this camera",
    )
    far = {n: replace(v, pixels=v.pixels * 0.2 + 100) for n, v in seen(1.0, rng).items()}
    assert wave.add(far, at_once(NAMES, 1.0))
    assert wave.state().advice[0] == "too far away in cam0 and cam1: come nearer"


def test_a_chessboard_is_looked_for_in_small_pictures(rng):
    """As exact as the search of the whole picture, in a fraction of its time."""
    target, camera = waved.plain_board(), CAMERAS[0]
    spent = {"find": 0.0, "look": 0.0}
    for time_s in (0.0, 3.0, 7.5):
        pose = waved.waved(time_s, target)
        gray = waved.picture(camera, pose, rng, target)[:, :, 0]
        gray = cv2.resize(gray, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
        true = 2 * camera.project(pose.apply(target.points)) + 0.5
        for way in spent:
            begun = time.process_time()
            view = getattr(target, way)(gray)
            spent[way] += time.process_time() - begun
            assert rms_length(view.pixels - true[view.ids]) < 0.1
    assert spent["look"] < 0.5 * spent["find"]


def test_a_camera_in_which_the_board_moves_waits_alone(rng):
    """What the others see at rest is kept without it."""
    wave, times = wave_of(), {"cam0": 0.0, "cam1": 0.016}
    views = seen(1.0, rng)
    wave.add(views, times)
    moved = {"cam0": views["cam0"], "cam1": seen(1.2, rng)["cam1"]}
    assert wave.add(moved, {n: s + 0.2 for n, s in times.items()})
    assert [*wave.kept[-1]] == ["cam0"]
    assert "seen in cam1: hold it still" in wave.state().advice


def test_a_board_that_looks_the_same_turned_does_not_move_by_turning(rng):
    """Its corners may be numbered from either end at every look."""
    target, camera = Chessboard((8, 6), 25.0), CAMERAS[0]
    wave = BoardWave(target, dict.fromkeys(NAMES, waved.SIZE_WH), paper_body())
    at = camera.project(waved.waved(1.0, target).apply(target.points))
    ways = [Corners(np.arange(len(at)), pixels, 0.4) for pixels in (at, at[::-1], at)]
    times = {"cam0": 0.0, "cam1": 0.016}
    kept = [
        wave.add({"cam0": view, "cam1": view}, {n: s + k for n, s in times.items()})
        for k, view in enumerate(ways)
    ]
    assert kept == [False, True, False]


def test_a_camera_in_mirror_mode_is_named_for_a_chessboard_too(rng):
    """One picture of a chessboard does not show it; all together do."""
    target = waved.plain_board()
    wave = BoardWave(target, dict.fromkeys(NAMES, waved.SIZE_WH), paper_body())
    flipped = np.arange(len(target.points)).reshape(6, 9)[::-1].ravel()
    for time_s in np.arange(0.0, 120.0, 0.5):
        views = {}
        for camera in CAMERAS:
            at = camera.project(waved.waved(time_s, target).apply(target.points))
            if camera.intrinsics.contains(at).all():
                at = at + rng.normal(0, waved.NOISE_PX, at.shape)
                if camera.name == "cam1":
                    at = (at * [-1, 1] + [waved.SIZE_WH[0] - 1, 0])[flipped]
                views[camera.name] = Corners(np.arange(len(at)), at, 0.4)
        wave.add(views, at_once(NAMES, time_s))
    assert np.isnan(wave.state().position_sd_mm)
    assert any("cam1" in line and "mirror" in line for line in wave.state().advice)


def test_a_board_that_is_never_found_is_asked_about():
    wave = wave_of()
    for number in range(40):
        wave.add({}, at_once(NAMES, number / 10))
    asked = "no ChArUco board of 9x6 squares is found: is it this one? Show all of it"
    assert wave.state().advice[0] == asked


def test_another_board_is_said_till_the_chosen_one_is_seen(rng):
    wave, shown = wave_of(), Charuco((9, 6), 25.0, 18.0)
    picture = shown.pattern.generateImage((400, 280), marginSize=20)
    for number in range(10):
        assert not wave.wants_a_closer_look
        wave.add({}, at_once(NAMES, number / 10))
    assert wave.wants_a_closer_look
    wave.look_closer([picture])
    said = "this is another board: 10x7 squares seen, 9x6 chosen"
    assert wave.state().advice[0] == said
    assert wave.state().other.board.squares == (10, 7)
    wave.look_closer([np.full((200, 300), 200, np.uint8)])
    assert wave.state().advice[0] == said
    wave.add(seen(1.0, rng), at_once(NAMES, 2.0))
    assert wave.state().other is None
    assert said not in wave.state().advice


def test_a_board_that_one_camera_sees_in_part_is_the_one_that_others_see():
    cells = np.indices((7, 10)).sum(axis=0) % 2 * 255
    whole = np.pad(np.kron(cells, np.ones((40, 40))), 60, constant_values=255).astype(np.uint8)
    for grays in ([whole[:, :375], whole], [whole, whole[:, :375]]):
        wave = wave_of()
        wave.look_closer(grays)
        assert wave.state().other.board.inner_corners == (9, 6)
    alone = wave_of()
    alone.look_closer([whole[:, :375]])
    other = alone.state().other
    assert other is None or other.board.inner_corners != (9, 6)


def test_what_two_cameras_share_is_kept_though_each_knows_it(rng):
    """Or the board that is shown to both, as advised, would be refused for ever."""
    wave, views = wave_of(), seen(1.0, rng)
    assert [*views] == NAMES
    for number, name in enumerate(NAMES):
        wave.add({name: views[name]}, {name: float(number)})
    assert wave.state().pairs["cam0", "cam1"] == 0
    assert wave.add(views, at_once(NAMES, 3.0))
    assert wave.state().pairs["cam0", "cam1"] == 1
    assert not wave.add(views, at_once(NAMES, 4.0))
