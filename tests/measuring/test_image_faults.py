"""A picture that comes twice is not a new one."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from measure.measuring import Status
from measure.measuring.image_faults import DuplicateImages
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
        left = duplicates.without_duplicates(given)
        seen.append((sorted(left.frame_set.images), left.flags))
    assert seen == [
        (["a", "b", "c"], ()),
        (["a", "b", "c"], ()),
        (["a", "b"], ()),
        (["a", "b", "c"], ()),
    ]


def moving(camera, frame, shown, quality):
    """A disc over cloth that is at another place in every picture, encoded as stated."""
    pixels = np.full((128, 160, 3), 30, np.uint8)
    pixels[::8] = 60
    cv2.circle(pixels, (40 + 6 * shown, 64), 14, (40, 40, 190), -1, cv2.LINE_AA)
    data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
    decoded = np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR))
    return Image(camera, frame, frame / 30, lambda: decoded, data)


@pytest.mark.parametrize(
    ("shown", "quality", "out"),
    [
        ([0, 1, 2, 2, 2, 3, 4], [92, 92, 92, 86, 71, 92, 92], [3, 4]),
        ([0, 1, 2, 3, 4, 5, 6], [92, 92, 92, 86, 71, 92, 92], []),
    ],
)
def test_a_picture_that_comes_again_encoded_anew_is_left_out(shown, quality, out):
    duplicates, seen = DuplicateImages(), []
    for index in range(7):
        images = {name: moving(name, index, index + k, 92) for k, name in enumerate("ab")}
        images["c"] = moving("c", index, 9 - shown[index], quality[index])
        new = duplicates.without_duplicates(FrameSet(index, index / 30, images))
        duplicates.judge(new.shared, new.frame_set.images)
        seen += [] if "c" in new.frame_set.images else [index]
        assert new.repeated == (("c",) if index in out else ())
    assert seen == out


def test_a_body_that_rests_repeats_no_picture():
    """Nor does a camera stall that sees nothing of it."""
    duplicates = DuplicateImages()
    for index in range(8):
        shown = min(index, 3)
        images = {name: moving(name, index, shown + k, 80 + index) for k, name in enumerate("ab")}
        images["c"] = moving("c", index, 7, 80 + index)
        new = duplicates.without_duplicates(FrameSet(index, index / 30, images))
        duplicates.judge(new.shared, {"a", "b"})
        assert (new.repeated, len(new.frame_set.images)) == ((), 3)


@pytest.mark.parametrize("late", [0, 2])
def test_a_camera_that_shows_anothers_pictures_encoded_again_is_named(late):
    duplicates = DuplicateImages()
    for index in range(4, 8):
        images = {"a": moving("a", index, index, 92), "b": moving("b", index, 2 * index, 92)}
        images["c"] = moving("c", index, index - late, 70)
        new = duplicates.without_duplicates(FrameSet(index, index / 30, images))
        duplicates.judge(new.shared, {"a", "b"})
    assert duplicates.copies == {"c": "a"}


def test_a_stall_before_a_body_at_rest_ends_with_the_next_exposure():
    """Pictures of a body that rests differ by their noise only."""
    duplicates, seen = DuplicateImages(), []
    for index, quality in enumerate([92, 93, 93, 94, 95]):
        images = {name: moving(name, index, k, quality) for k, name in enumerate("ab")}
        new = duplicates.without_duplicates(FrameSet(index, index / 30, images))
        duplicates.judge(new.shared, {"a", "b"})
        seen.append(new.repeated)
    assert seen == [(), (), ("a", "b"), (), ()]


def test_if_all_cameras_stall_the_pose_is_flagged():
    duplicates = DuplicateImages()
    duplicates.without_duplicates(frame_set(0, {"a": 1, "b": 2}))
    left = duplicates.without_duplicates(frame_set(1, {"a": 1, "b": 2}))
    assert sorted(left.frame_set.images) == ["a", "b"]
    assert [one.plain for one in left.flags] == [{"code": "stall", "cameras": ("a", "b")}]
    assert duplicates.without_duplicates(frame_set(2, {"a": 3, "b": 4})).flags == ()


def test_one_frame_in_two_sets_is_no_stall():
    """A slower camera's picture may serve twice, with the time that it has."""
    duplicates = DuplicateImages()
    one = FrameSet(0, 0.0, {"a": picture("a", 0, 5), "b": picture("b", 0, 6)})
    two = FrameSet(1, 0.03, {"a": picture("a", 0, 5), "b": picture("b", 1, 7)})
    duplicates.without_duplicates(one)
    left = duplicates.without_duplicates(two)
    assert (sorted(left.frame_set.images), left.flags) == (["a", "b"], ())


def scene(camera, frame, seed, encoded=True):
    """A picture of something, with noise: equal for equal seeds only."""
    pixels = np.random.default_rng(seed).integers(0, 255, (64, 64, 3), np.uint8)
    return Image(camera, frame, frame / 30, lambda: pixels, bytes(pixels) if encoded else None)


def scenes(index, seeds, encoded=True):
    images = {name: scene(name, index, seed, encoded) for name, seed in seeds.items()}
    return FrameSet(index, index / 30, images)


@pytest.mark.parametrize("encoded", [True, False])
@pytest.mark.parametrize("behind", [0, 1, 2])
def test_a_camera_that_shows_anothers_pictures_is_named_and_left_out(encoded, behind):
    """Once a pose tells which of the two; as long as it does, and no longer."""
    duplicates, seen = DuplicateImages(), []
    for index in range(10):
        b = 10 * (index - behind) if 3 <= index < 7 else 10 * index + 1
        given = scenes(
            index, {"a": 10 * index, "b": b, "c": 1000 + index, "d": 2000 + index}, encoded
        )
        new = duplicates.without_duplicates(given)
        used = set(new.frame_set.images) - ({"b"} if 3 <= index < 7 else set())
        flags = [*new.flags, *duplicates.judge(new.shared, used)]
        seen.append((sorted(new.frame_set.images), dict(duplicates.copies), flags))
    well = (["a", "b", "c", "d"], {}, [])
    found = (["a", "b", "c", "d"], {"b": "a"}, [])
    out = (["a", "c", "d"], {"b": "a"}, [])
    assert seen == [well] * 3 + [found] + [out] * 3 + [well] * 3


def test_both_are_left_out_until_a_pose_tells_which_is_wrong():
    duplicates = DuplicateImages()
    first = duplicates.without_duplicates(scenes(0, {"a": 1, "b": 1, "c": 2, "d": 3}))
    assert sorted(first.frame_set.images) == ["c", "d"]
    assert duplicates.judge(first.shared, {"c", "d"}) == [
        "a and b show the same pictures: one device under two names?"
    ]
    second = duplicates.without_duplicates(scenes(1, {"a": 4, "b": 4, "c": 5, "d": 6}))
    assert sorted(second.frame_set.images) == ["a", "b", "c", "d"]
    assert duplicates.judge(second.shared, {"a", "c", "d"}) == []
    assert duplicates.copies == {"b": "a"}


def test_of_two_cameras_nobody_can_say_which_shows_the_others():
    duplicates = DuplicateImages()
    new = duplicates.without_duplicates(scenes(0, {"a": 1, "b": 1}))
    assert sorted(new.frame_set.images) == ["a", "b"]
    assert [one.plain for one in duplicates.judge(new.shared, ())] == [
        {"code": "same-pictures", "cameras": ("a", "b")}
    ]
    assert duplicates.copies == {}


@pytest.mark.parametrize("encoded", [True, False])
def test_cameras_that_look_alike_are_not_taken_for_one(encoded):
    """Black under their caps, white in the sun, of one scene, or one grey card."""
    duplicates = DuplicateImages()
    for index in range(4):
        for levels in ({"a": 0, "b": 0}, {"a": 255, "b": 255}):
            assert duplicates.of(frame_set(index, levels, encoded)).shared == ()
    for index in range(4):
        room = np.random.default_rng(0).integers(40, 200, (64, 67, 3))
        images = {}
        for k, name in enumerate("ab"):
            noise = np.random.default_rng(10 * index + k).integers(0, 2, (64, 64, 3))
            pixels = (room[:, 3 * k :][:, :64] + noise).astype(np.uint8)  # from two places
            data = bytes(pixels) if encoded else None
            images[name] = Image(name, index, index / 30, lambda p=pixels: p, data)
        assert duplicates.of(FrameSet(index, index / 30, images)).shared == ()


def test_a_flag_stays_with_its_draft():
    draft = Draft(measurement(0), ()).flagged("a stall?")
    assert draft.measurement.status is Status.FLAGGED
    assert draft.measurement.pose.flags == ("a stall?",)
    assert draft.tracker_flags == ("a stall?",)
    lost = measurement(0, lost=True)
    assert Draft(lost, ()).flagged("a stall?").measurement is lost
