"""Live poses of served cameras: `python -m benchmarks.live SESSION [--seconds 60] [--sink udp]`.

The session's pictures are served, forth and back, as motion JPEG over HTTP on loopback, by a
process of its own, `--rate` a second and camera, stamped by the cameras' clock. `measure live`
measures and records them and sends to a viewer, which nobody watches, and to sinks, each with a
client in a process of its own. Printed are the frame sets measured and left out; how long after the
middle of its pictures' exposures, which is when they were sent, a pose was known and had arrived at
each client (from `--after` seconds on); and the cores that each process took, so that the servers'
share can be told apart; what showing takes, in a browser or a window, is in none.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.command import run_command
from benchmarks.sinks import address, receive
from benchmarks.trial import reference_s
from measure.session import open_session
from measure.viewing.viewer import open_viewer
from tests.camera_server import ServedCamera, serving

_JPEGS = 64  # Pictures of a camera that are held in memory


def _serve(folder: Path, rate_hz: float, told: Any) -> None:
    """A process that serves a session's cameras until it is asked for its CPU time."""
    with open_session(folder) as session:
        cameras = {
            name: ServedCamera(
                [stream.read(k).encoded or b"" for k in range(min(len(stream), _JPEGS))],
                1 / rate_hz,
                stamps=True,
            )
            for name, stream in session.streams.items()
        }
    with serving(cameras) as addresses:
        told.send(addresses)
        told.recv()
        told.send(time.process_time())


@contextmanager
def _viewing(wanted: bool) -> Iterator[tuple[list[str], list[float]]]:
    """The words that send to a viewer, and when it has ended the CPU time that it took."""
    spent = [0.0]
    if not wanted:
        yield [], spent
        return
    viewer = open_viewer([], web=True)
    try:
        yield ["--connect", viewer.listens], spent
    finally:
        viewer.process.terminate()
        usage = os.wait4(viewer.process.pid, 0)[2]
        spent[0] = usage.ru_utime + usage.ru_stime


def measured(folder: Path, addresses: dict[str, str], out: Path, words: Sequence[str]) -> Any:
    """What `measure live` says at its end, with the cores it took as `cores`."""
    command = [sys.executable, "-m", "measure", "live"]
    command += [f"{name}={where}" for name, where in addresses.items()]
    command += ["--calibration", str(folder / "calibration.toml")]
    command += ["--body", str(folder / "body.toml"), "-o", str(out / "run"), "--json"]
    command += ["--record", str(out / "recorded"), *words]
    begun_s = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.PIPE)
    assert process.stdout is not None
    text = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(process.returncode)
    cpu_s = usage.ru_utime + usage.ru_stime
    return json.loads(text) | {"cores": cpu_s / (time.monotonic() - begun_s)}


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(prog="benchmarks.live", description=__doc__)
    parser.add_argument("session", type=Path, help="a session of JPEG files")
    parser.add_argument("--seconds", type=float, default=60.0, help="how long it is measured")
    parser.add_argument("--after", type=float, default=10.0, help="begin of what counts, s")
    parser.add_argument("--rate", type=float, default=30.0, help="pictures a second and camera")
    parser.add_argument("--sink", nargs="*", default=["udp", "lsl"], help="schemes of sinks")
    parser.add_argument("--no-viewer", action="store_true", help="send to none")
    given = parser.parse_args()
    context = multiprocessing.get_context("spawn")
    ours, told = context.Pipe()
    context.Process(target=_serve, args=(given.session, given.rate, told), daemon=True).start()
    served = ours.recv()
    begun_s = time.monotonic()
    with tempfile.TemporaryDirectory() as scratch, _viewing(not given.no_viewer) as (more, viewed):
        more += ["--seconds", f"{given.seconds:g}"]
        with _receiving(given.sink) as (words, received):
            end = measured(given.session, served, Path(scratch), [*words, *more])
    ours.send(None)
    whole_s = time.monotonic() - begun_s
    picture = cv2.imread(str(next((given.session).glob("*/*.jpg"))))
    print(f"one cv2.cvtColor takes {1e3 * reference_s(np.asarray(picture)):.2f} ms now")
    print(
        f"{end['frame_sets']} frame sets, {end['overtaken']} left out, {end['ok']} poses believed, "
        f"{end['flagged']} flagged"
    )
    for name, some in zip(given.sink, received, strict=True):
        print(f"{name:10}{_delays(some, given.after)}")
    print(
        f"cores: measure live {end['cores']:.2f}, with its start; server "
        f"{ours.recv() / whole_s:.2f}; viewer {viewed[0] / whole_s:.2f}"
    )


@contextmanager
def _receiving(sinks: Sequence[str]) -> Iterator[tuple[list[str], list[Any]]]:
    """The words that send to clients of sinks, and when it has ended what each received."""
    context, received = multiprocessing.get_context("spawn"), list[Any]()
    over, words, outs = context.Event(), list[str](), list[Any]()
    for one in map(address, sinks):
        ready, out = context.Event(), context.Queue()
        context.Process(target=receive, args=(one, over, ready, out), daemon=True).start()
        ready.wait(60.0)
        words += ["--send", one]
        outs.append(out)
    yield words, received
    over.set()
    received += [out.get(timeout=60.0) for out in outs]


def _delays(received: Sequence[Any], after_s: float) -> str:
    """How late poses arrived that were exposed later than so long after the first."""
    exposed_s = np.array([one.exposed_s for one in received])
    late_ms = 1e3 * (np.array([one.arrived_s for one in received]) - exposed_s)
    late_ms = late_ms[exposed_s > exposed_s[0] + after_s]
    p50, p99, most = np.percentile(late_ms, (50, 99, 100))
    counted = f"{len(received)} received, {len(late_ms)} counted"
    return f"{counted}: median {p50:.1f} ms, 99 % {p99:.1f} ms, most {most:.1f} ms"


if __name__ == "__main__":
    run_command(main)
