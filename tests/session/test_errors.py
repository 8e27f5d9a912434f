"""Every mistake in a session ends in one line that says what, where and what to do."""

from __future__ import annotations

import pytest

from measure.errors import CalibrationError, SessionError
from measure.session import open_session
from tests.session.conftest import Recording, jpeg
from tests.session.mistakes import BODY_OR_CALIBRATION, Break, Case, remove, replace
from tests.session.videos import write_video


def _write(name: str, data: bytes) -> Break:
    return lambda r: (r.path / name).write_bytes(data)


def _stamp(camera: str, times: list[float], frames: list[int] | None = None) -> Break:
    return lambda r: r.stamp(camera, times, frames)


def _video(recording: Recording, rows: int) -> None:
    write_video(recording.path / "cam1.mp4", "libx264", frames=6)
    recording.replace("session.toml", 'images = "cam1/*.jpg"', 'video = "cam1.mp4"')
    recording.stamp("cam1", [0.1 * k for k in range(rows)])


CASES: dict[str, Case] = {
    **BODY_OR_CALIBRATION,
    "no session file": (
        remove("session.toml"),
        "is not a session: it has no session.toml, the file that names each camera's video",
    ),
    "broken TOML": (
        replace("session.toml", 'name = "small"', 'name = "small'),
        "session.toml:2: not valid TOML",
    ),
    "broken TOML at the end": (
        lambda r: (r.path / "session.toml").write_text('[session]\nname = """'),
        "session.toml:2: not valid TOML",
    ),
    "unknown key": (
        replace("session.toml", "images =", "image ="),
        "session.toml:8: unknown key 'cameras[0].image'; did you mean images?",
    ),
    "a video named as pictures": (
        lambda r: (_video(r, 6), r.replace("session.toml", "video =", "images =")),
        "cam1.mp4 is a video: name it by the key video, not images",
    ),
    "a picture named as a video": (
        replace("session.toml", 'images = "cam1/*.jpg"', 'video = "cam1/000000.jpg"'),
        "000000.jpg is a picture: name pictures by the key images, not video",
    ),
    "pictures named as a video": (
        replace("session.toml", 'images = "cam1/*.jpg"', 'video = "cam1/*.jpg"'),
        "'cam1/*.jpg' are several files: name pictures by the key images",
    ),
    "no name for pictures": (
        replace("session.toml", "cam1/*.jpg", ""),
        "session.toml:13: 'cameras[1].images': string should have at least 1 character, got ''",
    ),
    "no name for stamps": (
        replace("session.toml", '"cam1.csv"', '""'),
        "'cameras[1].timestamps': string should have at least 1 character",
    ),
    "control character in a file name": (
        replace("session.toml", '"body.toml"', '"body\\u0000.toml"'),
        "'session.body': 'body\\x00.toml' holds a control character",
    ),
    "control character in a ball's name": (
        replace("body.toml", '"yellow"', '"yel\\nlow"'),
        "'balls[1].name': 'yel\\nlow' holds a control character",
    ),
    "one camera": (
        lambda r: (r.path / "session.toml").write_text(
            "\n".join((r.path / "session.toml").read_text().splitlines()[:9])
        ),
        "at least two cameras, the session has 1",
    ),
    "two cameras of one name": (
        replace("session.toml", 'name = "cam1"', 'name = "cam0"'),
        "two cameras are called 'cam0'",
    ),
    "no source": (
        replace("session.toml", 'images = "cam1/*.jpg"\n', ""),
        "camera 'cam1' needs either images or video",
    ),
    "no stamps": (
        replace("session.toml", 'timestamps = "cam1.csv"\n', ""),
        "camera 'cam1': images carry no time",
    ),
    "missing image folder": (
        replace("session.toml", "cam1/*.jpg", "cam9/*.jpg"),
        "camera 'cam1'",
        "cam9: no such file",
        "cam1",
    ),
    "no image fits": (
        replace("session.toml", "cam1/*.jpg", "cam1/*.png"),
        "camera 'cam1': no image fits",
        "the folder has 6 files: try *.jpg",
    ),
    "empty JPEG": (
        _write("cam1/000000.jpg", b""),
        "camera 'cam1'",
        "000000.jpg: the file is empty",
    ),
    "truncated first JPEG": (
        _write("cam1/000000.jpg", jpeg(0)[:-40]),
        "000000.jpg: truncated JPEG",
    ),
    "not a picture": (_write("cam1/000000.jpg", b"hello"), "000000.jpg: not a picture"),
    "missing stamps file": (remove("cam1.csv"), "cam1.csv: no such file; did you mean"),
    "frames numbered by nanoseconds": (
        _stamp("cam1", [0.0, 0.1], [1700000000000000000, 1700000000000000001]),
        "camera 'cam1': ",
        "6 of 6 images in ",
        "have no row in",
    ),
    "pictures numbered by nanoseconds": (
        lambda r: [
            f.rename(f.with_stem(f"{2**63 - 3 + int(f.stem)}")) for f in r.path.glob("cam1/*.jpg")
        ],
        "(9223372036854775805, 9223372036854775806, ",
        "are not the frame numbers of",
    ),
    "an offset beyond all times": (
        replace("session.toml", '"cam1.csv"', '"cam1.csv"\ntime_offset_s = -1e18'),
        "session.toml:15: 'cameras[1].time_offset_s': input should be greater than or equal to",
    ),
    "wrong header": (
        replace("cam1.csv", "frame,time_s", "frame,clock"),
        "camera 'cam1': ",
        "cam1.csv:1: the header lacks time_s",
    ),
    "no rows": (_write("cam1.csv", b"frame,time_s\n"), "cam1.csv: has a header but no rows"),
    "no number": (
        _write("cam1.csv", b"frame,time_s\n0,0.0\n\n1,now\n"),
        "cam1.csv:4: time_s is 'now', not a number",
    ),
    "decimal commas": (
        _write("cam1.csv", b"frame,time_s\n0,0\n1,1,5\n2,3\n3,4,5\n4,6\n5,7,5\n"),
        "cam1.csv:3: 3 cells under 2 headings (and 2 rows more like it): are decimal commas",
    ),
    "NaN stamp": (
        _stamp("cam1", [0.0, 0.1, float("nan"), 0.3, 0.4, 0.5]),
        "camera 'cam1': ",
        "cam1.csv:4: frame 2 has the time nan",
    ),
    "clock goes backwards": (
        _stamp("cam1", [0.0, 0.1, 0.05, 0.3, 0.4, 0.5]),
        "cam1.csv:4: time goes backwards, from 0.100000 s (frame 1) to 0.050000 s (frame 2)",
    ),
    "clock stands still": (
        _stamp("cam1", [0.0, 0.1, 0.1, 0.3, 0.4, 0.5]),
        "cam1.csv:4: time stands still, from 0.100000 s (frame 1) to 0.100000 s (frame 2)",
    ),
    "frame numbers go backwards": (
        _stamp("cam1", [0.0, 0.1, 0.2, 0.3, 0.4, 0.5], [0, 1, 1, 3, 4, 5]),
        "cam1.csv:4: frame 1 follows frame 1",
    ),
    "images without rows": (
        _stamp("cam1", [0.0, 0.1, 0.2, 0.3]),
        "camera 'cam1': 2 of 6 images have no row in",
        "(frame 4, 5)",
    ),
    "rows counted from one": (
        _stamp("cam1", [0.0, 0.1, 0.2, 0.3, 0.4, 0.5], [1, 2, 3, 4, 5, 6]),
        "camera 'cam1': the numbers of the files",
        "are not the frame numbers",
    ),
    "video and rows differ": (
        lambda r: _video(r, rows=5),
        "camera 'cam1': ",
        "cam1.mp4 has 6 frames but ",
        "cam1.csv has 5 rows",
    ),
    "stamps without a heading for the time": (
        _write("cam1.csv", b"frame;x\n0;0,0\n1;0,1\n"),
        "cam1.csv:1: the header lacks time_s",
        "it holds frame,x",
    ),
    "UTF-16 without its mark": (
        _write("session.toml", '[session]\nname = "sm\xe4ll"\n'.encode("utf-16-le")),
        "session.toml: not a text file (byte 40 is not UTF-8)",
    ),
    "no common time": (
        _stamp("cam1", [100.0, 100.1, 100.2, 100.3, 100.4, 100.5]),
        "time in common: cam1 (100.000 to 100.500 s); and cam0 (0.000 to ",
        "on one clock?",
    ),
    "stamps in nanoseconds": (
        _stamp("cam1", [1.7e18, 1.8e18, 1.9e18, 2.0e18, 2.1e18, 2.2e18]),
        "cam1.csv:2: frame 0 has the time 1.7e+18 s: are these milli-, micro- or nanoseconds?",
    ),
    "missing truth": (
        replace("session.toml", 'name = "small"', 'name = "small"\ntruth = "truth.csv"'),
        "truth.csv: no such file",
    ),
    "body twice": (
        replace("session.toml", "[[cameras]]", "[body]\nballs = []\n[[cameras]]"),
        "give the body once",
    ),
    "no body": (
        replace("session.toml", 'body = "body.toml"\n', ""),
        "session.toml: the session names no body; add body = ",
    ),
    "unknown key at the top": (
        replace("session.toml", "[[cameras]]", "[robott]\nlog = 'x'\n[[cameras]]"),
        "session.toml:6: unknown key 'robott'; did you mean robot?",
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_the_mistake_is_explained_in_one_line(recording: Recording, name: str) -> None:
    spoil, *expected = CASES[name]
    with open_session(recording.path):
        pass  # the control: unspoilt it opens
    spoil(recording)
    with pytest.raises((SessionError, CalibrationError)) as caught:
        open_session(recording.path)
    message = str(caught.value)
    assert "\n" not in message
    for part in expected:
        assert part in message, message
