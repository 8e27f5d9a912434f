"""Cameras on real HTTP streams: they begin together, break off, come back, or do not fit."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from measure.errors import CaptureError
from measure_studio.capture import CameraAddress, Cameras
from measure_studio.capture.cameras import SETTLING_S
from tests.camera_server import ServedCamera, serving
from tests.session.conftest import jpeg

SIZE = (64, 48)
PICTURES = [jpeg(level, SIZE) for level in range(10, 250, 10)]


def sources(addresses):
    return {name: CameraAddress(name, address).source() for name, address in addresses.items()}


class Kept:
    """A sink that keeps what it is handed."""

    def __init__(self):
        self.images, self._enough = [], threading.Event()

    def __call__(self, image):
        self.images.append(image)

    def of(self, name):
        return [image for image in self.images if image.camera == name]


def waited(until, seconds=20.0):
    end = time.monotonic() + seconds
    while not until():
        assert time.monotonic() < end, "never came"
        time.sleep(0.01)


def test_all_begin_together_and_in_order():
    served = {
        "a": ServedCamera(PICTURES, stamps=True),
        "b": ServedCamera(PICTURES, 1 / 20, stamps=True),
    }
    kept = Kept()
    with serving(served) as addresses, Cameras(sources(addresses)) as rig:
        assert not kept.images
        rig.begin([kept])
        waited(lambda: min(len(kept.of("a")), len(kept.of("b"))) >= 20)
        rig.stop()
        counts = rig.counts
    for name, camera in served.items():
        images = kept.of(name)
        assert [image.frame for image in images] == list(range(len(images)))
        times = np.array([image.time_s for image in images])
        np.testing.assert_allclose(np.diff(times), camera.period_s, atol=2e-3)
        assert counts[name].own_clock
        assert counts[name].rate_hz == pytest.approx(1 / camera.period_s, rel=0.01)
        taken, which = np.array(camera.taken_s).T
        nearest = [int(which[np.argmin(np.abs(taken - t))]) for t in times]
        assert [image.encoded for image in images] == [PICTURES[k] for k in nearest]
        assert np.max(np.min(np.abs(times[:, None] - taken), axis=1)) < 0.02
    first = [kept.of(name)[0].time_s for name in served]
    assert abs(first[0] - first[1]) < 0.2


def test_broken_camera_reconnects_while_the_others_go_on():
    served = {
        "a": ServedCamera(PICTURES),
        "b": ServedCamera(PICTURES, breaks_after=round(SETTLING_S * 30) + 15),
    }
    kept = Kept()
    with serving(served) as addresses, Cameras(sources(addresses)) as rig:
        rig.begin([kept])
        waited(lambda: rig.counts["b"].outages and len(kept.of("b")) > 25)
        counts = rig.counts
    frames = [image.frame for image in kept.of("b")]
    assert frames == list(range(len(frames)))
    gap = np.max(np.diff([image.time_s for image in kept.of("b")]))
    assert gap > 1.0
    assert np.max(np.diff([image.time_s for image in kept.of("a")])) < gap / 2
    assert "broke off inside a picture" in counts["b"].outages[0].reason
    assert counts["a"].outages == ()


def test_a_camera_that_never_was_there_is_told_at_once():
    with (
        serving({"a": ServedCamera(PICTURES)}) as addresses,
        pytest.raises(CaptureError, match=r"camera 'b': http://127.0.0.1:1/: Connection refused"),
        Cameras(sources({**addresses, "b": "http://127.0.0.1:1/"})),
    ):
        pass


def test_pictures_of_another_size_than_calibrated_are_refused():
    with (
        serving({"a": ServedCamera(PICTURES)}) as addresses,
        pytest.raises(CaptureError, match="its pictures are 64x48 px, and 1280x720 px"),
        Cameras(sources(addresses), {"a": (1280, 720)}),
    ):
        pass
    with (
        serving({"a": ServedCamera(PICTURES)}) as addresses,
        Cameras(sources(addresses), {"a": SIZE}),
    ):
        pass  # the control


@pytest.mark.parametrize("sizes", [{"a": SIZE}, {}])
def test_pictures_that_change_their_size_are_not_handed_on(sizes):
    """As of a camera that was switched off and on, and comes back as it was made."""
    other = jpeg(70, (32, 24))
    kept = Kept()
    served = {"a": ServedCamera([*PICTURES[:2] * 22, *[other] * 45])}
    with serving(served) as addresses, Cameras(sources(addresses), sizes) as rig:
        rig.begin([kept])
        waited(lambda: rig.counts["a"].outages)
        trouble = rig.counts["a"].outages[0].reason
    assert kept.images
    assert {image.pixels.shape for image in kept.images} == {(48, 64, 3)}
    assert "its pictures are 32x24 px" in trouble


def test_a_camera_that_sends_no_jpeg_is_told(monkeypatch):
    monkeypatch.setattr("measure_studio.capture.cameras._FIRST_PICTURE_S", 2.0)
    with (
        serving({"a": ServedCamera([b"no picture", b""])}) as addresses,
        pytest.raises(CaptureError, match=r"camera 'a': http.*: no whole picture in 2 s"),
        Cameras(sources(addresses)),
    ):
        pass


def test_torn_pictures_are_left_out_and_counted():
    torn = PICTURES[3][: len(PICTURES[3]) // 2]
    kept = Kept()
    served = {"a": ServedCamera([*PICTURES[:3], torn, *PICTURES[4:8]])}
    with serving(served) as addresses, Cameras(sources(addresses)) as rig:
        rig.begin([kept])
        waited(lambda: len(kept.images) > 20)
        counts = rig.counts
    assert counts["a"].refused > 0
    assert torn not in {image.encoded for image in kept.images}


def test_what_a_sink_raises_ends_it():
    def full(image):
        raise CaptureError("disk full")

    with serving({"a": ServedCamera(PICTURES)}) as addresses, Cameras(sources(addresses)) as rig:
        rig.begin([full])
        waited(lambda: rig.over)
        with pytest.raises(CaptureError, match="disk full"):
            rig.check()


def test_pictures_that_arrive_unevenly_are_told():
    late = (0.0, 0.012, 0.004, 0.009)
    served = {
        "arrival": ServedCamera(PICTURES, late_s=late),
        "own": ServedCamera(PICTURES, late_s=late, stamps=True),
    }
    with serving(served) as addresses, Cameras(sources(addresses)) as rig:
        rig.begin([])
        waited(lambda: min(c.pictures for c in rig.counts.values()) > 30)
        counts = rig.counts
    assert not counts["arrival"].own_clock
    assert counts["arrival"].uneven_s > 5e-3
    assert counts["own"].uneven_s < 1e-3


def test_what_was_counted_was_handed_on_before_the_end():
    handed = []

    def slow(image):
        time.sleep(0.3)
        handed.append(image)

    with serving({"a": ServedCamera(PICTURES)}) as addresses, Cameras(sources(addresses)) as rig:
        rig.begin([slow])
        waited(lambda: handed)
        time.sleep(0.1)
        rig.stop()
        rig.wait()
        count = len(handed)
        assert count == rig.counts["a"].pictures
        time.sleep(0.4)
        assert len(handed) == count
