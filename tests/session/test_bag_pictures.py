"""Topics of pictures in bags: read as they were published, at the headers' stamps."""

from __future__ import annotations

import base64
import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from measure.bags import open_bag
from measure.calibration import open_capture
from measure.cli import main
from measure.errors import CalibrationError, SessionError
from measure.results import read_run
from measure.session import dump_toml, open_session, open_video_stream, read_calibration
from measure_studio.capture import parse_cameras
from tests import bags
from tests.session.conftest import jpeg

rosbags = pytest.importorskip("rosbags")

START_S = 1_700_000_000
LATE_S = 0.02
"""From a picture's exposure to its receipt."""
KINDS = ("one.bag", "two.mcap", "three.db3")


class Bag(bags.Bag):
    """A bag of pictures and lenses; those of ROS 2 are folders."""

    def __init__(self, path: Path) -> None:
        ros1 = path.suffix == ".bag"
        super().__init__(path if ros1 else path.with_suffix(""), path.suffix)

    def publish(
        self, topic: str, kind: str, time_s: float, received_s: float, **fields: Any
    ) -> None:
        header = self.header(time_s)
        self.send(topic, f"sensor_msgs/{kind}", received_s, header=header, **fields)

    def jpeg(self, topic: str, time_s: float, data: bytes, late_s: float = LATE_S) -> None:
        data_array = np.frombuffer(data, np.uint8)
        received = (time_s or START_S) + late_s
        self.publish(topic, "CompressedImage", time_s, received, format="jpeg", data=data_array)

    def image(
        self, topic: str, time_s: float, encoding: str, rows: np.ndarray, **more: Any
    ) -> None:
        """`rows` are the bytes (h, step) of the picture."""
        fields = {"width": 8, "height": len(rows), "step": rows.shape[1]} | more
        self.publish(
            topic, "Image", time_s, time_s + LATE_S, encoding=encoding, is_bigendian=0,
            data=rows.reshape(-1).copy(), **fields,
        )  # fmt: skip

    def info(self, topic: str, **changed: Any) -> None:
        k, p = np.zeros(9), np.zeros(12)
        k[[0, 4, 2, 5, 8]] = 700.0, 702.0, 320.0, 240.0, 1.0
        names = ("D", "K", "R", "P") if self.ros1 else ("d", "k", "r", "p")
        values = changed.pop("distortion", np.array([0.1, -0.2, 0.001, 0.002, 0.0]))
        arrays = dict(
            zip(names, (values, k * changed.pop("known", 1), np.eye(3).ravel(), p), strict=True)
        )
        roi = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
        roi |= changed.pop("roi", {})
        fields = {"height": 480, "width": 640, "distortion_model": "plumb_bob"} | changed
        self.publish(
            topic, "CameraInfo", START_S, START_S, binning_x=0, binning_y=0, **arrays,
            roi=self.make("sensor_msgs/RegionOfInterest", **roi), **fields,
        )  # fmt: skip


def small_jpeg(level: int) -> bytes:
    return cv2.imencode(".jpg", np.full((6, 8, 3), level, np.uint8))[1].tobytes()


@pytest.fixture(params=KINDS)
def bag(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[Path, list[bytes]]:
    """Two cameras' topics, of which the second was received out of order."""
    made = Bag(tmp_path / request.param)
    some = [small_jpeg(40 * k) for k in range(5)]
    with made:
        for k, data in enumerate(some):
            made.jpeg("/rig/cam0/image_raw/compressed", START_S + 0.1 * k, data)
        for k, late_s in ((0, 0.0), (2, 0.0), (1, 0.3), (3, 0.3), (4, 0.3)):
            made.jpeg("/rig/cam1/image_raw/compressed", START_S + 0.1 * k, some[k], late_s)
    return made.path, some


def test_pictures_have_the_stamps_of_their_headers_in_order(bag: tuple[Path, list[bytes]]) -> None:
    path, some = bag
    for camera in ("cam0", "cam1"):
        stream = open_video_stream(camera, path)
        np.testing.assert_allclose(stream.times_s - START_S, 0.1 * np.arange(5), atol=1e-6)
        for index in (0, 1, 2, 3, 4, 1, 4, 0):
            assert stream.read(index).encoded == some[index]
        stream.close()
        assert stream.read(3).encoded == some[3]
        stream.close()
        assert stream.source == f"{path}#/rig/{camera}/image_raw/compressed"
        assert stream.notes == ()


def test_topics_are_named_and_those_that_are_not_there_refused(
    bag: tuple[Path, list[bytes]],
) -> None:
    path, some = bag
    for topic in ("/rig/cam1/image_raw/compressed", "rig/cam1/image_raw/compressed"):
        stream = open_video_stream("left", Path(f"{path}#{topic}"))
        assert stream.read(1).encoded == some[1]
        stream.close()
    both = "there is /rig/cam0/image_raw/compressed, /rig/cam1/image_raw/compressed: name one"
    with pytest.raises(SessionError, match=f"no topic /rig/cam2 of pictures; {both}"):
        open_video_stream("left", Path(f"{path}#/rig/cam2"))
    with pytest.raises(SessionError, match=f"camera 'left': .*several topics .*; {both}"):
        open_video_stream("left", path)


def test_a_capture_takes_pictures_of_a_topic(bag: tuple[Path, list[bytes]]) -> None:
    path, some = bag
    board = Path(__file__).parents[2] / "calibration_targets" / "charuco_8x5_27.toml"
    cameras = [{"name": "cam1", "intrinsics": f"{path.name}#/rig/cam1/image_raw/compressed"}]
    file = path.parent / "capture.toml"
    about = {"name": "c", "board": str(board)}
    file.write_text(dump_toml({"capture": about, "cameras": cameras}))
    capture = open_capture(file)
    views = dict(capture.views(capture.cameras[0]))
    assert len(views) == len(some)
    np.testing.assert_allclose(views[next(iter(views))], 0, atol=2)


def yuv(rgb: np.ndarray) -> np.ndarray:
    """Levels (h, w, 3) of BT.601 as cameras send them."""
    by = np.array([[65.481, 128.553, 24.966], [-37.797, -74.203, 112], [112, -93.786, -18.214]])
    return np.rint(rgb / 255.0 @ by.T + [16, 128, 128]).astype(np.uint8)


def rows_of(encoding: str, bgr: np.ndarray) -> np.ndarray:
    """The bytes (h, step) of a picture in an encoding."""
    rgb, alpha = bgr[..., ::-1], np.full((*bgr.shape[:2], 1), 7, np.uint8)
    if encoding.startswith("bayer"):
        plane = np.zeros(bgr.shape[:2], np.uint8)
        for k, letter in enumerate(encoding[6:10]):
            plane[k // 2 :: 2, k % 2 :: 2] = rgb[k // 2 :: 2, k % 2 :: 2, "rgb".index(letter)]
        return plane
    if encoding in ("yuv422", "uyvy", "yuv422_yuy2", "yuyv"):
        light, u, v = np.moveaxis(yuv(rgb), -1, 0)
        color = np.where(np.arange(8) % 2 == 0, u, v)
        order = (light, color) if "yuy" in encoding else (color, light)
        return np.stack(order, axis=-1).reshape(len(bgr), -1)
    kinds = {
        "rgb8": rgb, "bgr8": bgr, "8UC3": bgr, "rgba8": np.dstack([rgb, alpha]),
        "bgra8": np.dstack([bgr, alpha]), "8UC4": np.dstack([bgr, alpha]), "mono8": bgr[..., :1],
        "8UC1": bgr[..., :1],
    }  # fmt: skip
    return kinds[encoding].reshape(len(bgr), -1)


ENCODINGS = (
    *("rgb8", "bgr8", "8UC3", "rgba8", "bgra8", "8UC4", "mono8", "8UC1"),
    *("bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8"),
    *("yuv422", "uyvy", "yuv422_yuy2", "yuyv"),
)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_every_encoding_gives_its_colours(encoding: str, tmp_path: Path) -> None:
    bgr = np.full((6, 8, 3), (200, 90, 30), np.uint8)
    if encoding in ("mono8", "8UC1"):
        bgr[:] = 90
    rows = rows_of(encoding, bgr)
    padded = np.pad(rows, ((0, 0), (0, 5)))
    with Bag(tmp_path / "raw.mcap") as made:
        made.image("/cam0/image_raw", START_S, encoding, padded)
        made.image("/cam0/image_raw", START_S + 0.1, encoding, rows)
    stream = open_video_stream("cam0", made.path)
    for index in (0, 1):
        image = stream.read(index)
        assert np.abs(image.pixels.astype(int) - bgr).max() <= 2
        assert image.encoded is None
    assert ("grey" in "".join(stream.notes)) == (encoding in ("mono8", "8UC1"))
    stream.close()


def test_pictures_that_are_not_read_are_refused_in_a_line(tmp_path: Path) -> None:
    rows, grey = np.zeros((6, 24), np.uint8), cv2.imencode(".png", np.zeros((6, 8), np.uint8))[1]
    with Bag(tmp_path / "odd.mcap") as made:
        made.image("/deep/image_raw", START_S, "16UC1", rows)
        made.image("/cut/image_raw", START_S, "bgr8", rows, height=60)
        made.image("/grows/image_raw", START_S, "bgr8", rows)
        made.image("/grows/image_raw", START_S + 1, "bgr8", rows[:5])
        made.image("/part/image_raw", 0, "bgr8", rows)
        made.image("/part/image_raw", START_S, "bgr8", rows)
        made.jpeg("/video/image", START_S, b"\0\0\0\1\x67 h264")
        made.jpeg("/grey/image", START_S, grey.tobytes())
    for camera, words in (
        ("deep", "encoded as '16UC1', which is not read; bgr8, rgb8, "),
        ("part", "/part/image_raw: 1 of 2 headers have no stamp"),
        ("video", "compressed as 'jpeg', which is not read: JPEG and PNG are"),
        ("grey", "one channel"),
    ):
        with pytest.raises(SessionError, match=f"camera '{camera}': .*{words}"):
            open_video_stream(camera, made.path)
    for camera, index, words in (("cut", 0, "144 bytes of rows of 24"), ("grows", 1, "8x5 px")):
        stream = open_video_stream(camera, made.path)
        with pytest.raises(SessionError, match=f"camera '{camera}', frame {index}: .*{words}"):
            _ = stream.read(index).pixels
        stream.close()


def test_what_stamps_lack_is_said(tmp_path: Path) -> None:
    with Bag(tmp_path / "odd.mcap") as made:
        for k in range(3):
            made.jpeg("/none/image", 0, small_jpeg(0), late_s=0.1 * k)
            made.jpeg("/twice/image", START_S + 0.1 * (k // 2), small_jpeg(0))
    none, twice = (open_video_stream(name, made.path) for name in ("none", "twice"))
    np.testing.assert_allclose(none.times_s - START_S, [0, 0.1, 0.2], atol=1e-6)
    assert "headers have no stamps: times of receipt are taken" in none.notes[0]
    assert len(twice) == 2
    assert "1 of 3 pictures repeat a stamp" in twice.notes[0]


def cut_off(path: Path, share: float) -> Path:
    """The bag's file without its end, alone in a folder."""
    (file,) = (f for f in path.iterdir() if f.suffix != ".yaml")
    out = path.parent / f"cut{share}"
    out.mkdir()
    data = file.read_bytes()
    (out / file.name).write_bytes(data[: int(share * len(data))])
    return out


@pytest.mark.parametrize("share", [0.3, 0.7, 0.9])
def test_of_a_bag_that_was_cut_off_what_is_whole_is_read(share: float, tmp_path: Path) -> None:
    noise = np.random.default_rng(0)
    some = [
        cv2.imencode(".png", noise.integers(0, 256, (100, 100, 3), np.uint8))[1].tobytes()
        for _ in range(100)
    ]
    with Bag(tmp_path / "whole.mcap") as made:
        for k, data in enumerate(some):
            made.jpeg("/cam0/image", START_S + 0.1 * k, data)
    folder = cut_off(made.path, share)
    (file,) = folder.iterdir()
    for path in (folder, file):
        stream = open_video_stream("cam0", path)
        assert share * 100 - 6 < len(stream) < share * 100 + 1
        assert "its end is missing" in stream.notes[0]
        for index in (0, len(stream) - 1):
            image = cv2.imdecode(np.frombuffer(some[index], np.uint8), cv2.IMREAD_COLOR)
            np.testing.assert_array_equal(stream.read(index).pixels, image)
        stream.close()


def test_a_list_without_end_is_not_read(tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag/bag.db3").write_bytes(b"SQLite format 3\0")
    with (tmp_path / "bag/metadata.yaml").open("wb") as file:
        file.write(b"rosbag2_bagfile_information:\n")
        file.truncate(1 << 40)
    with (
        pytest.raises(SessionError, match=f"has {1 << 40} bytes, and 8388608 are the most"),
        open_bag(tmp_path / "bag", SessionError),
    ):
        pass


def test_a_folder_without_its_list_is_read(tmp_path: Path) -> None:
    with Bag(tmp_path / "whole.db3") as made:
        for k in range(4):
            made.jpeg("/cam0/image", START_S + 0.1 * k, small_jpeg(k))
    (made.path / "metadata.yaml").unlink()
    stream = open_video_stream("cam0", made.path)
    assert len(stream) == 4
    assert "has no metadata.yaml" in stream.notes[0]
    stream.close()
    (made.path / "whole.db3").write_bytes(b"SQLite format 3\0" + bytes(2000))
    with pytest.raises(SessionError, match="cannot be read as a bag"):
        open_video_stream("cam0", made.path)


@pytest.mark.parametrize("name", KINDS)
def test_camera_infos_are_lenses(name: str, tmp_path: Path) -> None:
    with Bag(tmp_path / name) as made:
        made.info("/rig/left/camera_info")
        made.info("/rig/right/camera_info", width=1280)
        made.info("/rig/blank/camera_info", known=0)
        made.info("/rig/part/camera_info", roi={"x_offset": 4})
    cameras = [
        {"name": "left", "calibration": f"{made.path.name}#/rig/left/camera_info"},
        {"name": "right", "calibration": f"{made.path.name}#/rig/right/camera_info"},
    ]
    file = tmp_path / "capture.toml"
    file.write_text(dump_toml({"capture": {"name": "c"}, "cameras": cameras}))
    lenses = open_capture(file).lenses
    assert lenses["left"].focal_px == pytest.approx(701, abs=1)
    np.testing.assert_allclose(lenses["left"].distortion[:5], [0.1, -0.2, 0.001, 0.002, 0])
    assert lenses["right"].size_wh == (1280, 480)
    for topic, words in (("/rig/part/camera_info", "binned or cut out"), ("/no", "no topic /no")):
        file.write_text(
            dump_toml(
                {
                    "capture": {"name": "c"},
                    "cameras": [{"name": "a", "calibration": f"{made.path.name}#{topic}"}],
                }
            )
        )
        with pytest.raises(CalibrationError, match=words):
            open_capture(file)
    with pytest.raises(CalibrationError, match=r"intrinsics but no pose .*measure calibrate"):
        read_calibration(Path(f"{made.path}#/rig/left/camera_info"))


@pytest.fixture(scope="module")
def recorded(still: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session whose four cameras are topics of one bag."""
    folder = tmp_path_factory.mktemp("bag")
    for name in ("calibration.toml", "body.toml"):
        shutil.copy(still / name, folder)
    stamps = [row.split(",") for row in (still / "cam0.csv").read_text().split()[1:7]]
    with Bag(folder / "lab.mcap") as made:
        for frame, time_s in stamps:
            for camera in ("cam0", "cam1", "cam2", "cam3"):
                file = next(still.joinpath(camera).glob(f"*{int(frame):04d}.jpg"))
                topic = f"/{camera}/image_raw/compressed"
                made.jpeg(topic, START_S + float(time_s), file.read_bytes())
    tables = [{"name": f"cam{k}", "video": f"lab#/cam{k}/image_raw/compressed"} for k in range(4)]
    table = {"name": "bag", "body": "body.toml", "calibration": "calibration.toml"}
    (folder / "session.toml").write_text(dump_toml({"session": table, "cameras": tables}))
    return folder


def test_a_session_of_topics_is_measured(recorded: Path, tmp_path: Path) -> None:
    assert main(["run", str(recorded), "-o", str(tmp_path / "run"), "--images", "none"]) == 0
    run = read_run(tmp_path / "run")
    assert run.unflagged.sum() == 6
    assert 0 <= run.times_s[0] - START_S < 60
    with open_session(recorded) as session:
        assert [s.size_wh for s in session.streams.values()] == [(1280, 720)] * 4


def test_topics_play_as_cameras(recorded: Path) -> None:
    words = [f"cam{k}={recorded / 'lab'}#/cam{k}/image_raw/compressed" for k in (0, 1)]
    for camera in parse_cameras(words):
        shots = list(camera.source().shots())
        assert len(shots) == 6
        assert 0 < shots[-1].arrived_s - shots[0].arrived_s < 1


def foxglove_file(path: Path, written: str) -> list[bytes]:
    """Three pictures of /cam0/image as JPEG and of /cam1/image as rows, 30 ms apart."""
    pictures = [jpeg(40 * k + 20) for k in range(3)]
    stamps = [(1_700_000_000, 30_000_000 * k) for k in range(3)]
    rows = [cv2.imdecode(np.frombuffer(data, np.uint8), 1) for data in pictures]
    if written == "protobuf":
        foxglove = pytest.importorskip("foxglove")
        channels, messages = foxglove.channels, foxglove.messages
        with foxglove.open_mcap(str(path)):
            jpegs = channels.CompressedImageChannel("/cam0/image")
            raws = channels.RawImageChannel("/cam1/image")
            for (sec, nsec), data, pixels in zip(stamps, pictures, rows, strict=True):
                head = {"timestamp": messages.Timestamp(sec=sec, nsec=nsec), "frame_id": "cam"}
                size = {"width": 64, "height": 48, "step": 192, "encoding": "bgr8"}
                jpegs.log(messages.CompressedImage(**head, data=data, format="jpeg"))
                raws.log(messages.RawImage(**head, **size, data=pixels.tobytes()))
        return pictures
    with path.open("wb") as file:
        writer = pytest.importorskip("mcap.writer").Writer(file)
        writer.start()
        ids = []
        for name, kind in (("/cam0/image", "CompressedImage"), ("/cam1/image", "RawImage")):
            schema = writer.register_schema(f"foxglove.{kind}", "jsonschema", b"{}")
            ids.append(writer.register_channel(name, "json", schema))
        for (sec, nsec), data, pixels in zip(stamps, pictures, rows, strict=True):
            head = {"timestamp": {"sec": sec, "nsec": nsec}, "frame_id": "cam"}
            packed, raw = (base64.b64encode(b).decode() for b in (data, pixels.tobytes()))
            size = {"width": 64, "height": 48, "step": 192, "encoding": "bgr8"}
            for one, values in zip(
                ids, ({"data": packed, "format": "jpeg"}, {**size, "data": raw}), strict=True
            ):
                text = json.dumps({**head, **values}).encode()
                writer.add_message(one, sec * 10**9 + nsec + 9, text, sec * 10**9 + nsec + 9)
        writer.finish()
    return pictures


@pytest.mark.parametrize("written", ["protobuf", "json"])
def test_pictures_of_the_foxglove_sdk_are_read(tmp_path: Path, written: str) -> None:
    path = tmp_path / "rig.mcap"
    pictures = foxglove_file(path, written)
    for name, address in (("cam0", path), ("cam1", Path(f"{path}#/cam1/image"))):
        stream = open_video_stream(name, address)
        np.testing.assert_allclose(stream.times_s, 1.7e9 + 0.03 * np.arange(3), atol=1e-6)
        for k in (0, 2, 1):
            pixels = cv2.imdecode(np.frombuffer(pictures[k], np.uint8), 1)
            np.testing.assert_array_equal(stream.read(k).pixels, pixels)
        stream.close()
    with pytest.raises(SessionError, match="no topic /cam9 of pictures; there is /cam0/image"):
        open_video_stream("cam9", Path(f"{path}#/cam9"))
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(SessionError, match=r"rig\.mcap: cannot be read as MCAP"):
        open_video_stream("cam0", path)
