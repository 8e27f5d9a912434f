from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from measure.errors import SessionError
from measure.session import open_session, read_body, read_calibration
from tests.session.conftest import SIZE_WH, Recording, jpeg, write_recording
from tests.session.videos import write_video


def test_every_set_holds_every_camera_and_the_right_pixels(recording: Recording) -> None:
    with open_session(recording.path) as session:
        sets = list(session.frame_sets())
    assert [frame_set.index for frame_set in sets] == list(range(6))
    assert np.allclose([frame_set.time_s for frame_set in sets], 0.1 * np.arange(6))
    for frame_set in sets:
        assert list(frame_set.images) == ["cam0", "cam1", "cam2"]
        for image in frame_set.images.values():
            assert abs(image.pixels.mean() - 20 * image.frame) < 3
            assert image.frame == frame_set.index
            assert image.encoded is not None


@pytest.mark.parametrize("pattern", ["cam1/*.jpg", "cam*/**/[0-9]*.jpg", "{folder}/cam1/*.jpg"])
def test_a_pattern_may_be_absolute_and_leaves_hidden_files_alone(
    recording: Recording, pattern: str
) -> None:
    for name in ("cam0", "cam2") if pattern.startswith("cam*") else ():
        (recording.path / name).rename(recording.path / f"other_{name}")
        recording.replace("session.toml", f"{name}/*.jpg", f"other_{name}/*.jpg")
    (recording.path / "cam1" / "._000003.jpg").write_bytes(b"what some systems leave behind")
    absolute = pattern.format(folder=recording.path.resolve().as_posix())
    recording.replace("session.toml", "cam1/*.jpg", absolute)
    with open_session(recording.path) as session:
        assert session.streams["cam1"].frames.tolist() == list(range(6))


def _seen(recording: Recording) -> list[tuple[float, float]]:
    """Time and grey level of every picture of the first camera."""
    with open_session(recording.path) as session:
        images = [frame_set.images["cam0"] for frame_set in session.frame_sets()]
        return [(image.time_s, float(np.median(image.pixels))) for image in images]


def test_byte_order_marks_and_carriage_returns_change_nothing(tmp_path):
    recording = write_recording(tmp_path / "rec")
    before = _seen(recording)
    for file in ("session.toml", "body.toml", "calibration.toml", "cam0.csv", "cam1.csv"):
        text = (recording.path / file).read_text()
        (recording.path / file).write_bytes(text.replace("\n", "\r\n").encode("utf-8-sig"))
    assert _seen(recording) == before
    assert len(before) == 6


def test_a_folder_of_any_name_and_a_link_to_it(tmp_path):
    recording = write_recording(tmp_path / "Ünï cödé 球 [1]")
    link = tmp_path / "link"
    link.symlink_to(recording.path)
    assert len(_seen(recording)) == 6
    assert _seen(Recording(link)) == _seen(recording)


@pytest.mark.parametrize("kind", ["16 bits", "transparency"])
def test_pictures_of_other_kinds_have_the_same_values(tmp_path, kind):
    recording = write_recording(tmp_path / "rec")
    before = _seen(recording)
    for path in recording.path.glob("cam*/*.jpg"):
        pixels = cv2.imread(str(path))
        opaque = cv2.cvtColor(pixels, cv2.COLOR_BGR2BGRA)
        other = pixels.astype(np.uint16) * 257 if kind == "16 bits" else opaque
        assert cv2.imwrite(str(path.with_suffix(".png")), other)
        path.unlink()
    session = recording.path / "session.toml"
    session.write_text(session.read_text().replace(".jpg", ".png"))
    assert _seen(recording) == before


DOCS = Path(__file__).parents[2] / "docs/files.md"


@pytest.fixture
def files(tmp_path: Path) -> Path:
    found = re.findall(r"<!-- file: (\S+) -->\n```toml\n(.*?)```", DOCS.read_text(), re.DOTALL)
    assert [name for name, _ in found] == ["session.toml", "body.toml", "calibration.toml"]
    for name, text in found:
        (tmp_path / name).write_text(text)
    return tmp_path


def test_body_and_calibration(files: Path) -> None:
    assert read_body(files / "body.toml").names == ("green", "yellow", "red")
    camera = read_calibration(files / "calibration.toml").camera("cam0")
    assert np.allclose(camera.project([[0.0, 0.0, 0.0]]), [[639.5, 359.5]])


def test_session(files: Path) -> None:
    """The example names everything a session can; two cameras with pictures make it whole."""
    text = (files / "session.toml").read_text()
    small = (files / "calibration.toml").read_text().replace("[1280, 720]", "[64, 48]")
    (files / "calibration.toml").write_text(
        small
        + small[: small.index("[provenance]")]
        .replace("cam0", "cam1")
        .replace("[0.0, 0.0, 500.0]", "[90.0, 0.0, 500.0]")
    )
    (files / "session.toml").write_text(
        text.replace('video = "cam1.mp4"', 'images = "cam1/*.jpg"\ntimestamps = "cam1.csv"')
    )
    (files / "robot.parquet").write_bytes(b"")
    (files / "truth.csv").write_text("")
    for name, offset in (("cam0", 0.0), ("cam1", 0.012)):
        (files / name).mkdir()
        rows = ["frame,time_s"]
        for k in range(3):
            (files / name / f"{k}.jpg").write_bytes(jpeg(20 * k))
            rows.append(f"{k},{k / 30 + offset}")
        (files / f"{name}.csv").write_text("\n".join(rows))
    with open_session(files) as session:
        assert session.name == "example"
        assert session.description == "free text"
        assert session.truth_path == files / "truth.csv"
        assert session.robot_log == files / "robot.parquet"
        assert [len(s.images) for s in session.frame_sets()] == [2, 2, 2]
        assert np.allclose(session.streams["cam1"].times_s, np.arange(3) / 30)
    (files / "robot.parquet").unlink()
    with pytest.raises(SessionError, match=r"robot\.parquet: no such file"):
        open_session(files)


def test_a_video_in_place_of_a_session_is_told_what_is_wanted(recording: Recording) -> None:
    video = recording.path.parent / "cam1.mp4"
    write_video(video, "libx264", frames=2)
    with pytest.raises(SessionError, match=r"cam1\.mp4 is not a session: .* a session\.toml, "):
        open_session(video)
    with open_session(recording.path / "session.toml") as session:
        assert session.name == "small"


def test_an_unreadable_file_is_named_whoever_reads(
    recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    open_file = Path.open

    def refuse(path: Path, *args: object, **kwargs: object) -> object:
        if path.name == "body.toml":
            raise PermissionError(13, "Permission denied", str(path))
        return open_file(path, *args, **kwargs)  # type: ignore[call-overload]

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(SessionError, match=r"body\.toml: cannot be read: Permission denied"):
        open_session(recording.path)


@pytest.mark.parametrize(
    ("data", "words"),
    [(jpeg(60, (32, 24)), "is 32x24 px, the first image 64x48"), (b"hello", "not a picture")],
)
def test_a_bad_image_raises_at_its_own_frame(recording: Recording, data: bytes, words: str) -> None:
    (recording.path / "cam2/000003.jpg").write_bytes(data)
    done = []
    with (
        open_session(recording.path) as session,
        pytest.raises(SessionError, match=r"camera 'cam2', frame 3: .*000003\.jpg") as caught,
    ):
        done.extend(frame_set.index for frame_set in session.frame_sets(prefetch=4))
    assert done == [0, 1, 2]
    assert words in str(caught.value)


def test_a_damaged_jpeg_is_left_out_undecoded_and_named(recording: Recording, capfd) -> None:
    """What lacks a part decodes to grey or shifted blocks; libjpeg says so, but not of which."""
    rng = np.random.default_rng(1)
    pixels = rng.integers(0, 255, (*SIZE_WH[::-1], 3), np.uint8)
    whole = cv2.imencode(".jpg", pixels)[1].tobytes()
    half = len(whole) // 2
    overwritten = whole[:half] + whole[:500] + whole[half + 500 :]
    given = {1: whole[:half], 2: overwritten, 3: whole}
    for frame, data in given.items():
        (recording.path / f"cam2/{frame:06d}.jpg").write_bytes(data)
    with open_session(recording.path) as session:
        frame_sets = list(session.frame_sets())
    assert [dict(one.damaged) for one in frame_sets] == [
        {},
        {"cam2": "000001.jpg"},
        {"cam2": "000002.jpg"},
        *[{}] * 3,
    ]
    assert ["cam2" in one.images for one in frame_sets] == [True, False, False, True, True, True]
    assert "Corrupt" not in capfd.readouterr().err
