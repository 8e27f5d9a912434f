"""Recorded videos that go into a Rerun recording as they are, instead of as pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import av
import rerun as rr

from measure.session import Session, Stream

_CODECS = {"h264", "hevc", "av1", "vp9"}
"""What the viewer shows in an mp4. Of other videos the frames go in as pictures."""
LARGEST_BYTES = 500_000_000
"""Larger videos go in as pictures: one message to the viewer holds the whole file."""


@dataclass(frozen=True, eq=False)
class PassedVideo:
    """One camera's video file."""

    asset: rr.AssetVideo
    times_ns: Mapping[int, int]  # by frame number, when a frame is presented


def passed_videos(session: Session) -> Mapping[str, PassedVideo]:
    """By camera name, the videos of a session that the viewer can show."""
    found = {name: _open(stream) for name, stream in session.streams.items()}
    return {name: video for name, video in found.items() if video is not None}


def _open(stream: Stream) -> PassedVideo | None:
    path = stream.files[0]
    if len(stream.files) != 1 or path.suffix.lower() not in (".mp4", ".m4v", ".mov"):
        return None
    if path.stat().st_size > LARGEST_BYTES or _codec(path) not in _CODECS:
        return None
    asset = rr.AssetVideo(path=path, media_type="video/mp4")
    try:
        times_ns = asset.read_frame_timestamps_nanos()
    except RuntimeError:
        return None
    if len(times_ns) != len(stream.frames):
        return None
    return PassedVideo(asset, dict(zip(stream.frames.tolist(), map(int, times_ns), strict=True)))


def _codec(path: Path) -> str:
    with av.open(str(path)) as container:
        return str(container.streams.video[0].codec_context.name)
