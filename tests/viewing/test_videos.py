"""A recorded video goes into the recording as it is; what the viewer cannot show does not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from measurements import BODY, CAMERAS, measurement

from measure.model import FrameSet, Image
from measure.session import Stream, open_video_stream
from measure.viewing import entities, recording
from measure.viewing.recording import RunRecording, open_recording, passed_videos
from tests.session.videos import SIZE_WH, write_video
from tests.viewing.reading import column, read_recording

TICKS = [0, 3100, 5900, 9000, 12000, 15400, 18000, 21000]


@dataclass
class _Session:
    streams: dict[str, Stream]


def _session(path, **made):
    write_video(path, **made)
    return _Session({"cam0": open_video_stream("cam0", path)})


def _frame_set(index):
    def grey():
        return np.full((SIZE_WH[1], SIZE_WH[0], 3), 99, np.uint8)

    images = {name: Image(name, index, index / 30, grey) for name in ("cam0", "cam1")}
    return FrameSet(index, index / 30, images)


def _record(path, session, every):
    stream = open_recording("test", CAMERAS, path)
    with RunRecording(stream, [BODY], CAMERAS, every, passed_videos(session)) as run:
        for index in range(len(TICKS)):
            run.add([measurement(index)], _frame_set(index))
    return read_recording(path)


def test_the_file_and_the_frames_own_times_are_in_the_recording(tmp_path):
    options = {"bf": "2", "g": "8"}  # frames that are stored in another order than shown
    session = _session(tmp_path / "cam0.mp4", codec="libx264", ticks=TICKS, options=options)
    stored = _record(tmp_path / "run.rrd", session, every=1)
    image = stored[entities.image("cam0")]
    (blob,) = [
        b["AssetVideo:blob"].to_pylist() for b in image if "AssetVideo:blob" in b.schema.names
    ]
    assert bytes(np.array(blob[0][0], np.uint8)) == (tmp_path / "cam0.mp4").read_bytes()
    shown = column(image, "VideoFrameReference:timestamp")
    times = np.array([shown[k][0] for k in range(len(TICKS))], dtype=float)
    assert times - times[0] == pytest.approx(np.array(TICKS) / 90000 * 1e9, abs=2)
    assert not any("EncodedImage:blob" in b.schema.names for b in image)
    other = column(stored[entities.image("cam1")], "Image:buffer") or column(
        stored[entities.image("cam1")], "EncodedImage:blob"
    )
    assert len(other) == len(TICKS), "a camera without a video keeps its pictures"


def test_every_third_set_and_none(tmp_path):
    session = _session(tmp_path / "cam0.mp4", codec="libx264", ticks=TICKS)
    shown = column(
        _record(tmp_path / "third.rrd", session, every=3)[entities.image("cam0")],
        "VideoFrameReference:timestamp",
    )
    assert list(shown) == [0, 3, 6]
    assert entities.image("cam0") not in _record(tmp_path / "none.rrd", session, every=0)


@pytest.mark.parametrize(("name", "codec"), [("cam0.avi", "mjpeg"), ("cam0.mp4", "mpeg4")])
def test_other_videos_become_pictures(tmp_path, name, codec):
    session = _session(tmp_path / name, codec=codec, frames=8)
    assert passed_videos(session) == {}
    stored = _record(tmp_path / "run.rrd", session, every=1)
    assert len(column(stored[entities.image("cam0")], "EncodedImage:blob")) == len(TICKS)


def test_a_video_too_large_for_one_message_becomes_pictures(tmp_path, monkeypatch):
    session = _session(tmp_path / "cam0.mp4", codec="libx264", ticks=TICKS)
    assert set(passed_videos(session)) == {"cam0"}
    monkeypatch.setattr(recording, "LARGEST_BYTES", 100)
    assert passed_videos(session) == {}
