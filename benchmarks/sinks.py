"""Poses played into sinks: `python -m benchmarks.sinks [SINK...] [--poses 10000] [--rate 100]`.

A run is written whose poses come `--rate` times a second, and played into every sink at once. Each
sink has a client of its own protocol, in a process of its own, that notes when every pose arrived
and what it said. Printed are the poses received, the largest difference from `poses.csv`, and how
long after their turn they arrived. With `--stall 10` one more client of every sink that has several
stops reading for so many seconds in the middle: the others must not notice.
"""

from __future__ import annotations

import argparse
import csv
import json
import multiprocessing
import os
import random
import socket
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np

from measure.geometry import RigidTransform
from measure.host import Registry
from measure.measuring import Measurement, Status
from measure.model import Ball, BallColor, Body, Camera, Intrinsics, Pose
from measure.results import Provenance, RunWriter
from measure_studio import api as studio_api

HOST = "127.0.0.1"
# Streams of LSL are looked for on this machine only.
os.environ.setdefault("LSLAPICFG", str(Path(__file__).with_name("lslapi.cfg")))
Over = Callable[[], bool]


@dataclass(frozen=True)
class Received:
    """What a client received: a pose, or that there is none."""

    stream: tuple[str, str]  # body and reference, as far as the protocol says them
    exposed_s: float  # in seconds since 1970
    arrived_s: float
    place: tuple[float, ...] | None  # x y z in mm, quaternion w x y z


def body(name: str) -> Body:
    """Three balls."""
    places = {"green": (38.0, 0.0, 0.0), "yellow": (0.0, 38.0, 0.0), "red": (-38.0, 0.0, 0.0)}
    balls = (Ball(n, BallColor.named(n), np.array(p), 20.0) for n, p in places.items())
    return Body(name, tuple(balls))


def camera(name: str, x_mm: float) -> Camera:
    """One that looks along the world's z axis."""
    matrix = np.array([[1400.0, 0, 639.5], [0, 1400.0, 359.5], [0, 0, 1]])
    place = RigidTransform.from_rotvec([0.0, 0.0, 0.0], [x_mm, 0.0, 0.0])
    return Camera(name, Intrinsics((1280, 720), matrix), place)


def measurement(index: int, time_s: float, aside_mm: float = 0.0) -> Measurement:
    """A pose on a smooth path; every tenth is flagged, every fiftieth lost."""
    if index % 50 == 49:
        return Measurement(index, time_s, {}, (), (), None, Status.LOST, ("too few balls",))
    turn = [0.3 * np.sin(time_s), 0.2 * np.cos(2 * time_s), 0.5 * time_s]
    shift = [aside_mm + 30 * np.sin(2 * time_s), 20 * np.cos(time_s), 250 + 9 * np.sin(3 * time_s)]
    flags = ("the balls are far apart",) if index % 10 == 9 else ()
    root = np.diag([0.02, 0.03, 0.05, 1e-4, 2e-4, 1e-4])
    root[0, 4] = 1e-5
    place = RigidTransform.from_rotvec(turn, shift)
    pose = Pose(time_s, place, root @ root.T, 0.1, 0.2, ("cam0",), ("green",), flags)
    status = Status.FLAGGED if flags else Status.OK
    return Measurement(index, time_s, {}, (), (), pose, status)


def write_run(folder: Path, frame_sets: int, rate_hz: float, several: bool = False) -> Path:
    """A run of so many frame sets of one body, or of two, one relative to the other."""
    made_from = Provenance("", "", "", "", "", {"name": "none", "settings": {}}, {})
    bodies = [body("tool"), body("base")] if several else [body("tool")]
    reference = "base" if several else ""
    cameras = [camera("cam0", -200.0), camera("cam1", 200.0)]
    with RunWriter(folder, made_from, bodies, cameras, reference=reference) as writer:
        for k in range(frame_sets):
            asides = (0.0, 90.0)[: len(bodies)]
            writer.append(*(measurement(k, 10.0 + k / rate_hz, aside) for aside in asides))
        writer.finish()
    return folder


def stored(run: Path) -> dict[tuple[str, str], list[tuple[float, ...] | None]]:
    """The poses of `poses.csv` and `relative.csv`, by body and reference; None where lost."""
    out: dict[tuple[str, str], list[tuple[float, ...] | None]] = {}
    names = ("x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz")
    for table in (run / "poses.csv", run / "relative.csv"):
        rows = csv.DictReader(table.read_text("utf-8").splitlines()) if table.exists() else ()
        for row in rows:
            key = row.get("body", "tool"), row.get("reference", "")
            place = tuple(float(row[name]) for name in names) if row["x_mm"] else None
            out.setdefault(key, []).append(place)
    return out


def free_port(kind: int = socket.SOCK_STREAM) -> int:
    """A port that nothing listens on, and that is given to no connection meanwhile."""
    while True:
        port = random.randrange(20_000, 32_000)
        with suppress(OSError), socket.socket(socket.AF_INET, kind) as one:
            one.bind((HOST, port))
            return port


def receive_udp(address: str, over: Over) -> Iterator[Received]:
    """JSON by UDP."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind((HOST, int(address.rpartition(":")[2])))
        receiver.settimeout(0.1)
        while not over():
            try:
                row = json.loads(receiver.recv(65_536))
            except TimeoutError:
                continue
            arrived_s = time.time()
            if "mark" not in row:
                yield from _row(row, row.get("body", "tool"), arrived_s)


def receive_igtl(address: str, over: Over) -> Iterator[Received]:
    """OpenIGTLink by pyigtl's client; it looks for messages, so arrivals are noted at once."""
    from pyigtl import OpenIGTLinkClient
    from pyigtl.messages import MessageBase, message_type_to_class_constructor

    message_type_to_class_constructor["STATUS"] = MessageBase
    client = OpenIGTLinkClient(HOST, int(address.rpartition(":")[2]), start_now=False)
    arrived: SimpleQueue[tuple[float, Any]] = SimpleQueue()
    # The client keeps one message of each name; every one counts here.
    client.incoming_messages = _Arrivals(arrived)
    client.start()
    try:
        while not over():
            try:
                arrived_s, message = arrived.get(timeout=0.1)
            except Empty:
                continue
            name, reference = message.device_name.lower().rsplit("to", 1)
            matrix = getattr(message, "matrix", None)
            place = None if matrix is None else place_of(RigidTransform.from_matrix(matrix))
            stream = name, "" if reference == "tracker" else reference
            yield Received(stream, message.timestamp, arrived_s, place)
    finally:
        client.stop()


class _Arrivals(dict[str, Any]):
    """Passes on every message that is kept in it."""

    def __init__(self, arrived: SimpleQueue[tuple[float, Any]]) -> None:
        self._arrived = arrived

    def __setitem__(self, name: str, message: Any) -> None:
        self._arrived.put((time.time(), message))


def receive_lsl(address: str, over: Over) -> Iterator[Received]:
    """LSL by pylsl's inlet."""
    import pylsl

    inlet = None
    while inlet is None and not over():
        for info in pylsl.resolve_byprop("name", address.partition(":")[2], timeout=1.0):
            inlet = pylsl.StreamInlet(info)
            inlet.open_stream()
    # An interruption between the two readings makes the difference too small.
    began_s = max(time.time() - pylsl.local_clock() for _ in range(10))
    while inlet is not None and not over():
        labels = inlet.info().get_channel_labels() or []
        sample, stamp = inlet.pull_sample(timeout=0.1)
        if sample is None:
            continue
        exposed_s, arrived_s = began_s + stamp, time.time()
        for at in range(0, len(sample), 10):
            name, _, reference = labels[at].removesuffix("_x_mm").partition("_in_")
            place = tuple(sample[at : at + 7]) if sample[at + 9] < 2 else None
            yield Received((name, reference), exposed_s, arrived_s, place)


def receive_foxglove(address: str, over: Over) -> Iterator[Received]:
    """JSON topics of Foxglove's WebSocket protocol, by a plain WebSocket."""
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect
    from websockets.typing import Subprotocol

    uri = f"ws:{address.partition(':')[2]}"
    while not over():
        try:
            with connect(uri, subprotocols=[Subprotocol("foxglove.sdk.v1")]) as server:
                yield from _foxglove_rows(server, over)
        except (OSError, ConnectionClosed):
            time.sleep(0.02)


def _foxglove_rows(server: Any, over: Over) -> Iterator[Received]:
    while not over():
        try:
            message = server.recv(timeout=0.1)
        except TimeoutError:
            continue
        arrived_s = time.time()
        if isinstance(message, str):
            told = json.loads(message)
            wanted = [one["id"] for one in told.get("channels", ()) if one["encoding"] == "json"]
            asked = [{"id": one, "channelId": one} for one in wanted]
            server.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
        elif message[0] == 1:
            row = json.loads(message[13:])
            yield from _row(row, row["body"], arrived_s)


def _row(row: dict[str, Any], body: str, arrived_s: float) -> Iterator[Received]:
    """A pose as JSON."""
    names = ("x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz")
    place = None if row["x_mm"] is None else tuple(row[name] for name in names)
    yield Received((body, row.get("reference", "")), row["exposed_s"], arrived_s, place)


def receive_zenoh(address: str, over: Over) -> Iterator[Received]:
    """Poses by Zenoh, read by rosbags; it listens where the sink is told to connect."""
    import zenoh
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    key, _, connect = address.partition(":")[2].partition("?connect=")
    config = zenoh.Config()
    config.insert_json5("listen/endpoints", f'["{connect}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    arrived: SimpleQueue[tuple[float, Any]] = SimpleQueue()
    with zenoh.open(config) as session:
        session.declare_subscriber(f"{key}/*/pose", lambda one: arrived.put((time.time(), one)))
        while not over():
            try:
                arrived_s, sample = arrived.get(timeout=0.1)
            except Empty:
                continue
            kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
            told: Any = store.deserialize_cdr(sample.payload.to_bytes(), kind)
            body, _, reference = str(sample.key_expr).split("/")[1].partition("_in_")
            at, turn = told.pose.pose.position, told.pose.pose.orientation
            place = (1e3 * at.x, 1e3 * at.y, 1e3 * at.z, turn.w, turn.x, turn.y, turn.z)
            stamp = told.header.stamp
            yield Received((body, reference), stamp.sec + 1e-9 * stamp.nanosec, arrived_s, place)


def place_of(pose: RigidTransform) -> tuple[float, ...]:
    """X y z in mm and the quaternion w x y z."""
    return (*pose.translation.tolist(), *pose.quat_wxyz.tolist())


CLIENTS: dict[str, Callable[[str, Over], Iterator[Received]]] = {
    "udp": receive_udp,
    "igtl": receive_igtl,
    "lsl": receive_lsl,
    "foxglove": receive_foxglove,
    "zenoh": receive_zenoh,
}
"""By scheme, what receives from an address that `address` makes."""


def address(scheme: str) -> str:
    """An address of `--send` that nobody uses."""
    if scheme == "lsl":
        return f"lsl:triball-{free_port()}"
    if scheme == "zenoh":
        return f"zenoh:triball?connect=tcp/{HOST}:{free_port()}"
    kind = socket.SOCK_DGRAM if scheme == "udp" else socket.SOCK_STREAM
    return f"{scheme}://{HOST}:{free_port(kind)}"


def receive(address: str, over: Any, ready: Any, out: Any) -> None:
    """A process that receives, and hands on what it got."""
    scheme = address.partition(":")[0]
    ready.set()
    out.put([*CLIENTS[scheme](address, over.is_set)])


def _stall(address: str, begin_s: float, seconds: float, over: Any) -> None:
    """A client of a server that reads, stops reading for a while, and reads again."""
    host, _, port = address.rpartition("://")[2].partition(":")
    with suppress(OSError):
        while not over.is_set():
            with (
                suppress(ConnectionRefusedError),
                socket.create_connection((host, int(port))) as one,
            ):
                until_s = time.monotonic() + begin_s
                while not over.is_set() and one.recv(65_536):
                    if time.monotonic() > until_s:
                        time.sleep(seconds)
                        until_s = float("inf")
            time.sleep(0.05)


def rows(schemes: Sequence[str], poses: int, rate_hz: float, stall_s: float) -> Iterator[list[str]]:
    """A row for each sink: received, largest difference, and delays in ms."""
    context = multiprocessing.get_context("spawn")
    over, results = context.Event(), []
    with tempfile.TemporaryDirectory() as scratch:
        run = write_run(Path(scratch) / "run", poses, rate_hz)
        addresses = [address(scheme) for scheme in schemes]
        for one in addresses:
            ready, out = context.Event(), context.Queue()
            context.Process(target=receive, args=(one, over, ready, out), daemon=True).start()
            results.append(out)
            ready.wait(60.0)
        if stall_s and "igtl" in schemes:
            where = addresses[schemes.index("igtl")]
            begin_s = poses / rate_hz / 2
            args = (where, begin_s, stall_s, over)
            context.Process(target=_stall, args=args, daemon=True).start()
        options = studio_api.PlayOptions(send=tuple(addresses), wait_s=5.0)
        end = studio_api.play(run, Registry.discover(), options)
        time.sleep(2.0)
        over.set()
        (places,) = stored(run).values()
        for scheme, out in zip(schemes, results, strict=True):
            yield _row_of(scheme, out.get(timeout=60.0), places)
        print(f"play itself was {1e3 * end.late_s:.1f} ms late at most")


def _row_of(
    scheme: str, received: Sequence[Received], places: Sequence[tuple[float, ...] | None]
) -> list[str]:
    wanted = [place for place in places if place is not None]
    got = [one for one in received if one.place is not None]
    same = min(len(got), len(wanted))
    off = np.abs(np.array([one.place for one in got[:same]]) - np.array(wanted[:same]))
    late_ms = 1e3 * np.array([one.arrived_s - one.exposed_s for one in got])
    p50, p99, most = (float(np.percentile(late_ms, q)) for q in (50, 99, 100))
    share = float(np.mean(late_ms < 5.0))
    numbers = f"{off.max():.1e}", f"{p50:.2f}", f"{p99:.2f}", f"{most:.1f}", f"{100 * share:.2f}"
    return [scheme, f"{len(got)} of {len(wanted)}", *numbers]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sinks", nargs="*", default=[*CLIENTS])
    parser.add_argument("--poses", type=int, default=10_000)
    parser.add_argument("--rate", type=float, default=100.0)
    parser.add_argument("--stall", type=float, default=0.0)
    given = parser.parse_args()
    head = ["sink", "poses received", "largest difference", "median ms", "99 % ms", "most ms"]
    print(" | ".join([*head, "% within 5 ms"]))
    for row in rows(given.sinks, given.poses, given.rate, given.stall):
        print(" | ".join(row))


if __name__ == "__main__":
    main()
