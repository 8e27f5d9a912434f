from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from measure.session import pair_nearest
from measure.session.session import seldom_paired

PERIOD = 1 / 30


def _clock(start: float, count: int = 30, period: float = PERIOD) -> np.ndarray:
    return start + period * np.arange(count)


@given(phases=st.lists(st.floats(0.0, 0.0299), min_size=2, max_size=6), seed=st.integers(0, 1000))
def test_free_running_cameras(phases: list[float], seed: int) -> None:
    """Random phases: every image is used at most once, near its instant, in the order of time."""
    rng = np.random.default_rng(seed)
    clocks = [_clock(p) + rng.normal(0, 5e-4, 30) for p in phases]
    paired = pair_nearest(clocks)
    assert abs(paired.tolerance_s - PERIOD / 2) < 2e-3
    assert np.all(np.diff(paired.times_s) > 0)
    for camera, clock in enumerate(clocks):
        used = paired.positions[:, camera]
        used = used[used >= 0]
        assert np.all(np.diff(used) > 0)
        assert len(used) >= 0.5 * len(clock)
    reference = paired.positions[:, paired.reference]
    assert np.array_equal(reference[reference >= 0], np.arange(30))
    for row in paired.positions:
        if row[paired.reference] >= 0:
            instant = clocks[paired.reference][row[paired.reference]]
            times = [c[i] for c, i in zip(clocks, row, strict=True) if i >= 0]
            assert np.abs(np.array(times) - instant).max() <= paired.tolerance_s * (1 + 1e-6)


def test_the_nearest_image_is_taken_not_the_first() -> None:
    paired = pair_nearest([_clock(0.0, 5), np.array([0.010, 0.031, 0.035, 0.066, 0.1])])
    assert paired.positions[:, 1].tolist() == [0, 2, 3, 4, -1]


def test_fast_camera_gives_nearest_images_slow_one_gaps() -> None:
    paired = pair_nearest(
        [_clock(0.001, 20, PERIOD / 2), _clock(0.0, 10), _clock(0.0, 5, 2 * PERIOD)]
    )
    assert paired.reference == 1
    assert paired.positions[:, 0].tolist() == list(range(0, 20, 2))
    assert paired.positions[:, 1].tolist() == list(range(10))
    assert paired.positions[:, 2].tolist() == [0, -1, 1, -1, 2, -1, 3, -1, 4, -1]


def test_an_image_too_far_from_the_instant_is_left_out() -> None:
    near, far = np.array([0.0, 0.045, 0.067, 0.1, 0.133, 0.167]), _clock(0.0, 6) + 5.4 * PERIOD
    assert pair_nearest([_clock(0.0, 6), near]).positions[1].tolist() == [1, 1]
    assert pair_nearest([_clock(0.0, 6), far]).positions[:, 1].tolist() == [-1] * 5 + [0]


def test_reference_camera_may_lose_frames_but_no_set() -> None:
    full = _clock(0.0, 12)
    holes = np.delete(full, [4, 5, 9])
    paired = pair_nearest([holes, full, full + 0.002])
    assert paired.reference == 0
    assert len(paired.times_s) == 12
    assert (paired.positions[:, 0] < 0).nonzero()[0].tolist() == [4, 5, 9]
    assert np.array_equal(paired.positions[:, 1], np.arange(12))
    assert np.array_equal(paired.positions[:, 2], np.arange(12))


def test_cameras_that_start_and_end_at_different_times() -> None:
    paired = pair_nearest([_clock(10 * PERIOD, 10), _clock(0.0, 40), _clock(5 * PERIOD, 30)])
    alone = (paired.positions >= 0).sum(axis=1)
    assert alone.min() >= 2
    assert paired.positions[0].tolist() == [-1, 5, 0]
    assert paired.positions[-1].tolist() == [-1, 34, 29]
    assert len(paired.times_s) == 30


def test_the_time_is_the_mean_of_the_images() -> None:
    paired = pair_nearest([_clock(0.0, 3), _clock(0.004, 3), _clock(-0.001, 3)])
    assert np.allclose(paired.times_s, _clock(0.001, 3))


def test_two_pairs_of_cameras_with_an_age_between_them() -> None:
    """Only instants near an image are filled in: all between would not fit into memory."""
    late = 1.7e9
    paired = pair_nearest([_clock(0.0, 5), _clock(0.001, 5), _clock(late, 5), _clock(late, 5)])
    assert len(paired.times_s) == 10
    assert (paired.positions >= 0).sum(axis=1).tolist() == [2] * 10
    hole = np.concatenate([_clock(0.0, 3), _clock(late, 3)])
    filled = pair_nearest([hole, _clock(0.0, 9), _clock(0.002, 9), hole])
    assert filled.positions[3:9, 0].tolist() == [-1] * 6
    assert filled.positions[3:9, 1:3].tolist() == [[i, i] for i in range(3, 9)]


def test_a_camera_whose_clock_runs_otherwise_is_named() -> None:
    """Its stamps are minutes: most of its pictures have no partner, most sets no picture of it."""
    clocks = {"a": _clock(0.0), "b": _clock(0.01), "c": _clock(0.0, period=PERIOD / 60)}
    (line,) = _seldom(clocks)
    assert line.startswith("camera c: 29 of 30 pictures belong to no frame set, and 29 of 30 frame")


def test_fast_slow_and_late_cameras_are_not_accused() -> None:
    assert _seldom({"a": _clock(0.0), "b": _clock(0.01), "c": _clock(0.0, 120, PERIOD / 4)}) == []
    assert _seldom({"a": _clock(0.0), "b": _clock(0.01), "c": _clock(0.0, 8, 4 * PERIOD)}) == []
    assert _seldom({"a": _clock(0.0), "b": _clock(0.01), "c": _clock(0.8, 6)}) == []


def _seldom(clocks: dict[str, np.ndarray]) -> list[str]:
    counts = [len(clock) for clock in clocks.values()]
    return list(seldom_paired(list(clocks), counts, pair_nearest(list(clocks.values()))).values())
