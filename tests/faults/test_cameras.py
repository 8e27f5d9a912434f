"""Hostile cameras: each is given up in time, told in one clean line, and takes little."""

from __future__ import annotations

import re
import socket
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, suppress

import cv2
import numpy as np
import pytest

from benchmarks.faults.cameras import FAULTS, meet
from benchmarks.faults.hostile_camera import LOGIN, TOKEN, Fault, HostileCamera, hostile
from measure.errors import CaptureError
from measure_studio.capture import CameraAddress, Cameras
from measure_studio.capture.sources import shown
from tests.studio.capture.test_cameras import waited

SECRETS = (LOGIN, LOGIN.partition(":")[2], TOKEN)
LIMIT_S = 0.6
"""In place of five and fifteen seconds."""


@pytest.fixture(scope="module")
def pictures():
    draw = np.random.default_rng(4)
    noise = draw.integers(0, 255, (8, 120, 160, 3), np.uint8)
    return [cv2.imencode(".jpg", one)[1].tobytes() for one in noise]


@pytest.fixture(scope="module")
def met(pictures):
    """Every fault, all at once."""
    with pytest.MonkeyPatch.context() as patch, ThreadPoolExecutor(len(FAULTS)) as pool:
        patch.setattr("measure_studio.capture.mjpeg.PATIENCE_S", LIMIT_S)
        patch.setattr("measure_studio.capture.mjpeg._MAX_PICTURE_S", LIMIT_S)
        found = list(pool.map(lambda fault: meet(fault, pictures, 1.5), FAULTS))
    return dict(zip((fault.name for fault in FAULTS), found, strict=True))


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_it_is_given_up_in_time(met, fault: Fault):
    meeting = met[fault.name]
    assert meeting.seconds < 6.0  # 37 threads on a busy machine
    if fault.silences is not None:
        assert meeting.usable <= 1 if fault.silences else meeting.usable >= 3
    if fault.answer is not None and fault.silences:
        assert meeting.told
    assert meeting.told.isprintable()
    assert len(meeting.told) < 300
    assert not any(secret in meeting.told for secret in SECRETS)
    assert meeting.camera.leaked == []


def _says(*data):
    return lambda wire, _: wire.send(*data)


def test_a_head_without_end_takes_no_memory(met):
    """A hundred lines of 64 KiB, and as many more as come in time, used to be read."""
    buffers = 8 << 20  # of the two sockets
    for name in ("header of gigabytes", "headers of a part without end", "part without end"):
        assert met[name].camera.sent < (16 << 20) + buffers
    assert met["header of gigabytes"].camera.sent < buffers


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("head byte by byte", "the head of its answer did not come to its end in 0.6 s"),
        ("header of gigabytes", "the head of its answer is longer than 65536 bytes"),
        ("redirects to itself", "redirects more than 4 times"),
        ("redirects to a file", "redirects to no address of HTTP"),
        ("503", "answers 503 Service Unavailable"),
        ("closes at once", "Remote end closed connection without response"),
        ("no HTTP", "what it answers is no HTTP"),
        ("no answer", "the head of its answer did not come to its end in 0.6 s"),
        ("picture byte by byte", "a picture did not come to its end in 0.6 s"),
        ("huge length", "announces a picture of 100000000000 bytes"),
    ],
)
def test_what_is_told(met, name, told):
    assert told in met[name].told


def test_a_stream_in_chunks_is_read(pictures):
    """As ESP32 cameras send it: each part in a chunk of HTTP/1.1."""
    head = b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n"
    head += b"Content-Type: multipart/x-mixed-replace; boundary=b\r\n\r\n"
    parts = [b"--b\r\nContent-Length: %d\r\n\r\n%b\r\n" % (len(one), one) for one in pictures]
    chunks = [b"%x\r\n%b\r\n" % (len(part), part) for part in parts]
    camera = HostileCamera(
        pictures, fault=Fault("chunks", False, _says(head, *chunks, b"0\r\n\r\n"))
    )
    with hostile([camera]) as (address,):
        shots = list(CameraAddress("a", address).source().shots())
    assert [shot.jpeg for shot in shots] == pictures


def test_a_flood_of_pictures_is_given_up(pictures):
    """Reading it took all the time of this process."""
    flood = next(fault for fault in FAULTS if fault.name == "flood of nothing")
    meeting = meet(flood, pictures, 5.0)
    assert meeting.told.endswith("sends more than 1000 pictures a second")


def test_a_password_is_sent_to_its_own_host_only(pictures):
    """The control: there it is sent, once the camera asks."""
    camera = HostileCamera(pictures)
    heard = []
    answer = camera.connect

    def asking(wire, request):
        heard.append(request)
        if b"Authorization" in request:
            answer(wire, request)
        else:
            asks = b'WWW-Authenticate: Basic realm="x"\r\n'
            wire.send(b"HTTP/1.1 401 Unauthorized\r\n", asks, b"Content-Length: 0\r\n\r\n")

    camera.connect = asking
    with hostile([camera]) as (address,):
        next(CameraAddress("a", address).source().shots())
    assert b"Authorization" not in heard[0]
    assert b"Authorization: Basic " in heard[1]
    assert all(f"token={TOKEN}".encode() in request for request in heard)


def test_a_password_of_rtsp_follows_no_redirection():
    """FFmpeg would send it; the control redirects an address without one, and is followed."""
    heard = []

    def answer(connection, location):
        while request := connection.recv(4096):
            heard.append((location, request))
            told = b"302 Found\r\nLocation: " + location if location else b"401 Unauthorized"
            lines = [b"RTSP/1.0 " + told, re.search(rb"CSeq: \d+", request)[0]]
            lines += [b'WWW-Authenticate: Basic realm="x"', b"", b""]
            connection.sendall(b"\r\n".join(lines))

    def listen(server, location):
        with suppress(OSError):
            while True:
                connection, _ = server.accept()
                with connection, suppress(OSError):
                    answer(connection, location)

    with ExitStack() as stack:
        first, other = (
            stack.enter_context(closing(socket.create_server(("127.0.0.1", 0)))) for _ in range(2)
        )
        port = other.getsockname()[1]
        for server, location in ((first, b"rtsp://127.0.0.1:%d/x" % port), (other, b"")):
            threading.Thread(target=listen, args=(server, location), daemon=True).start()
            stack.callback(server.shutdown, socket.SHUT_RDWR)
        place = f"127.0.0.1:{first.getsockname()[1]}/y"
        with pytest.raises(CaptureError, match="redirects to another address"):
            next(CameraAddress("a", f"rtsp://{LOGIN}@{place}").source().shots())
        assert all(location for location, _ in heard)
        with pytest.raises(CaptureError, match="401"):
            next(CameraAddress("a", f"rtsp://{place}").source().shots())
        assert not all(location for location, _ in heard)
    assert not any(b"uthorization" in request for _, request in heard)


def test_an_outage_is_told_at_once_and_once(pictures):
    """It stalls, is connected anew and fails again, and comes back: one outage."""
    by_name = {fault.name: fault for fault in FAULTS}
    camera, told = HostileCamera(pictures), []
    with hostile([camera]) as (address,):
        sources = {"cam0": CameraAddress("cam0", address).source()}
        with Cameras(sources, on_outage=told.append) as rig:
            rig.begin([])
            waited(lambda: rig.counts["cam0"].pictures > 20)
            assert rig.away == ()
            camera.fault = by_name["reset in a picture"]
            last_s = camera.good_s
            waited(lambda: told)
            assert rig.clock_s() - last_s - 3 * camera.period_s < 1.0
            assert rig.away == ("cam0",)
            camera.fault = by_name["503"]
            waited(lambda: "503" in rig.counts["cam0"].outages[0].reason)
            camera.fault = None
            waited(lambda: len(told) > 1)
            assert rig.away == ()
    assert [outage.lasts for outage in told] == [True, False]
    assert told[1].until_s - told[1].since_s > 1.0
    assert rig.counts["cam0"].outages == (told[1],)


@pytest.mark.parametrize(
    ("address", "wanted"),
    [
        ("http://me:pw@host:8080/a/b?user=x&pwd=pw", "http://host:8080/a/b?..."),
        ("http://me:p/w@host/", "http://..."),
        ("http://me:p?w@host/", "http://..."),
        (
            "rtsp://host:554/user=me_password=pw_channel=1/live.sdp",
            "rtsp://host:554/user=.../live.sdp",
        ),
        ("me:pw@host/stream", "host/stream"),
        ("http://[::1]:80/x", "http://[::1]:80/x"),
        ("/dev/video0", "/dev/video0"),
    ],
)
def test_what_is_shown_of_an_address(address, wanted):
    assert shown(address) == wanted
    assert address not in repr(CameraAddress("cam0", address)) or address == wanted
