from __future__ import annotations

import numpy as np
import pytest

from measure.session import open_session
from tests.session.conftest import Recording


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
