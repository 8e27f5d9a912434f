"""Pictures are sized by their headers, before they take memory."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from measure.errors import SessionError
from measure.session import Orientation, decode_picture, open_session, open_video_stream
from measure.session.pictures import picture_size_wh
from tests.session.conftest import SIZE_WH, jpeg, write_recording
from tests.session.videos import write_video

KINDS = (".jpg", ".png", ".tiff", ".bmp", ".webp", ".ppm", ".pgm", ".jp2")


def encoded(kind: str) -> bytes:
    pixels = np.random.default_rng(1).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    done, data = cv2.imencode(kind, pixels[..., 0] if kind == ".pgm" else pixels)
    assert done
    return bytes(data)


def png_of(width: int, height: int, rows: int = 1) -> bytes:
    """A header that states a size, and black pixels of some rows."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        check = zlib.crc32(kind + data)
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", check)

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    packed = zlib.compress(bytes(rows * (3 * width + 1)), 9)
    parts = (b"IHDR", header), (b"IDAT", packed), (b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_states_its_size_and_decodes(kind: str) -> None:
    data = encoded(kind)
    assert picture_size_wh(data) == (64, 48)
    assert decode_picture(data, "x").shape == (48, 64, 3)


def test_data_that_unpack_to_more_than_the_header_says_are_refused() -> None:
    assert decode_picture(png_of(64, 48, 48), "x").shape == (48, 64, 3)
    with pytest.raises(SessionError, match=r"x: its data \(\d+ bytes\) unpack to far more than"):
        decode_picture(png_of(64, 48, 100_000), "x")
    pixels = np.random.default_rng(1).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    done, noisy = cv2.imencode(".png", pixels)
    at = bytes(noisy).rfind(b"IEND") - 4
    packed = bytes(noisy)[: at - 4]  # and zeros follow the picture, in its last part of data
    assert done
    assert decode_picture(bytes(noisy), "x").shape == (480, 640, 3)
    start = packed.find(b"IDAT")
    unpacked = zlib.decompressobj()
    raw = b"".join(
        unpacked.decompress(packed[k + 4 : k + 4 + int.from_bytes(packed[k - 4 : k], "big")])
        for k in range(start, len(packed))
        if packed[k : k + 4] == b"IDAT"
    )
    data = zlib.compress(raw + bytes(100_000_000), 6)
    surplus = packed[: start - 4] + struct.pack(">I", len(data)) + b"IDAT" + data
    surplus += struct.pack(">I", zlib.crc32(b"IDAT" + data)) + bytes(noisy)[at:]
    with pytest.raises(SessionError, match="unpack to far more than the 640x480 px"):
        decode_picture(surplus, "x")
    scans = encoded(".jpg")
    with pytest.raises(SessionError, match="unpack to far more than the 64x48 px"):
        decode_picture(scans[:-2] + 200 * b"\xff\xda\x00\x02" + scans[-2:], "x")


def deep_recording(path: Path, levels: list[int], channels: int = 3) -> None:
    """The small recording with PNG of 16 bits in cam1; picture k has the value `levels[k]`."""
    write_recording(path, frames=len(levels))
    session = path / "session.toml"
    session.write_text(session.read_text().replace("cam1/*.jpg", "cam1/*.png"))
    for k, level in enumerate(levels):
        shape = (*SIZE_WH[::-1], channels)
        assert cv2.imwrite(str(path / f"cam1/{k:06d}.png"), np.full(shape, level, np.uint16))


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_pictures_of_16_bits_are_as_bright_as_the_sensors_bits_allow(tmp_path, bits) -> None:
    """12 bits in 16 are black if they are taken for 16; a dark first picture tells nothing."""
    full = (1 << bits) - 1
    deep_recording(tmp_path, [3, full // 2, full, full // 4])
    with open_session(tmp_path) as session:
        seen = [int(session.streams["cam1"].read(k).pixels.max()) for k in range(1, 4)]
        (note,) = session.notes
    assert seen == [127, 255, 63]
    assert f"camera 'cam1': its pictures of 16 bits hold {bits} (values up to {full})" in note


def test_a_stated_bit_depth_holds(tmp_path) -> None:
    deep_recording(tmp_path, [400, 3000] + [100] * 20)
    file = tmp_path / "session.toml"
    table = file.read_text()
    file.write_text(table.replace('images = "cam1', 'bit_depth = 12\nimages = "cam1'))
    with open_session(tmp_path) as session:
        assert not session.notes
        assert session.streams["cam1"].read(1).pixels.max() == 3000 >> 4
    file.write_text(table)  # every third picture is looked at, and 3000 is not among them
    with open_session(tmp_path) as session:
        assert session.streams["cam1"].read(0).pixels.max() == 400 >> 2
        with pytest.raises(SessionError, match=r"frame 1: .*3000 are more than the .* = 12"):
            _ = session.streams["cam1"].read(1).pixels


@pytest.mark.parametrize(("tag", "named"), [(1, False), (3, True), (6, True)])
def test_an_orientation_tag_is_named(tmp_path, tag, named) -> None:
    write_recording(tmp_path)
    exif = b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0%c\0\0\0\0\0\0" % tag
    head = b"\xff\xd8\xff\xe1" + struct.pack(">H", len(exif) + 8) + b"Exif\0\0" + exif
    for file in (tmp_path / "cam2").glob("*.jpg"):
        file.write_bytes(head + file.read_bytes()[2:])
    with open_session(tmp_path) as session:
        assert session.streams["cam2"].read(0).pixels.shape == (*SIZE_WH[::-1], 3)
        said = [note.startswith("camera 'cam2': an orientation tag") for note in session.notes]
    assert said == [True] * named


@pytest.mark.parametrize("depth", [np.uint8, np.uint16])
def test_pictures_of_one_channel_are_named_with_the_cure(tmp_path, depth) -> None:
    write_recording(tmp_path)
    for file in (tmp_path / "cam2").glob("*.jpg"):
        assert cv2.imwrite(str(file.with_suffix(".png")), np.full(SIZE_WH[::-1], 90, depth))
    session = tmp_path / "session.toml"
    session.write_text(session.read_text().replace("cam2/*.jpg", "cam2/*.png"))
    with pytest.raises(SessionError, match=r"'cam2': .*one channel, .* must be demosaiced first"):
        open_session(tmp_path)


def test_a_huge_picture_is_refused_unless_the_limit_is_raised(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    wide = png_of(20_000, 5_001)
    with pytest.raises(SessionError, match=r"x: a picture of 20000x5001 px, .* 100 megapixels"):
        decode_picture(wide, "x")
    huge = bytearray(jpeg(60))
    at = huge.find(b"\xff\xc0") + 5
    huge[at : at + 4] = struct.pack(">HH", 65_000, 65_001)
    with pytest.raises(SessionError, match="65001x65000 px"):
        decode_picture(bytes(huge), "x")
    monkeypatch.setenv("MEASURE_MAX_MEGAPIXELS", "0.003")
    with pytest.raises(SessionError, match=r"64x48 px, larger than 0\.003 megapixels"):
        decode_picture(jpeg(60), "x")
    monkeypatch.setenv("MEASURE_MAX_MEGAPIXELS", "0.0031")
    assert decode_picture(jpeg(60), "x").shape == (48, 64, 3)
    for text in ("many", "-1", "nan", "inf", "0"):
        monkeypatch.setenv("MEASURE_MAX_MEGAPIXELS", text)
        with pytest.raises(SessionError, match=r"MEASURE_MAX_MEGAPIXELS is .*: expected a number"):
            decode_picture(jpeg(60), "x")


def test_a_tile_counts_as_a_picture() -> None:
    """TIFF keeps a small picture in a tile of any size, which is decoded as a whole."""
    entries = [(256, 4, 64), (257, 4, 48), (258, 3, 8), (259, 3, 1), (262, 3, 1), (277, 3, 1)]
    entries += [(322, 4, 30_000), (323, 4, 30_000), (324, 4, 8), (325, 4, 8)]
    body = struct.pack("<H", len(entries))
    body += b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in entries)
    data = b"II*\0" + struct.pack("<I", 8) + body + bytes(4)
    with pytest.raises(SessionError, match="30000x30000 px"):
        decode_picture(data, "x")


@pytest.mark.parametrize("data", [b"", b"GIF89a", b"PNG", b"\xff\xd8\xff\xd9", png_of(0, 0)])
def test_what_states_no_size_is_no_picture(data: bytes) -> None:
    with pytest.raises(SessionError, match="not a picture that can be decoded"):
        decode_picture(data, "x")


def test_pictures_of_a_video_are_sized_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By its container, and each by its own: a stream may state another size on its way."""
    plain, jpegs = tmp_path / "a.mp4", tmp_path / "a.avi"
    write_video(plain, "libx264", frames=2)
    write_video(jpegs, "mjpeg", frames=2)
    huge = jpegs.read_bytes()
    sizes = [at + 5 for at in range(len(huge)) if huge.startswith(b"\xff\xc0", at)]
    changed = bytearray(huge)
    for at in sizes:
        changed[at : at + 4] = struct.pack(">HH", 30_000, 30_000)
    jpegs.write_bytes(changed)
    stream = open_video_stream("c", jpegs)
    with pytest.raises(SessionError, match="30000x30000 px"):
        _ = stream.read(1).pixels
    monkeypatch.setenv("MEASURE_MAX_MEGAPIXELS", "0.001")
    with pytest.raises(SessionError, match=r"a\.mp4: a picture of "):
        open_video_stream("c", plain)


@pytest.mark.parametrize("name", ["a.ts", "a.mkv", "a.mov", "a.avi", "a.flv", "a.webm"])
def test_containers_of_every_kind_are_opened(tmp_path: Path, name: str) -> None:
    codec = {"flv": "flv", "webm": "libvpx"}.get(name[2:], "libx264")
    write_video(tmp_path / name, codec, frames=6)
    assert open_video_stream("c", tmp_path / name).size_wh == (64, 48)


@pytest.mark.parametrize(
    "text", ["#EXTM3U\n#EXTINF:1,\na.mp4\n#EXT-X-ENDLIST\n", "ffconcat version 1.0\nfile a.mp4\n"]
)
def test_a_playlist_is_no_video(tmp_path: Path, text: str) -> None:
    """It names further files to be opened, on this machine or another."""
    write_video(tmp_path / "a.mp4", "libx264", frames=2)
    (tmp_path / "list.mp4").write_text(text)
    with pytest.raises(SessionError, match=r"list\.mp4: not a video that can be read"):
        open_video_stream("c", tmp_path / "list.mp4")


TAGS = range(1, 9)


def marked(size_wh, at):
    pixels = np.zeros((size_wh[1], size_wh[0], 3), np.uint8)
    pixels[at[1], at[0]] = 255
    return pixels


@pytest.mark.parametrize("tag", TAGS)
def test_a_pixel_is_shown_where_its_coordinates_say(tag):
    turn = Orientation((7, 4), tag)
    shown = turn.shown(marked((7, 4), (5, 1)))
    (row, column), *others = np.argwhere(shown[:, :, 0]).tolist()
    assert not others
    assert np.array_equal(turn.points_shown(np.array([[5.0, 1.0]]))[0], [column, row])
    assert turn.turns == (tag != 1)


@pytest.mark.parametrize("tag", TAGS)
def test_there_and_back(tag):
    turn, points = Orientation((1280, 720), tag), np.random.default_rng(tag).uniform(0, 700, (9, 2))
    assert np.allclose(turn.points_stored(turn.points_shown(points)), points)
    assert np.allclose(turn.matrix @ turn.matrix.T, np.eye(2))


@pytest.mark.parametrize("tag", [0, 9, -1, 300])
def test_other_tags_turn_nothing(tag):
    assert not Orientation((7, 4), tag).turns


def test_the_usual_upright_phone():
    """Tag 6: what is stored at the left is shown on top."""
    shown = Orientation((4, 3), 6).points_shown(np.array([[0.0, 0.0], [3.0, 0.0]]))
    assert shown.tolist() == [[2.0, 0.0], [2.0, 3.0]]
