"""Rows of a truth while its tracker had lost the body; bodies that rest, or pass through zero."""

from __future__ import annotations

import numpy as np
import pytest

from measure.errors import SessionError
from measure.session import read_trajectory
from measure.session.lost_body import lost_rows

TIMES = np.arange(0, 4, 0.01)
LOST = slice(100, 130)


def rows(places):
    """A body that keeps its direction."""
    out = np.zeros((len(TIMES), 8))
    out[:, 0], out[:, 1:4], out[:, 4] = TIMES, places, 1
    return out


def along(distance):
    return np.stack([distance, 0.5 * distance, 200 + 0 * distance], axis=1)


def swinging(noise_mm=0.0):
    noise = np.random.default_rng(0).normal(0, noise_mm or 1e-12, (len(TIMES), 3))
    return rows(along(30 * np.sin(6 * TIMES)) + noise)


RAMP = np.clip(TIMES - 1, 0, 1)
BODIES = {
    "moving": swinging(),
    "moving, with noise": swinging(0.05),
    "resting": rows(along(np.full(len(TIMES), 5.0))),
    "moving at times": rows(along(100 * RAMP)),
}
WRITTEN = {
    "zeros for the position": (1, [0, 0, 0, 1, 0, 0, 0]),
    "no rotation (a quaternion of zeros)": (30, [5, 5, 200, 0, 0, 0, 0]),
    "only nines for the position": (30, [9999, 9999, 9999, 1, 0, 0, 0]),
    "positions that no body reaches": (30, [-3.7e28, -3.7e28, -3.7e28, 1, 0, 0, 0]),
}


@pytest.mark.parametrize("body", BODIES)
@pytest.mark.parametrize("what", WRITTEN)
def test_what_is_no_pose_is_found(body, what):
    count, written = WRITTEN[what]
    values = BODIES[body].copy()
    values[100 : 100 + count, 1:] = written
    ((found, lost),) = lost_rows(values).items()
    assert found == what
    assert np.flatnonzero(lost).tolist() == list(range(100, 100 + count))


@pytest.mark.parametrize("body", ["moving", "moving, with noise"])
@pytest.mark.parametrize("count", [1, 3, 30])
def test_a_pose_that_is_held_is_found_where_it_ends_by_a_jump(body, count):
    values = BODIES[body].copy()
    values[100 : 100 + count, 1:] = values[99, 1:]
    values[380:, 1:] = values[379, 1:]
    ((found, lost),) = lost_rows(values).items()
    assert found.startswith("the pose before")
    assert np.flatnonzero(lost).tolist() == [*range(100, 100 + count), *range(380, 400)]


def test_a_constant_pose_far_away_is_found():
    values = BODIES["moving"].copy()
    values[LOST, 1:] = [-500, 300, 80, 0, 1, 0, 0]
    ((found, lost),) = lost_rows(values).items()
    assert found.startswith("one pose again and again")
    assert np.flatnonzero(lost).tolist() == list(range(100, 130))


def test_rows_written_faster_than_the_tracker_measures_are_passed_over():
    values = np.repeat(BODIES["moving"], 5, axis=0)
    values[:, 0] = np.arange(len(values)) / 500
    ((_, lost),) = lost_rows(values).items()
    assert np.flatnonzero(~lost[:-5]).tolist() == list(range(0, len(values) - 5, 5))


@pytest.mark.parametrize(
    "places",
    [
        along(np.full(len(TIMES), 5.0)),
        np.zeros((len(TIMES), 3)),
        along(100 * RAMP),
        along(100 * (10 * RAMP**3 - 15 * RAMP**4 + 6 * RAMP**5)),
        along(100 * (2 * RAMP - RAMP**2)),  # begins at once, and slows down
        100 * RAMP[:, None] * [1.0, 0.5, 0.0],  # begins at zero
        np.round(along(3 * np.sin(TIMES)), 1),
        along(100 * np.floor(TIMES)),  # the stops of a robot, and nothing between them
        along(30 * np.sin(6 * TIMES)),
    ],
    ids=["rest", "zero", "abrupt", "smooth", "sudden", "from zero", "rounded", "stops", "moving"],
)
def test_a_body_that_rests_is_not_lost(places):
    assert lost_rows(rows(places)) == {}


def test_what_is_left_out_is_noted_with_share_and_times(tmp_path):
    values = BODIES["moving"].copy()
    values[LOST, 1:4] = 0
    path = tmp_path / "truth.csv"
    head = "time_s,x_mm,y_mm,z_mm,qw,qx,qy,qz"
    np.savetxt(path, values, "%.9f", delimiter=",", header=head, comments="")
    found = read_trajectory(path)
    assert len(found) == 370
    assert not found.covers(1.15)[0]
    (note,) = found.notes
    assert "30 of 400 rows (8 %) are left out" in note
    assert "zeros for the position (1.000 to 1.290 s)" in note
    values[:, 4] = 0
    np.savetxt(path, values, "%.9f", delimiter=",", header=head, comments="")
    with pytest.raises(SessionError, match="holds no pose: all rows hold no rotation"):
        read_trajectory(path)


@pytest.mark.parametrize("file", ["held", "nines", "zeros", "zero_quaternions"])
def test_files_of_trackers_agree_with_the_truth_where_they_saw(shared, renders, file):
    found = read_trajectory(shared / f"inputs/truth_where_the_tracker_lost_it/{file}.csv")
    true = read_trajectory(renders / "still/truth.csv")
    times = np.arange(0, 1, 0.005)
    times = times[found.covers(times) & true.covers(times)]
    assert len(times) > 140
    assert np.abs(found.at(times).difference(true.at(times))[:, :3]).max() < 0.005
    assert "22 of 132 rows (17 %)" in found.notes[0]
