"""Video files played as cameras, and what is no video."""

from __future__ import annotations

import time
from itertools import pairwise

import av
import numpy as np
import pytest

from measure.errors import CaptureError
from measure_studio.capture import CameraAddress, Cameras, DeviceControls
from measure_studio.capture.sources import FileSource, device_source, rtsp_source

SIZE = (64, 48)


def video(path, codec="libx264", count=20, rate=50, form="yuv420p"):
    """A video whose frames grow brighter."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate)
        stream.width, stream.height, stream.pix_fmt = *SIZE, form
        for k in range(count):
            frame = av.VideoFrame.from_ndarray(
                np.full((SIZE[1], SIZE[0], 3), 20 + 10 * k, np.uint8), format="bgr24"
            )
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


@pytest.mark.parametrize(
    ("name", "codec", "form"), [("a.mp4", "libx264", "yuv420p"), ("a.avi", "mjpeg", "yuvj420p")]
)
def test_a_file_plays_at_its_own_pace(tmp_path, name, codec, form):
    path, seen = video(tmp_path / name, codec, form=form), []
    begun = time.monotonic()
    with Cameras({"a": CameraAddress("a", str(path)).source()}, {"a": SIZE}) as rig:
        rig.begin([seen.append])
        while not rig.over:
            time.sleep(0.01)
        rig.check()
        assert rig.counts["a"].outages == ()
    assert 0.35 < time.monotonic() - begun < 20.0
    assert len(seen) == 20
    steps = np.diff([image.time_s for image in seen])
    np.testing.assert_allclose(steps, 0.02, atol=1e-5)
    assert all((image.encoded is not None) == (codec == "mjpeg") for image in seen)
    levels = [image.pixels.mean() for image in seen]
    assert all(b > a + 5 for a, b in pairwise(levels))


def test_files_of_one_rig_begin_at_one_moment(tmp_path):
    paths = {name: video(tmp_path / f"{name}.mp4") for name in "ab"}
    seen = []
    with Cameras({n: FileSource(str(p)) for n, p in paths.items()}) as rig:
        rig.begin([seen.append])
        while not rig.over:
            time.sleep(0.01)
    first = {image.camera: image.time_s for image in seen if image.frame == 0}
    assert first["a"] == first["b"]


def test_what_is_no_video_is_told(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"no video at all" * 100)
    with pytest.raises(CaptureError, match=r"a\.mp4"):
        next(FileSource(str(tmp_path / "a.mp4")).shots())


def test_missing_rtsp_camera_is_named_without_password():
    with pytest.raises(CaptureError, match=r"^rtsp://127\.0\.0\.1:1/x: Connection refused"):
        next(rtsp_source("rtsp://me:secret@127.0.0.1:1/x").shots())


@pytest.mark.parametrize("knows_mjpeg", [True, False])
def test_a_device_is_asked_for_motion_jpeg_first(tmp_path, monkeypatch, knows_mjpeg):
    """No device is at hand: this is what one is asked, not what it answers."""
    path = tmp_path / "video0"
    path.touch()
    really, asked = av.open, []
    shown = video(tmp_path / "a.mp4", count=3)

    def opened(name, **how):
        asked.append((name, how["format"], how["options"]))
        if "input_format" in how["options"] and not knows_mjpeg:
            raise av.error.ArgumentError(22, "Invalid argument")
        return really(str(shown))

    monkeypatch.setattr(av, "open", opened)
    seen = list(device_source(str(path), (1280, 720), 30.0).shots())
    assert len(seen) == 3
    plain = {"video_size": "1280x720", "framerate": "30"}
    first = (str(path), "v4l2", {**plain, "input_format": "mjpeg"})
    assert asked == [first] if knows_mjpeg else [first, (str(path), "v4l2", plain)]


@pytest.mark.parametrize(
    ("platform", "opened", "form"),
    [("win32", "video=HD Webcam", "dshow"), ("darwin", "HD Webcam", "avfoundation")],
)
def test_other_systems_open_cameras_by_name(monkeypatch, platform, opened, form):
    """What is asked, not what such a system answers."""
    asked = []

    def open_nothing(name, **how):
        asked.append((name, how["format"], how["options"]))
        raise av.error.OSError(5, "Input/output error")

    monkeypatch.setattr("sys.platform", platform)
    monkeypatch.setattr(av, "open", open_nothing)
    camera = CameraAddress("cam0", "camera:HD Webcam")
    with pytest.raises(CaptureError, match="camera:HD Webcam: Input/output error"):
        list(camera.source((640, 480)).shots())
    assert asked == [(opened, form, {"video_size": "640x480"})]
    with pytest.raises(CaptureError, match="their controls cannot be set"):
        camera.source(controls={"gain": "3"})
    with pytest.raises(CaptureError, match="cameras are called as `measure cameras` lists them"):
        CameraAddress("cam0", "0").source()


def test_controls_are_set_each_time_a_device_is_opened(tmp_path, monkeypatch):
    path, applied = tmp_path / "video0", []
    path.touch()
    really, shown = av.open, video(tmp_path / "a.mp4", count=3)
    monkeypatch.setattr(av, "open", lambda name, **_: really(str(shown)))
    monkeypatch.setattr(DeviceControls, "apply", lambda self: applied.append(self))
    source = device_source(str(path), None, None, {"gain": "3"})
    for times in (1, 2):
        assert len(list(source.shots())) == 3
        assert applied == times * [source.controls]
