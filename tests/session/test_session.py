from __future__ import annotations

import numpy as np

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
