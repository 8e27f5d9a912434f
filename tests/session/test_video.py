from __future__ import annotations

import struct
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from measure.errors import SessionError
from measure.session import open_video_stream
from tests.session.videos import level, write_video

H264 = ("libx264", {"bf": "2", "g": "12"})
MJPEG = ("mjpeg", {"q:v": "3"})
TICKS = np.cumsum(np.random.default_rng(3).integers(2600, 3400, 24))
TICKS = (TICKS - TICKS[0]).tolist()


def _levels(stream, positions) -> list[float]:
    return [float(stream.read(i).pixels.mean()) for i in positions]


@pytest.mark.parametrize("codec", [H264, MJPEG], ids=["h264", "mjpeg"])
@pytest.mark.parametrize("ending", ["mp4", "mkv", "avi"])
def test_frames_come_in_the_order_shown(tmp_path: Path, codec, ending: str) -> None:
    path = tmp_path / f"cam.{ending}"
    write_video(path, codec[0], options=codec[1])
    stream = open_video_stream("cam", path)
    assert len(stream) == 24
    assert stream.size_wh == (64, 48)
    assert np.allclose(np.diff(stream.times_s), 1 / 30, atol=1.1e-3)
    wanted = [level(k) for k in range(24)]
    assert np.allclose(_levels(stream, range(24)), wanted, atol=4)
    jumps = [13, 2, 20, 21, 5, 23, 0, 12, 11]
    assert np.allclose(_levels(stream, jumps), [wanted[i] for i in jumps], atol=4)


@pytest.mark.parametrize("codec", [H264, MJPEG], ids=["h264", "mjpeg"])
def test_mp4_times_are_exact_in_the_time_base(tmp_path: Path, codec) -> None:
    write_video(tmp_path / "cam.mp4", codec[0], TICKS, options=codec[1])
    stream = open_video_stream("cam", tmp_path / "cam.mp4", offset_s=-1.0)
    assert np.array_equal(stream.times_s, np.array([t / 90000 for t in TICKS]) - 1.0)


MPEG2 = ("mpeg2video", {"bf": "2", "g": "12", "qmin": "1", "qmax": "2"})
FRAGMENTED = {"movflags": "frag_keyframe+empty_moov"}


@pytest.mark.parametrize(
    ("name", "codec", "container", "tick_s"),
    [
        ("edit_list.mp4", H264, {}, 1e-9),
        ("no_edit_list.mp4", H264, {"use_editlist": "0"}, 1e-9),
        ("fragmented.mp4", H264, FRAGMENTED, 1e-9),
        ("cam.flv", H264, {}, 1e-3),
        ("cam.mkv", H264, {}, 1e-3),
        ("cam.ts", H264, {}, 1e-9),
        ("cam.mpg", MPEG2, {}, 1e-9),
        ("cam.vob", MPEG2, {}, 1e-9),
        ("cam.avi", H264, {}, 1e-9),
    ],
)
def test_the_same_frames_have_the_same_times_in_every_container(
    tmp_path: Path, name: str, codec, container: dict[str, str], tick_s: float
) -> None:
    """With frames out of order these begin at 0, 0.067, 0.53 or 1.4 s: that is no clock."""
    write_video(tmp_path / name, codec[0], options=codec[1], container=container)
    stream = open_video_stream("cam", tmp_path / name)
    assert stream.times_s[0] == 0
    assert np.abs(stream.times_s - np.arange(24) / 30).max() <= tick_s
    order = [*range(24), 13, 2, 20, 21, 5, 23, 0, 12, 11]
    assert np.allclose(_levels(stream, order), [level(k) for k in order], atol=4.9)


def test_a_time_of_day_is_kept(tmp_path: Path) -> None:
    """Recorders that stamp packets by the wall clock: one for all cameras."""
    start = 1_700_000_000 * 90000
    write_video(tmp_path / "cam.mkv", "mjpeg", [start + t for t in TICKS])
    times = open_video_stream("cam", tmp_path / "cam.mkv").times_s
    assert np.abs(times - 1.7e9 - np.array(TICKS) / 90000).max() < 1.1e-3


@pytest.mark.parametrize(
    "names", [("GH010042.MP4", "GH020042.MP4", "GH030042.MP4"), ("GOPR0042.mp4", "GP010042.mp4")]
)
@pytest.mark.parametrize("codec", [H264, MJPEG], ids=["h264", "mjpeg"])
def test_chapters_of_an_action_camera_are_one_recording(tmp_path: Path, names, codec) -> None:
    for k, name in enumerate(names):
        write_video(
            tmp_path / name,
            codec[0],
            options=codec[1],
            shows=list(range(8 * k, 8 * k + 8)),
            frames=8,
        )
    write_video(tmp_path / "GH010043.MP4", codec[0], frames=8)  # another recording
    stream = open_video_stream("cam", tmp_path / names[0])
    count = 8 * len(names)
    np.testing.assert_allclose(stream.times_s, np.arange(count) / 30, atol=1e-3)
    positions = [*range(count), 9, 7, 8, 15, 0]
    assert np.allclose(_levels(stream, positions), [level(k) for k in positions], atol=4)
    assert f"{len(names)} chapters are joined: {names[0]}, {names[1]}" in stream.notes[0]
    stream.close()
    assert len(open_video_stream("cam", tmp_path / "GH010043.MP4")) == 8
    if len(names) == 3:
        (tmp_path / names[1]).unlink()
        with pytest.raises(SessionError, match="chapter 02 in between is missing"):
            open_video_stream("cam", tmp_path / names[0])


@pytest.mark.parametrize("rotation", [0, 90, 180])
def test_an_orientation_tag_is_named(tmp_path: Path, rotation: int) -> None:
    write_video(tmp_path / "cam.mp4", "libx264", frames=3, rotation=rotation)
    stream = open_video_stream("cam", tmp_path / "cam.mp4")
    assert stream.size_wh == (64, 48)
    assert [n.startswith("camera 'cam': an orientation tag") for n in stream.notes] == [True] * (
        rotation != 0
    )


def test_motion_jpeg_keeps_the_recorded_bytes(tmp_path: Path) -> None:
    write_video(tmp_path / "cam.avi", "mjpeg")
    stream = open_video_stream("cam", tmp_path / "cam.avi")
    encoded = stream.read(7).encoded
    assert encoded is not None
    assert encoded in (tmp_path / "cam.avi").read_bytes()
    write_video(tmp_path / "cam.mp4", "libx264")
    assert open_video_stream("cam", tmp_path / "cam.mp4").read(7).encoded is None


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9])
@pytest.mark.parametrize(
    ("name", "codec", "container"),
    [
        ("plain.mp4", H264, {}),
        ("faststart.mp4", H264, {"movflags": "faststart"}),
        ("faststart_mjpeg.mp4", MJPEG, {"movflags": "faststart"}),
        ("h264.mkv", H264, {}),
        ("mjpeg.mkv", MJPEG, {}),
        ("h264.avi", H264, {}),
        ("mjpeg.avi", MJPEG, {}),
    ],
)
def test_a_cut_video_is_refused_by_name(
    tmp_path: Path, name: str, codec, container: dict[str, str], share: float
) -> None:
    path = tmp_path / name
    write_video(path, codec[0], options=codec[1], container=container)
    open_video_stream("left", path)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(SessionError) as caught:
        open_video_stream("left", path)
    message = str(caught.value)
    assert message.startswith(f"camera 'left': {path}: ")
    assert "\n" not in message
    assert any(word in message for word in ("empty", "cut off", "no frames"))
    assert ("to use the rest" in message) == ("the video is cut off: " in message)


@pytest.mark.parametrize("missing", [1, 60, 75, 90])
def test_a_cut_that_costs_only_frames_before_the_last_is_refused(tmp_path, missing) -> None:
    """Such as are shown before one that is stored before them."""
    path = tmp_path / "left.mkv"
    write_video(path, "libx264", options={"bf": "3", "g": "12"})
    data = path.read_bytes()
    path.write_bytes(data[:-missing])
    with pytest.raises(SessionError, match=r"the video is cut off: its last .* are missing"):
        open_video_stream("left", path)
    path.write_bytes(data + b"more")
    assert len(open_video_stream("left", path)) == 24


def test_a_recording_of_unknown_size_is_taken_as_it_is(tmp_path: Path) -> None:
    """As a recorder leaves it that is stopped by force, or writes to a pipe."""
    path = tmp_path / "left.mkv"
    write_video(path, "libx264", options={"bf": "3", "g": "12"}, container={"live": "1"})
    assert len(open_video_stream("left", path)) == 24


def _write_avi(path: Path, there: list[int]) -> None:
    with av.open(str(path), "w") as out:
        stream = out.add_stream("mjpeg", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuvj420p"
        for k in there:
            pixels = np.full((48, 64, 3), level(k), np.uint8)
            frame = av.VideoFrame.from_ndarray(pixels, format="bgr24")
            frame.pts, frame.time_base = k, Fraction(1, 30)
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))


def _drop_last(path: Path, count: int) -> None:
    """Make the last frames' chunks empty, as a camera writes frames that it dropped."""
    data = path.read_bytes()
    chunks, index = data.split(b"idx1")
    pieces = chunks.split(b"00dc")
    chunks = b"00dc".join(pieces[:-count]) + b"00dc\0\0\0\0" * count
    entries = index[4 : 4 - 16 * count + int.from_bytes(index[:4], "little")]
    empty = b"00dc" + struct.pack("<III", 0, len(chunks) - chunks.index(b"movi") - 8, 0)
    index = b"idx1" + struct.pack("<I", len(entries) + 16 * count) + entries + empty * count
    start = chunks.index(b"movi")
    chunks = chunks[: start - 4] + struct.pack("<I", len(chunks) - start) + chunks[start:]
    path.write_bytes(b"RIFF" + struct.pack("<I", len(chunks + index) - 8) + (chunks + index)[8:])


@pytest.mark.parametrize(("written", "dropped"), [([0, 1, 3, 4], 0), ([0, 1, 3, 4, 5, 6], 2)])
def test_a_frame_that_was_dropped_leaves_its_time_empty(tmp_path, written, dropped) -> None:
    path, there = tmp_path / "cam.avi", [0, 1, 3, 4]
    _write_avi(path, written)
    if dropped:
        _drop_last(path, dropped)
    video = open_video_stream("cam", path)
    assert video.times_s == pytest.approx(np.array(there) / 30)
    for position, k in enumerate(there):
        assert abs(video.read(position).pixels.mean() - level(k)) < 4


def test_a_cut_video_with_dropped_frames_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cam.avi"
    _write_avi(path, [0, 1, 3, 4, 5, 6, 7])
    _drop_last(path, 2)
    data = path.read_bytes()
    for missing, there in ((4, 7), (8, 7), (16, 6)):
        path.write_bytes(data[: data.index(b"idx1") - missing])
        with pytest.raises(SessionError, match=f"the video is cut off: {there} of 8 frames"):
            open_video_stream("cam", path)


def test_damage_within_a_video_names_the_frame(tmp_path: Path) -> None:
    path = tmp_path / "cam.mp4"
    write_video(path, "mjpeg", container={"movflags": "faststart"})
    stream = open_video_stream("left", path)
    encoded = stream.read(9).encoded
    assert encoded is not None
    data = bytearray(path.read_bytes())
    start = data.index(encoded)
    data[start : start + len(encoded)] = bytes(len(encoded))
    path.write_bytes(data)
    stream.close()
    stream = open_video_stream("left", path)
    assert stream.read(8).pixels.shape == (48, 64, 3)
    with pytest.raises(SessionError, match=r"camera 'left', frame 9: .*cam\.mp4"):
        _ = stream.read(9).pixels
    assert abs(stream.read(10).pixels.mean() - level(10)) < 4


def test_a_file_without_video_is_refused(tmp_path: Path) -> None:
    (tmp_path / "cam.mp4").write_text("no video at all")
    with pytest.raises(SessionError, match=r"not a video that can be read.*: copy it again"):
        open_video_stream("left", tmp_path / "cam.mp4")
    with pytest.raises(SessionError, match=r"did you mean cam\.mp4"):
        open_video_stream("left", tmp_path / "can.mp4")


def test_a_bare_stream_has_no_times(tmp_path: Path) -> None:
    write_video(tmp_path / "cam.h264", "libx264")
    with pytest.raises(SessionError, match="has no times"):
        open_video_stream("left", tmp_path / "cam.h264")


def test_real_webcams(shared: Path) -> None:
    folder = shared / "data/caliscope_4cam/prerecorded_intrinsic"
    for path in sorted(folder.glob("*.mp4")):
        stream = open_video_stream(path.stem, path)
        assert stream.size_wh == (1280, 720)
        assert len(stream) == 48
        assert np.all(np.diff(stream.times_s) > 0)
        assert stream.read(30).pixels.shape == (720, 1280, 3)


def _red_edge(pixels: np.ndarray) -> float:
    """Where the red channel of the middle row passes half its range, in px."""
    level = pixels[24, :, 2].astype(float)
    level = (level - level.min()) / (level.max() - level.min())
    k = int(np.argmax(level > 0.5))
    return k - 1 + (0.5 - level[k - 1]) / (level[k] - level[k - 1])


def test_colour_edges_do_not_jump_by_half_pixels(tmp_path: Path) -> None:
    """Chroma is stored at half the width: it must be interpolated, or edges snap to its grid."""
    path, edges = tmp_path / "edge.mp4", np.linspace(20.0, 40.0, 21)
    x = np.arange(64)
    with av.open(str(path), "w") as out:
        stream = out.add_stream("libx264", rate=30, options={"crf": "1"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for edge in edges:
            share = 1 / (1 + np.exp((edge - x) / 2))
            row = np.stack([np.full(64, 60.0), 40 + 100 * (1 - share), 20 + 200 * share], axis=1)
            picture = np.broadcast_to(np.rint(row), (48, 64, 3)).astype(np.uint8)
            out.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        out.mux(stream.encode(None))
    video = open_video_stream("cam", path)
    ours = [_red_edge(video.read(k).pixels) - edge for k, edge in enumerate(edges)]
    with av.open(str(path)) as container:
        plain = [
            _red_edge(frame.to_ndarray(format="bgr24")) - edge
            for frame, edge in zip(container.decode(video=0), edges, strict=True)
        ]
    # A constant shift is the encoder's; what scatters with the edge's place is the decoder's.
    assert np.std(ours) < 0.05
    assert np.std(plain) > 0.15
