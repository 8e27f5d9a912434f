"""Frame sets from pictures as they come."""

from __future__ import annotations

import numpy as np
import pytest

from measure.errors import SessionError
from measure.model import Image
from measure_studio.capture import Gathering

PERIOD_S = 0.033


def image(camera, frame, time_s):
    return Image(camera, frame, time_s, lambda: np.zeros((2, 2, 3), np.uint8))


def sets_of(names, pictures):
    """What a gathering makes of (camera, frame, time) when somebody looks every millisecond.

    Returns:
        The sets, each the frames by camera, and the gathering.
    """
    now, out, due = 0.0, [], sorted(pictures, key=lambda picture: picture[2])
    gathering = Gathering(names, lambda: now)
    while due:
        now += 1e-3
        while due and due[0][2] <= now:
            gathering.add(image(*due.pop(0)))
        out.append(gathering.take())
    out.append(gathering.take(ended=True))
    return [{one.camera: one.frame for one in taken} for taken in out if taken], gathering


def delivered(phases_s, count=12, rng=None):
    """Pictures of cameras that begin at these times; their stamps jitter by 2 ms with `rng`."""
    return [
        (name, k, k * PERIOD_S + phase + (0 if rng is None else rng.normal(0, 0.002)))
        for name, phase in phases_s.items()
        for k in range(count)
    ]


@pytest.mark.parametrize("spread", [0.0, 0.3, 0.7])
def test_cameras_of_one_pace_make_whole_sets(spread, rng):
    """In step, and up to more than half a period apart."""
    phases = {f"cam{k}": spread * PERIOD_S * k / 3 for k in range(4)}
    sets, gathering = sets_of(list(phases), delivered(phases, rng=rng))
    assert sets == [dict.fromkeys(phases, k) for k in range(12)]
    assert gathering.overtaken == 0


def test_cameras_of_any_phases_make_whole_sets_nearly_always(rng):
    """Whichever camera begins a set: a split one costs what two of its cameras would have told."""
    whole = []
    for _ in range(40):
        phases = {f"cam{k}": rng.uniform(0, PERIOD_S) for k in range(4)}
        sets, _ = sets_of(list(phases), delivered(phases, 20, rng))
        whole += [len(one) == 4 for one in sets[3:-2]]
    assert np.mean(whole) > 0.98


def test_a_camera_of_half_the_pace_is_in_every_other_set():
    fast = delivered({"a": 0.0, "b": 0.001}, 24)
    slow = [("c", k, 2 * k * PERIOD_S + 0.002) for k in range(12)]
    sets, _ = sets_of(["a", "b", "c"], fast + slow)
    known = sets[3:]  # before the second picture nobody knows the camera's pace
    assert [s["a"] for s in known] == list(range(4, 24))
    assert [(s["a"], s["c"]) for s in known if "c" in s] == [(2 * k, k) for k in range(2, 12)]


def test_a_camera_that_is_gone_is_not_waited_for():
    there = delivered({"a": 0.0, "b": 0.001}, 16)
    sets, _ = sets_of(["a", "b", "gone"], [*there, ("gone", 0, 0.002)])
    assert sets[0] == {"a": 0, "b": 0, "gone": 0}
    assert sets[-10:] == [{"a": k, "b": k} for k in range(6, 16)]


def test_a_picture_that_is_missing_costs_no_other():
    pictures = [p for p in delivered({"a": 0.0, "b": 0.003, "c": 0.006}, 10) if p[:2] != ("b", 4)]
    sets, _ = sets_of(["a", "b", "c"], pictures)
    whole = [dict.fromkeys("abc", k) for k in range(10)]
    assert sets == [*whole[:4], {"a": 4, "c": 4}, *whole[5:]]


def test_who_is_slower_than_the_cameras_gets_the_newest():
    """Nothing is taken until all is there: only the last set is still worth it."""
    gathering = Gathering(["a", "b"])
    for camera, frame, time_s in sorted(delivered({"a": 0.0, "b": 0.002}), key=lambda p: p[2]):
        gathering.add(image(camera, frame, time_s))
    sets = list(gathering.frame_sets(lambda: True))
    assert [{n: i.frame for n, i in s.images.items()} for s in sets] == [{"a": 11, "b": 11}]
    assert gathering.overtaken == 11
    assert list(gathering.frame_sets(lambda: True)) == []
    assert gathering.overtaken == 0


def test_nothing_piles_up_while_nobody_looks():
    gathering = Gathering(["a", "b"])
    for frame in range(1000):
        gathering.add(image("a", frame, frame * PERIOD_S))
    assert len(gathering._waiting["a"]) < 32
    assert gathering.overtaken > 900


def test_undecodable_picture_is_left_out_and_counted():
    def broken():
        raise SessionError("torn")

    told = []
    gathering = Gathering(["a", "b"], on_read=lambda *one: told.append(one))
    gathering.add(Image("a", 0, 0.0, broken))
    gathering.add(image("b", 0, 0.001))
    (only,) = gathering.frame_sets(lambda: True)
    assert list(only.images) == ["b"]
    assert gathering.unreadable == 1
    assert told == [("a", False), ("b", True)]


def test_what_a_camera_died_of_ends_it():
    def check():
        raise SessionError("disk full")

    with pytest.raises(SessionError, match="disk full"):
        next(Gathering(["a"]).frame_sets(lambda: False, check))


@pytest.mark.parametrize("names", [("a", "b"), ("a", "b", "c")])
def test_late_pictures_make_no_set_back_in_time(names):
    """As when a camera's radio link is gone for a while, and all it took comes at once."""
    now, out = 0.0, []
    gathering = Gathering(names, lambda: now)
    pictures = [(k * PERIOD_S, name, k) for name in names for k in range(100)]
    arrived = [(2.01 if name == "b" and 1 < t < 2 else t, name, t, k) for t, name, k in pictures]
    for at, name, t, k in sorted(arrived):
        now = at
        gathering.add(image(name, k, t))
        while taken := gathering.take():
            out.append(taken)
    times = [np.mean([one.time_s for one in taken]) for taken in out]
    assert np.all(np.diff(times) > 0)
    assert len(out) > 95
    assert gathering.overtaken == pytest.approx(30, abs=2)
