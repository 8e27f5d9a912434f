"""Pictures under the wrong camera, mirrored or upside down: named, and nothing else is."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from measure.checking import search_sample
from measure.checking.arrangement import arrangement_causes
from measure.geometry import RigidTransform
from tests.scenes import FOUR, RAVEN, SIZE_WH, TARGET, a_pose, look_at, moved, ring, see

PLACES = ((300, 340, 380), (-260, 350, 350), (40, -420, 300), (310, -250, 480), (-420, -60, 420))
"""Of cameras; no turn or mirror image puts them on each other."""


def rig(count):
    return {
        name: moved(camera, look_at(np.array(at, float)))
        for (name, camera), at in zip(ring(count).items(), PLACES[:count], strict=True)
    }


def seen(cameras, body=RAVEN, frames=8):
    """Balls of each frame set, by camera."""
    out = []
    for k in range(frames):
        rng = np.random.default_rng(k)
        found = see(cameras, body, a_pose(rng), 0.3, rng)
        out.append({name: [d for d in found if d.camera == name] for name in cameras})
    return out


def exchanged(frame_sets, *names):
    """Under each name the pictures of the next, under the last those of the first."""
    of = dict(pairwise((*names, names[0])))
    return [
        {n: [replace(d, camera=n) for d in one[of.get(n, n)]] for n in one} for one in frame_sets
    ]


def turned(frame_sets, across, down, *names):
    """Pixels as a camera gives them whose picture is turned over."""

    def over(u, v):
        return np.array([SIZE_WH[0] - 1 - u if across else u, SIZE_WH[1] - 1 - v if down else v])

    return [
        {n: [replace(d, center_px=over(*d.center_px)) for d in f] if n in names else f
         for n, f in one.items()}
        for one in frame_sets
    ]  # fmt: skip


def findings(frame_sets, cameras, body=RAVEN):
    cameras = list(cameras.values())
    searched = [search_sample(one, body, cameras, 0.0) for one in frame_sets]
    return arrangement_causes(frame_sets, searched, body, cameras)


def found(frame_sets, cameras, body=RAVEN):
    return [cause.finding.text for cause in findings(frame_sets, cameras, body)]


@pytest.mark.parametrize(("count", "body"), [(2, RAVEN), (3, FOUR), (5, RAVEN)])
def test_exchanged_cameras_are_named(count, body):
    (text,) = found(exchanged(seen(rig(count), body), "cam0", "cam1"), rig(count), body)
    assert text.startswith(
        "the pictures of cameras are exchanged: under cam0 are those of cam1, under cam1 are those "
        "of cam0; with that undone all cameras agree in 4 of 4 frame sets, as it is in 0: exchange"
    )


@pytest.mark.parametrize("order", [(2, 1, 0), (0, 2, 1, 3)])
def test_so_is_any_order_of_up_to_four(order):
    names = [f"cam{k}" for k in order]
    (text,) = found(exchanged(seen(rig(4)), *names), rig(4))
    for name, shown in pairwise((*names, names[0])):
        assert f"under {name} are those of {shown}" in text


@pytest.mark.parametrize(
    ("names", "way", "said"),
    [
        (("cam1",), (True, False), "mirrored"),
        (("cam0", "cam1", "cam2", "cam3"), (True, False), "mirrored"),
        (("cam1",), (True, True), "upside down"),
        (("cam0", "cam1", "cam2", "cam3"), (False, True), "mirrored top to bottom"),
    ],
)
def test_pictures_turned_over_are_named(names, way, said):
    (text,) = found(turned(seen(rig(4)), *way, *names), rig(4))
    assert text.startswith(f"the pictures of {', '.join(names)} are {said}; with that undone")


def test_a_body_that_is_out_of_view_for_most_of_the_time_shows_it():
    wrong = exchanged(seen(rig(3)), "cam0", "cam1")
    empty = [{name: [] for name in rig(3)}] * 12
    assert len(found([*empty, *wrong, *empty], rig(3))) == 1
    assert found([*empty, *wrong[:2], *empty], rig(3)) == []  # as two frame sets do not


@pytest.mark.parametrize("count", [2, 5])
def test_right_pictures_are_left_alone(count):
    assert found(seen(rig(count)), rig(count)) == []


@pytest.mark.parametrize("turn_deg", [0.5, 180.0])
def test_a_camera_that_was_moved_is_none_of_these(turn_deg):
    cameras = rig(4)
    camera = cameras["cam1"]
    by = RigidTransform.from_rotvec(np.deg2rad(turn_deg) * np.array([0.48, 0.6, 0.64]), [0, 0, 0])
    there = RigidTransform((camera.world_from_camera @ by).rotation, camera.center)
    real = {**cameras, "cam1": moved(camera, there)}
    assert found(seen(real), cameras) == []


def test_too_much_at_once_is_not_guessed_at():
    """Two cameras, each mistaken in its own way, and a body of which nothing is seen."""
    wrong = turned(exchanged(seen(rig(4)), "cam0", "cam1"), True, False, "cam3")
    assert found(wrong, rig(4)) == []
    nothing = [{name: [] for name in rig(4)}] * 6
    assert found(nothing, rig(4)) == []


@pytest.mark.parametrize(("y_mm", "said"), [(0, 0), (150, 1)])
def test_of_two_explanations_none_is_named(y_mm, said):
    """Half a turn puts each camera where another one stands: either pair may be exchanged."""
    places = [(400, 0, 200), (-400, y_mm, 200), (0, 300, 250), (0, -300, 250)]
    like = ring()["cam0"]
    cameras = {
        f"cam{k}": replace(moved(like, look_at(TARGET + np.array(at, float))), name=f"cam{k}")
        for k, at in enumerate(places)
    }
    assert len(found(exchanged(seen(cameras), "cam0", "cam1"), cameras)) == said


def test_one_ball_that_falls_into_place_is_chance():
    cameras = rig(5)
    over, down = turned(seen(cameras), True, False, "cam4"), np.array([0, 250.0])
    for one in over:
        first, *others = one["cam4"]
        one["cam4"] = [first, *(replace(d, center_px=d.center_px + down) for d in others)]
    assert not findings(over, cameras)
