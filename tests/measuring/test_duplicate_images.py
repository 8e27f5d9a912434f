"""A picture that comes twice is not a new one."""

from __future__ import annotations

import numpy as np
import pytest

from measure.measuring import Status
from measure.measuring.duplicate_images import DuplicateImages
from measure.measuring.measurement import Draft
from measure.model import FrameSet, Image
from tests.measurements import measurement


def picture(camera, frame, content, encoded=True):
    pixels = np.full((64, 64, 3), content, np.uint8)
    data = bytes([content]) * 9 if encoded else None
    return Image(camera, frame, frame / 30, lambda: pixels, data)


def frame_set(index, contents, encoded=True):
    images = {n: picture(n, index, c, encoded) for n, c in contents.items()}
    return FrameSet(index, index / 30, images)


@pytest.mark.parametrize("encoded", [True, False])
def test_a_camera_that_stalls_is_left_out_until_it_goes_on(encoded):
    duplicates = DuplicateImages()
    seen = []
    for index, stalled in enumerate([0, 1, 1, 3]):
        given = frame_set(index, {"a": index, "b": index + 9, "c": stalled}, encoded)
        left, flag = duplicates.without_duplicates(given)
        seen.append((sorted(left.images), flag))
    assert seen == [
        (["a", "b", "c"], ""),
        (["a", "b", "c"], ""),
        (["a", "b"], ""),
        (["a", "b", "c"], ""),
    ]


def test_if_all_cameras_stall_the_pose_is_flagged():
    duplicates = DuplicateImages()
    duplicates.without_duplicates(frame_set(0, {"a": 1, "b": 2}))
    left, flag = duplicates.without_duplicates(frame_set(1, {"a": 1, "b": 2}))
    assert sorted(left.images) == ["a", "b"]
    assert "a, b repeat those before" in flag
    assert duplicates.without_duplicates(frame_set(2, {"a": 3, "b": 4}))[1] == ""


def test_one_frame_in_two_sets_is_no_stall():
    """A slower camera's picture may serve twice, with the time that it has."""
    duplicates = DuplicateImages()
    one = FrameSet(0, 0.0, {"a": picture("a", 0, 5), "b": picture("b", 0, 6)})
    two = FrameSet(1, 0.03, {"a": picture("a", 0, 5), "b": picture("b", 1, 7)})
    duplicates.without_duplicates(one)
    left, flag = duplicates.without_duplicates(two)
    assert (sorted(left.images), flag) == (["a", "b"], "")


def test_a_flag_stays_with_its_draft():
    draft = Draft(measurement(0), ()).flagged("a stall?")
    assert draft.measurement.status is Status.FLAGGED
    assert draft.measurement.pose.flags == ("a stall?",)
    assert draft.tracker_flags == ("a stall?",)
    lost = Draft(measurement(0, lost=True), ())
    assert lost.flagged("a stall?") is lost
