"""A camera's frames in a video file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from measure.arrays import Bytes
from measure.errors import SessionError
from measure.model import Image
from measure.session.pictures import decode_picture
from measure.session.streams import Stream, turned_notes
from measure.session.timestamps import Stamps
from measure.session.video_file import VideoIndex, VideoReader, index_video


class VideoStream(Stream):
    """A video: its own presentation times, or stamps from a file beside it."""

    def __init__(
        self, name: str, path: Path, index: VideoIndex, stamps: Stamps, offset_s: float
    ) -> None:
        times_s, notes = stamps.times_s + offset_s, turned_notes(name, index.turned)
        super().__init__(name, str(path), index.size_wh, stamps.frames, times_s, [path], notes)
        self._reader = VideoReader(path, index)
        self._motion_jpeg = index.motion_jpeg

    def read(self, index: int) -> Image:
        """The frame at position `index`; of a motion-JPEG video with the recorded JPEG."""
        self.check_index(index)
        where = f"{self.place(index)}: "
        data = self._reader.jpeg(index, where) if self._motion_jpeg else None

        def decode() -> Bytes:
            if data is None:
                return self._reader.picture(index, where)
            return decode_picture(data, f"{where}{self.source}")

        return self._image(index, decode, data)

    def close(self) -> None:
        """Close the file; reading again opens it again."""
        self._reader.close()


def open_video_stream(
    name: str,
    path: Path,
    stamps: Stamps | None = None,
    stamps_path: Path | None = None,
    offset_s: float = 0.0,
) -> VideoStream:
    """Open a video (mp4, mkv, avi, ...; H.264, motion JPEG, ...).

    Args:
        stamps: times of the frames in order; if omitted the container's own, after the first frame.
        stamps_path: the file they come from, for messages.
        offset_s: is added to every time.

    Raises:
        SessionError: missing, empty, truncated or damaged, or `stamps` has not one row a frame.
    """
    index = index_video(path, f"camera '{name}': ")
    count = len(index.stamps)
    if stamps is None:
        stamps = Stamps(np.arange(count), index.times_s)
    elif len(stamps.frames) != count:
        raise SessionError(
            f"camera '{name}': {path} has {count} frames but {stamps_path} has "
            f"{len(stamps.frames)} rows; they must be equally many"
        )
    return VideoStream(name, path, index, stamps, offset_s)
