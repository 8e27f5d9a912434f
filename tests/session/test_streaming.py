from __future__ import annotations

import gc
import threading
import time
import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from measure.arrays import Bytes
from measure.errors import SessionError
from measure.model import Image
from measure.session import open_session
from measure.session.streams import Stream
from tests.session.conftest import Recording, write_recording
from tests.session.videos import level, write_video


class Watched(Stream):
    """Counts the decoded images that are alive, and notes in which order frames were asked for."""

    def __init__(self, inner: Stream, alive: weakref.WeakSet[Image]) -> None:
        super().__init__(
            inner.name, inner.source, inner.size_wh, inner.frames, inner.times_s, inner.files
        )
        self.inner, self.alive = inner, alive
        self.asked: list[int] = []
        self.decoded: set[int] = set()
        self.most = 0
        self.lock = threading.Lock()

    def read(self, index: int) -> Image:
        time.sleep(0.001 * (index % 3))
        inner = self.inner.read(index)

        def decode() -> Bytes:
            self.decoded.add(inner.frame)
            return inner.pixels

        image = replace(inner, decode=decode)
        with self.lock:
            self.asked.append(index)
            self.alive.add(image)
            self.most = max(self.most, len(self.alive))
        return image


def test_memory_is_bounded_and_order_kept(tmp_path: Path) -> None:
    recording = write_recording(tmp_path / "long", cameras=3, frames=60)
    alive: weakref.WeakSet[Image] = weakref.WeakSet()
    with open_session(recording.path) as session:
        for name, stream in session.streams.items():
            session.streams[name] = Watched(stream, alive)
        seen = []
        for frame_set in session.frame_sets(prefetch=4):
            seen.append(frame_set.index)
            for image in frame_set.images.values():
                assert image.frame == frame_set.index
                watched = session.streams[image.camera]
                assert isinstance(watched, Watched)
                assert image.frame in watched.decoded, "not decoded ahead"
        del frame_set, image
        assert seen == list(range(60))
        # Four sets ahead, the one in use, and the one just asked for.
        assert max(s.most for s in session.streams.values()) <= (4 + 2) * 3
        for stream in session.streams.values():
            assert stream.asked == list(range(60))
    gc.collect()
    assert len(alive) == 0


def test_frames_are_read_ahead_of_the_one_in_use(recording: Recording) -> None:
    alive: weakref.WeakSet[Image] = weakref.WeakSet()
    with open_session(recording.path) as session:
        for name, stream in session.streams.items():
            session.streams[name] = Watched(stream, alive)
        sets = session.frame_sets(prefetch=3)
        next(sets)
        deadline = time.monotonic() + 30
        while time.monotonic() < deadline and min(map(len, _asked(session.streams))) < 3:
            time.sleep(0.01)
        assert min(map(len, _asked(session.streams))) == 3
        sets.close()
        before = threading.active_count()
        assert not any(t.name.startswith("decode") for t in threading.enumerate()), before


def _asked(streams: dict[str, Stream]) -> list[list[int]]:
    return [s.asked for s in streams.values() if isinstance(s, Watched)]


def test_starting_in_the_middle(recording: Recording) -> None:
    with open_session(recording.path) as session:
        sets = list(session.frame_sets(start=4))
    assert [s.index for s in sets] == [4, 5]
    assert sets[0].images["cam1"].frame == 4


def test_a_missing_image_leaves_its_camera_out_of_its_set(recording: Recording) -> None:
    (recording.path / "cam1/000002.jpg").unlink()
    with open_session(recording.path) as session:
        assert len(session.notes) == 1
        assert "camera 'cam1': 1 of 6 frames have no image" in session.notes[0]
        assert "(frame 2)" in session.notes[0]
        sets = list(session.frame_sets())
    assert [sorted(s.images) for s in sets][2] == ["cam0", "cam2"]
    assert [len(s.images) for s in sets] == [3, 3, 2, 3, 3, 3]
    assert [s.images["cam1"].frame for s in sets if "cam1" in s.images] == [0, 1, 3, 4, 5]


def test_frame_numbers_with_gaps_in_file_and_rows(recording: Recording) -> None:
    (recording.path / "cam1/000002.jpg").unlink()
    recording.stamp("cam1", [0.0, 0.1, 0.3, 0.4, 0.5], [0, 1, 3, 4, 5])
    with open_session(recording.path) as session:
        assert session.notes == ()
        sets = list(session.frame_sets())
    assert [len(s.images) for s in sets] == [3, 3, 2, 3, 3, 3]
    assert abs(sets[3].images["cam1"].pixels.mean() - 60) < 3


def test_names_without_numbers_are_matched_in_order(recording: Recording) -> None:
    for k, name in enumerate("abcdef"):
        (recording.path / f"cam1/{k:06d}.jpg").rename(recording.path / f"cam1/{name}.jpg")
    recording.stamp("cam1", [0.0, 0.1, 0.2, 0.3, 0.4, 0.5], [10, 11, 12, 13, 14, 15])
    with open_session(recording.path) as session:
        assert [i.frame for i in map(session.streams["cam1"].read, range(6))] == list(range(10, 16))
    (recording.path / "cam1/c.jpg").unlink()
    with pytest.raises(SessionError, match=r"5 images but .* has 6 rows"):
        open_session(recording.path)


@pytest.mark.parametrize(
    "name", ["f{}_cam1.jpg", "{}-1280x720.jpg", "1_{}_1.jpg", "cam1 ({}) 1.jpg"]
)
def test_the_number_that_tells_files_apart_is_the_frame(tmp_path: Path, name: str) -> None:
    """The camera's comes last, and 10 is not before 2."""
    recording = write_recording(tmp_path / "rec", frames=12)
    for k in range(12):
        (recording.path / f"cam1/{k:06d}.jpg").rename(recording.path / "cam1" / name.format(k))
    with open_session(recording.path) as session:
        images = list(map(session.streams["cam1"].read, range(12)))
    assert [image.frame for image in images] == list(range(12))
    assert [round(image.pixels.mean() / 20) for image in images] == list(range(12))


def test_files_matched_in_order_are_counted_as_people_count(tmp_path: Path) -> None:
    recording = write_recording(tmp_path / "rec", frames=12)
    for k in range(12):
        (recording.path / f"cam1/{k:06d}.jpg").rename(recording.path / f"cam1/f{k}_cam1.jpg")
    recording.stamp("cam1", [0.1 * k for k in range(12)], [100 + k for k in range(12)])
    with open_session(recording.path) as session:
        images = list(map(session.streams["cam1"].read, range(12)))
    assert [round(image.pixels.mean() / 20) for image in images] == list(range(12))


def test_an_offset_moves_a_clock(recording: Recording) -> None:
    recording.stamp("cam1", [7.0 + 0.1 * k for k in range(6)])
    line = 'timestamps = "cam1.csv"\n'
    recording.replace("session.toml", line, line + "time_offset_s = -7.0\n")
    with open_session(recording.path) as session:
        sets = list(session.frame_sets())
    assert [len(s.images) for s in sets] == [3] * 6


def test_clocks_that_never_come_near_each_other_are_refused(recording: Recording) -> None:
    recording.stamp("cam1", [0.05 + 0.1 * k for k in range(6)])
    with open_session(recording.path) as session:
        assert len(list(session.frame_sets())) >= 6
    recording.stamp("cam1", [7.0 + 0.1 * k for k in range(6)])
    recording.stamp("cam2", [9.0 + 0.1 * k for k in range(6)])
    with (
        open_session(recording.path, clocks_apart=True) as session,
        pytest.raises(SessionError, match=r"no two cameras have images within 0\.05 s"),
    ):
        session.frame_sets()


def test_videos_and_images_in_one_session(recording: Recording) -> None:
    """H.264 with its own times beside pictures at a third of the rate."""
    ticks = [3000 * k for k in range(16)]
    write_video(recording.path / "cam1.mp4", "libx264", ticks, options={"bf": "2"})
    recording.replace("session.toml", 'images = "cam1/*.jpg"', 'video = "cam1.mp4"')
    recording.replace("session.toml", 'timestamps = "cam1.csv"\n', "")
    with open_session(recording.path) as session:
        sets = list(session.frame_sets(prefetch=3))
    assert [len(s.images) for s in sets if "cam0" in s.images] == [3] * 6
    for frame_set in sets:
        if "cam0" in frame_set.images:
            film = frame_set.images["cam1"]
            assert film.frame == 3 * frame_set.images["cam0"].frame
            assert abs(film.pixels.mean() - level(film.frame)) < 4


@pytest.mark.parametrize(("name", "count"), [("still", 10), ("async", 5)])
def test_rendered_sessions(renders: Path, name: str, count: int) -> None:
    with open_session(renders / name) as session:
        paired = session.pair()
    assert paired.positions.shape == (count, 4)
    assert np.all(paired.positions >= 0) or name == "async"
    assert (paired.positions >= 0).sum() >= 4 * count - 6
