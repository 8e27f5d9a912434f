"""Cameras as users name them."""

from __future__ import annotations

import pytest

from measure.errors import CaptureError, ConfigError
from measure_studio.capture import CameraAddress, parse_cameras
from measure_studio.capture.mjpeg import HttpSource
from measure_studio.capture.sources import AvSource, FileSource


def test_names_and_addresses():
    word = "left=http://10.0.0.2:8080/?action=stream"
    assert parse_cameras([word]) == [CameraAddress("left", "http://10.0.0.2:8080/?action=stream")]


def test_addresses_alone_are_named_in_order():
    words = ["http://h/?action=stream", "/dev/video2", "3", "C:\\a=b.mp4"]
    assert [c.name for c in parse_cameras(words)] == ["cam0", "cam1", "cam2", "cam3"]
    assert [c.address for c in parse_cameras(words)] == words
    assert [c.name for c in parse_cameras(words[:2], ["left", "right"])] == ["left", "right"]


@pytest.mark.parametrize(
    ("words", "names", "told"),
    [
        (["a=1", "2"], (), "every camera a name"),
        (["a=1", "a=2"], (), "two cameras are called 'a'"),
        (["=1"], (), "expected NAME=ADDRESS"),
        (["a="], (), "expected NAME=ADDRESS"),
        (["1", "2"], ("x", "y", "z"), "2 cameras without names, and the calibration has 3"),
    ],
)
def test_what_cannot_be_told_apart_is_refused(words, names, told):
    with pytest.raises(ConfigError, match=told):
        parse_cameras(words, names)


def test_an_address_says_what_kind_of_camera_it_is(tmp_path):
    video = tmp_path / "a.mp4"
    video.touch()
    assert isinstance(CameraAddress("a", "https://h/stream").source(), HttpSource)
    assert isinstance(CameraAddress("a", str(video)).source(), FileSource)
    rtsp = CameraAddress("a", "rtsp://me:secret@10.0.0.3/live").source()
    assert isinstance(rtsp, AvSource)
    assert rtsp.address == "rtsp://10.0.0.3/live"


def test_what_is_not_there_is_refused(tmp_path):
    with pytest.raises(CaptureError, match=r"camera 'a': nothing\.mp4 is no video file"):
        CameraAddress("a", "nothing.mp4").source()
    with pytest.raises(
        CaptureError, match=r"no camera /dev/video97(; there is /dev|, nor any other)"
    ):
        CameraAddress("a", "97").source()


@pytest.mark.parametrize("scheme", ["http", "rtsp"])
def test_an_address_that_is_none_is_told(scheme):
    with pytest.raises(CaptureError, match=r"camera 'a': \w+://\[::1/: Invalid IPv6 URL"):
        CameraAddress("a", f"{scheme}://[::1/").source()


def test_a_range_stands_for_several_cameras_of_the_network():
    rig = "http://10.0.0.[8-11]:8080/?action=stream"
    found = parse_cameras([rig])
    assert [one.name for one in found] == ["cam0", "cam1", "cam2", "cam3"]
    assert [one.address for one in found][::3] == [
        "http://10.0.0.8:8080/?action=stream",
        "http://10.0.0.11:8080/?action=stream",
    ]
    words = ["cam0=http://pi/0", "cam1=http://pi[01-02]/cam[1-2]"]
    assert [f"{one.name}={one.address}" for one in parse_cameras(words)] == [
        "cam0=http://pi/0",
        "cam1=http://pi01/cam1",
        "cam2=http://pi02/cam2",
    ]
    left = parse_cameras(["left=http://pi/[3-4]"])
    assert [one.name for one in left] == ["left0", "left1"]


@pytest.mark.parametrize("word", ["film[1-2].mp4", "http://[::1]:8080/", "http://pi/[a-b]"])
def test_what_is_no_range_stays_as_it_is(word):
    assert [one.address for one in parse_cameras([word])] == [word]


@pytest.mark.parametrize("span", ["[5-3]", "[0-99]"])
def test_a_range_of_no_cameras_is_refused(span):
    with pytest.raises(ConfigError, match="stands for no cameras"):
        parse_cameras([f"http://pi/{span}"])
