"""Files that are missing, refused or torn are named, at the frame where they are met."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from measure.errors import SessionError
from measure.session import open_session
from tests.session.conftest import Recording, jpeg
from tests.session.videos import write_video


def test_a_missing_folder_is_named_with_near_names(recording: Recording) -> None:
    with pytest.raises(SessionError, match="did you mean rec"):
        open_session(recording.path.with_name("recc"))


def test_a_video_in_place_of_a_session_is_told_what_is_wanted(recording: Recording) -> None:
    video = recording.path.parent / "cam1.mp4"
    write_video(video, "libx264", frames=2)
    with pytest.raises(SessionError, match=r"cam1\.mp4 is not a session: .* a session\.toml, "):
        open_session(video)
    with open_session(recording.path / "session.toml") as session:
        assert session.name == "small"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_an_unreadable_file_is_named(recording: Recording) -> None:
    (recording.path / "body.toml").chmod(0)
    with pytest.raises(SessionError, match=r"body\.toml: cannot be read: Permission denied"):
        open_session(recording.path)


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
    [
        (jpeg(60)[:-40], "truncated JPEG"),
        (jpeg(60, (32, 24)), "is 32x24 px, the first image 64x48"),
        (b"hello", "not a picture"),
    ],
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
