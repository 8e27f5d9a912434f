"""Bodies measured together share the pictures, and their memory."""

from __future__ import annotations

import weakref
from types import SimpleNamespace

import numpy as np
import pytest

from measure.measuring import measure_together
from measure.model import FrameSet, Image


class Looks:
    """Stands for a pipeline: it looks at every picture, and hands on what it saw some later."""

    def __init__(self, behind):
        self.body, self.behind = SimpleNamespace(), behind

    def measure(self, frame_sets):
        held = []
        for frame_set in frame_sets:
            held += [int(image.pixels[0, 0, 0]) for image in frame_set.images.values()]
            if len(held) > self.behind:
                yield SimpleNamespace(pose=None, saw=held.pop(0))
        yield from (SimpleNamespace(pose=None, saw=one) for one in held)


@pytest.mark.parametrize("behind", [(0,), (3,), (3, 3)])
def test_pixels_are_decoded_once_and_let_go_of_when_all_bodies_are_measured(behind):
    decoded, pixels = [], weakref.WeakSet()

    class Pixels(np.ndarray):
        """Of which it can be told whether they are still in memory."""

        __hash__ = object.__hash__

    def frame_sets():
        for k in range(10):

            def decode(k=k):
                decoded.append(k)
                new = np.full((1, 1, 3), k, np.uint8).view(Pixels)
                pixels.add(new)
                return new

            image = Image("cam0", k, float(k), decode, b"a JPEG")
            held.append(image)
            yield FrameSet(k, float(k), {"cam0": image})

    held, most = [], 0
    for k, row in enumerate(measure_together([Looks(one) for one in behind], frame_sets())):
        assert [one.saw for one in row] == [k] * len(behind)
        most = max(most, len(pixels))
    assert decoded == list(range(10))
    # The one in use; with several bodies those, too, that the last has yet to look at.
    assert most <= (1 if len(behind) == 1 else 1 + max(behind))
    assert len(held) == 10
    assert not pixels
