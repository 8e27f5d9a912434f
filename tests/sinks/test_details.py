"""What single protocols promise beyond poses: names, metadata, pictures, refusals, stalls."""

from __future__ import annotations

import json
import re
import socket
import struct
import time

import cv2
import foxglove.messages
import numpy as np
import pyigtl
import pylsl
import pytest
from rosbags.typesys import Stores, get_typestore
from websockets.sync.client import connect

from benchmarks.sinks import HOST, address, body, camera, free_port, measurement
from measure.errors import ConfigError
from measure.host import EventMark, Registry, SentRun, Sink, plain_names
from measure.model import Image
from measure_studio.api.sending import SendOptions, open_sending, sent_pose
from tests.receiving import wait_for


def run_of(*names, reference=""):
    return SentRun("run", tuple(map(body, names)), (camera("cam0", 0.0),), reference)


def build(where, run, **settings):
    scheme, _, rest = where.partition(":")
    place = rest.removeprefix("//").partition("?")[0]
    return Registry.discover().build(Sink, scheme, settings, address=place, run=run)


def read(client, size):
    data = b""
    while len(data) < size:
        part = client.recv(size - len(data))
        assert part, "the connection was closed"
        data += part
    return data


def igtl_message(client):
    """Type, name and content of a message, by the protocol's own definition of its head."""
    _, kind, name, _, _, size, _ = struct.unpack(">H12s20sIIQQ", read(client, 58))
    return kind.rstrip(b"\0").decode(), name.rstrip(b"\0").decode(), read(client, size)


def test_igtl_names_are_those_of_plus_and_a_lost_body_is_a_status():
    where = address("igtl")
    sink = build(where, run_of("pointer tool", "table", reference="table"))
    sink.open()
    with socket.create_connection((HOST, int(where.rpartition(":")[2]))) as client:
        client.settimeout(5.0)
        sink.send(sent_pose(measurement(1, 0.1), "pointer tool"))
        sink.send(sent_pose(measurement(1, 0.1), "pointer tool", "table"))
        sink.send(sent_pose(measurement(49, 4.9), "pointer tool"))
        heard = [igtl_message(client) for _ in range(3)]
    sink.close()
    assert [one[:2] for one in heard] == [
        ("TRANSFORM", "PointerToolToTracker"),
        ("TRANSFORM", "PointerToolToTable"),
        ("STATUS", "PointerToolToTracker"),
    ]
    code, _, error = struct.unpack(">Hq20s", heard[2][2][:30])
    assert (code, error.rstrip(b"\0"), heard[2][2][30:]) == (4, b"lost", b"too few balls\0")
    assert np.array(struct.unpack(">12f", heard[0][2]))[9:] == pytest.approx(
        measurement(1, 0.1).pose.world_from_body.translation, rel=1e-6
    )


HOSTILE = [
    "Wörkpiece №1", "a/b #*?$ tool", "三つの球", "四つの球", "x" * 180, "x" * 181, "..", "ß",
    "raven three-ball body", "raven three-ball base", "tool-1", "tool_1",
]  # fmt: skip


def test_igtl_shortens_every_name_by_one_rule_and_tells_it():
    sink = build("igtl://127.0.0.1:18944", run_of(*HOSTILE, reference="raven three-ball base"))
    names = [line.rpartition(" is sent as ")[2] for line in sink.notes]
    assert len(set(names)) == len(names) == 2 * len(HOSTILE) - 1
    assert all(re.fullmatch("[A-Za-z0-9]{1,20}", name) for name in names)
    assert names[:4] == [
        "WorkpieceNoToTracker",
        "ABToolToTracker",
        "BodyToTracker",
        "Body2ToTracker",
    ]
    assert {"RavenThreeBToTracker", "RavenThree2ToTracker", "SsToTracker"} <= set(names)
    assert {"Tool1ToTracker", "Tool12ToTracker"} <= set(names)


def test_pyigtl_receives_every_body_by_the_name_that_is_told():
    """3D Slicer's names, units and stamps, whatever bodies are called."""
    where, run = address("igtl"), run_of(*HOSTILE)
    sink = build(where, run)
    told = dict(line.rsplit(" is sent as ", 1) for line in sink.notes)
    assert set(told) == set(HOSTILE)
    sink.open()
    client = pyigtl.OpenIGTLinkClient(HOST, int(where.rpartition(":")[2]))
    try:
        wait_for(client.is_connected)
        received = {}

        def is_complete():
            for k, name in enumerate(HOSTILE):
                sink.send(sent_pose(measurement(k, 0.1 * k + 1), name))
            time.sleep(0.05)
            received.update((one.device_name, one) for one in client.get_latest_messages())
            return len(received) == len(HOSTILE)

        wait_for(is_complete)
    finally:
        client.stop()
        sink.close()
    assert set(received) == set(told.values())
    for k, name in enumerate(HOSTILE):
        message, expected = received[told[name]], measurement(k, 0.1 * k + 1).pose
        np.testing.assert_allclose(message.matrix, expected.world_from_body.matrix, atol=1e-4)
        assert message.timestamp == pytest.approx(0.1 * k + 1, abs=1e-6)


def test_one_rule_names_bodies_wherever_names_are_restricted():
    words = plain_names([*HOSTILE, "pointer tool"])
    assert len(set(words.values())) == len(words)
    assert all(re.fullmatch("[A-Za-z][A-Za-z0-9_]{0,63}", word) for word in words.values())
    told = [words[name] for name in ("Wörkpiece №1", "a/b #*?$ tool", "三つの球", "四つの球", "..")]
    assert told == ["Workpiece_No1", "a_b_tool", "body", "body_2", "body_3"]
    assert (words["tool-1"], words["tool_1"], words["ß"]) == ("tool_1", "tool_1_2", "ss")
    assert words["pointer tool"] == "pointer_tool"


def test_an_address_that_is_none_says_what_is_expected():
    registry, run = Registry.discover(), run_of("tool")
    for given, words in (
        ("lsl", "--send lsl: expected lsl:NAME"),
        ("zenoh:", "--send zenoh:: expected zenoh:KEY"),
        ("udq://h:1", "no sink is called 'udq'; --send takes foxglove://HOST:PORT, "),
        ("udp://h:p", "expected HOST:PORT, such as 127.0.0.1:5005"),
    ):
        with pytest.raises(ConfigError, match=words):
            open_sending(SendOptions((given,), on_note=lambda _: None), registry, run)
    assert build("udp://", run)._place == (HOST, 5005)
    assert build("udp://127.0.0.2", run)._place == ("127.0.0.2", 5005)


@pytest.mark.parametrize(("given", "place"), [
    ("", (HOST, 18944)), ("10.0.0.1", ("10.0.0.1", 18944)), ("[::1]", ("::1", 18944)),
    ("10.0.0.1:7", ("10.0.0.1", 7)),
])  # fmt: skip
def test_a_server_has_a_usual_place(given, place):
    assert build(f"igtl://{given}", run_of("tool"))._place == place


def test_a_receiver_that_stops_reading_loses_its_own_poses_only():
    """It gets whole messages again once it reads on."""
    where = address("igtl")
    port, lines, frames = int(where.rpartition(":")[2]), [], 0
    sending = open_sending(
        SendOptions((where,), on_note=lines.append), Registry.discover(), run_of("t")
    )
    with sending:
        wait_for(lambda: _listens(port))
        with socket.socket() as slow, socket.create_connection((HOST, port)) as quick:
            slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
            slow.connect((HOST, port))
            quick.settimeout(5.0)
            while not any("does not keep up" in line for line in lines):
                assert frames < 200_000, "it was never told"
                poses = [sent_pose(measurement(1, frames / 100.0), "t") for _ in range(100)]
                sending.send(poses)
                for _ in poses:
                    assert igtl_message(quick)[:2] == ("TRANSFORM", "TToTracker")
                frames += 100
            # With so small a window the rest would come in kilobytes, five a second.
            slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
            slow.settimeout(1.0)
            got = []
            while (message := _message_or_none(slow)) is not None:
                got.append(message)
    assert 0 < len(got) < frames
    assert {one[:2] for one in got} == {("TRANSFORM", "TToTracker")}
    ((_, count),) = sending.counts.items()
    assert (count["sent"], count["lost"]) == (frames, frames - len(got))


def _listens(port):
    try:
        socket.create_connection((HOST, port)).close()
    except ConnectionRefusedError:
        return False
    return True


def _message_or_none(client):
    try:
        return igtl_message(client)
    except TimeoutError:
        return None


def test_a_port_that_is_taken_is_told_and_taken_when_it_is_free(monkeypatch):
    monkeypatch.setattr("measure_studio.api.sending.RETRY_S", 0.05)
    where, lines = address("igtl"), []
    port = int(where.rpartition(":")[2])
    sending = open_sending(
        SendOptions((where,), on_note=lines.append), Registry.discover(), run_of("t")
    )
    with socket.create_server((HOST, port)), sending:
        wait_for(lambda: any("already in use" in line for line in lines))
    with sending.__class__([(where, build(where, run_of("t")))], lines.append) as again:
        wait_for(lambda: _listens(port))
        again.send([sent_pose(measurement(1, 0.1), "t")])
        wait_for(lambda: again.counts[where]["sent"] == 1)
    (told,) = [line for line in lines if "already in use" in line]
    assert told.startswith(f"{where}: Address already in use")
    assert told.endswith("; its poses are lost until that is mended")


def test_lsl_streams_describe_themselves():
    name = f"triball-{free_port()}"
    sink = build(f"lsl:{name}", run_of("tool", "base", reference="base"))
    sink.open()
    try:
        (found,) = pylsl.resolve_byprop("name", name, timeout=20.0)
        inlet = pylsl.StreamInlet(found)
        info = inlet.info(20.0)
        labels, units = info.get_channel_labels(), info.get_channel_units()
        (marks,) = pylsl.resolve_byprop("name", f"{name}-marks", timeout=20.0)
        marked = pylsl.StreamInlet(marks)
        marked.open_stream(20.0)
        sink.send_mark(EventMark(3.0, time.time() - 1.5, "stimulus"))
        text, stamp_s = marked.pull_sample(timeout=20.0)
        assert text == ["stimulus"]
        assert pylsl.local_clock() - stamp_s == pytest.approx(1.5, abs=0.5)
    finally:
        sink.close()
    assert (info.type(), info.channel_count(), marks.type()) == ("MoCap", 30, "Markers")
    assert labels[:3] == ["tool_x_mm", "tool_y_mm", "tool_z_mm"]
    assert labels[20] == "tool_in_base_x_mm"
    assert labels[7:10] == ["tool_position_sd_mm", "tool_rotation_sd_deg", "tool_status"]
    assert units[:4] + units[7:9] == ["millimeters"] * 3 + ["none", "millimeters", "degrees"]


def test_foxglove_shows_transforms_and_small_pictures():
    where = address("foxglove")
    sink = build(where, run_of("tool"), picture_width_px=64)
    sink.open()
    pixels = np.zeros((90, 160, 3), np.uint8)
    pixels[:, 80:] = 200
    picture = {"cam0": Image("cam0", 0, 12.5, lambda: pixels)}
    heard = {}
    with connect(f"ws:{where.partition(':')[2]}", subprotocols=["foxglove.sdk.v1"]) as client:
        channels = {}
        while len(channels) < 4:
            told = client.recv(timeout=20.0)
            told = json.loads(told) if isinstance(told, str) else {}
            channels |= {one["id"]: one["topic"] for one in told.get("channels", ())}
        asked = [{"id": one, "channelId": one} for one in channels]
        client.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
        wait_for(lambda: all(one.has_sinks() for one in sink._topics.values()))
        sink.send_pictures(picture)
        sink.send_pictures(picture)  # it is not its turn
        sink.send(sent_pose(measurement(1, 0.1), "tool"))
        sink.send_mark(EventMark(1.0, 1.0, "stimulus"))
        while "/marks" not in heard:
            data = client.recv(timeout=20.0)
            if isinstance(data, bytes) and data[0] == 1:
                topic = channels[struct.unpack("<I", data[1:5])[0]]
                assert topic not in heard
                heard[topic] = data[13:]
    sink.close()
    jpeg = heard["/cam0/image"][heard["/cam0/image"].index(b"\xff\xd8") :]
    small = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert small.shape == (36, 64, 3)
    assert small[18, 8].max() < 20 < 180 < small[18, 56].min()
    place = measurement(1, 0.1).pose.world_from_body
    (x, y, z), (w, i, j, k) = place.translation / 1000, place.quat_wxyz
    assert (
        heard["/tf"]
        == foxglove.messages.FrameTransform(
            timestamp=foxglove.messages.Timestamp(0, 100_000_000),
            parent_frame_id="world",
            child_frame_id="tool",
            translation=foxglove.messages.Vector3(x=x, y=y, z=z),
            rotation=foxglove.messages.Quaternion(x=i, y=j, z=k, w=w),
        ).encode()
    )
    assert b"stimulus" in heard["/marks"]


def test_zenoh_messages_are_those_of_ros():
    """Both kinds, with the covariance in metres, read back by rosbags."""
    sink = build("zenoh:lab", run_of("tool 1"), connect="tcp/127.0.0.1:9")
    sent = {}

    class Kept:
        def declare_publisher(self, key, **_):
            self.key = key
            return type(
                "Publisher", (), {"put": staticmethod(lambda data: sent.update({key: data}))}
            )

    sink._session = Kept()
    sink.send(sent_pose(measurement(1, 0.1), "tool 1"))
    assert set(sent) == {"lab/tool_1/pose", "tf"}
    store, pose = get_typestore(Stores.ROS2_JAZZY), measurement(1, 0.1).pose
    kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
    told = store.deserialize_cdr(sent["lab/tool_1/pose"], kind)
    assert (told.header.frame_id, told.header.stamp.nanosec) == ("world", 100_000_000)
    scale = np.array([1e-3] * 3 + [1.0] * 3)
    np.testing.assert_allclose(
        told.pose.covariance.reshape(6, 6), pose.covariance * np.outer(scale, scale), rtol=1e-12
    )
    (moved,) = store.deserialize_cdr(sent["tf"], "tf2_msgs/msg/TFMessage").transforms
    assert (moved.header.frame_id, moved.child_frame_id) == ("world", "tool_1")
    assert moved.transform.translation.x == pytest.approx(
        pose.world_from_body.translation[0] / 1000, rel=1e-12
    )
