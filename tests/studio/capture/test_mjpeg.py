"""Motion JPEG over HTTP: streams as different servers write them, whole and broken."""

from __future__ import annotations

from contextlib import closing
from io import BytesIO
from itertools import islice, pairwise

import pytest

from measure.errors import CaptureError
from measure_studio.capture.mjpeg import HttpSource, parts_of
from tests.camera_server import ServedCamera, serving

ONE = b"\xff\xd8 one \r\n\n more lines, \xff\xda\0\2 and a thumbnail's end \xff\xd9 \xff\xd9"
TWO = b"\xff\xd8\xff\xda two\n--not-the-boundary\r\n\xff\xd9"


def with_lengths(line):
    """As mjpg-streamer and most cameras write it."""
    out = b""
    for k, data in enumerate((ONE, TWO)):
        headers = [b"--b", b"Content-Type: image/jpeg", b"Content-Length: %d" % len(data)]
        out += line.join([*headers, b"X-Timestamp: %d.5" % k, b"", data, b""])
    return out


def without_lengths(line):
    head = b"--b" + line + b"Content-Type: image/jpeg" + line + line
    return head + ONE + line + head + TWO + line + b"--b--" + line


def shots(data):
    return list(parts_of(BytesIO(data), "http://camera"))


@pytest.mark.parametrize("line", [b"\r\n", b"\n"])
@pytest.mark.parametrize("written", [with_lengths, without_lengths])
def test_every_byte_of_the_pictures_is_there(line, written):
    assert [shot.jpeg for shot in shots(written(line))] == [ONE, TWO]


def test_what_comes_before_the_first_part_is_passed_over():
    assert len(shots(b"\r\nhello\r\n" + with_lengths(b"\r\n"))) == 2


def test_the_cameras_own_times_are_read_where_it_sends_them():
    assert [shot.device_s for shot in shots(with_lengths(b"\r\n"))] == [0.5, 1.5]
    assert [shot.device_s for shot in shots(without_lengths(b"\r\n"))] == [None, None]


@pytest.mark.parametrize("stamp", [b"soon", b"nan", b"inf", b""])
def test_a_time_that_is_none_is_left_out(stamp):
    data = with_lengths(b"\r\n").replace(b"X-Timestamp: 0.5", b"X-Timestamp: " + stamp)
    assert [shot.device_s for shot in shots(data)] == [None, 1.5]


@pytest.mark.parametrize("written", [with_lengths, without_lengths])
def test_a_stream_that_ends_inside_a_picture_says_so(written):
    whole = written(b"\r\n")
    broken = parts_of(BytesIO(whole[: whole.rindex(b"two")]), "http://camera")
    assert next(broken).jpeg == ONE
    with pytest.raises(CaptureError, match="broke off inside a picture"):
        next(broken)


def test_what_is_no_stream_of_parts_says_so():
    with pytest.raises(CaptureError, match="no part of a stream"):
        shots(b"<p>hello</p>\n" * 200)
    with pytest.raises(CaptureError, match="no end of its headers"):
        shots(b"--b\r\n" + b"X-Header: 1\r\n" * 200)
    with pytest.raises(CaptureError, match="announces a picture of 99999999999 bytes"):
        shots(b"--b\r\nContent-Length: 99999999999\r\n\r\n")


@pytest.mark.parametrize("written", [with_lengths, without_lengths])
def test_picture_arrives_with_its_end_not_with_the_next(written):
    """Where the line between them comes with the next one only, it is a picture late."""

    class Stalled(BytesIO):
        def readline(self, size=-1):
            assert self.tell() < len(self.getvalue()), "waits for what comes later"
            return super().readline(size)

    whole = written(b"\r\n")
    first = whole[: whole.index(ONE) + len(ONE) + 2]
    assert next(parts_of(Stalled(first), "http://camera")).jpeg == ONE


@pytest.mark.parametrize("lengths", [True, False])
def test_a_real_stream_over_loopback(lengths):
    served = ServedCamera([ONE, TWO], period_s=0.01, lengths=lengths, stamps=True)
    with serving({"cam0": served}) as addresses, closing(seen(addresses["cam0"])) as stream:
        some = list(islice(stream, 6))
    assert {shot.jpeg for shot in some} == {ONE, TWO}
    assert all(a.jpeg != b.jpeg for a, b in pairwise(some))
    late = [shot.arrived_s - shot.device_s for shot in some]
    assert max(late) - min(late) < 0.2


def seen(address):
    return HttpSource(address).shots()


def test_a_password_is_sent_and_never_shown():
    with serving({"cam0": ServedCamera([ONE], password="p@ss/word")}) as addresses:
        address = addresses["cam0"].replace("http://", "http://me:p%40ss%2Fword@")
        assert HttpSource(address).address == f"{addresses['cam0'].partition('?')[0]}?..."
        with closing(seen(address)) as stream:
            assert next(stream).jpeg == ONE
        with pytest.raises(CaptureError, match="answers 401") as told:
            next(seen(address.replace("me:p", "me:q")))
    assert "ss%2F" not in str(told.value)


def test_addresses_of_something_else_are_explained():
    with serving({"cam0": ServedCamera([ONE])}) as addresses:
        root = addresses["cam0"].rpartition("/")[0]
        with pytest.raises(CaptureError, match="answers 404"):
            next(seen(f"{root}/nothing"))
        with pytest.raises(CaptureError, match=r"answers image/jpeg, not a stream of JPEGs"):
            next(seen(f"{root}/still"))
    with pytest.raises(CaptureError, match=r"127\.0\.0\.1:1/: Connection refused"):
        next(seen("http://127.0.0.1:1/"))
    with pytest.raises(CaptureError, match=r"nonnumeric port|[Ii]nvalid"):
        next(seen("http://127.0.0.1:none/"))
