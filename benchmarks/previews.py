"""What previews cost: `python -m benchmarks.previews [--seconds 20] [--rate 10]`.

Rendered pictures of four cameras are served as motion JPEG by a process of their own, and measured
live. In the second half of the time sixteen previews a second are drawn beside it, four of each
camera, as the set-up page draws them. Printed are the CPU time of their thread as a share of one
core, decoding included where no measurement had decoded a picture, and the rate of the measurement
in both halves.
"""

from __future__ import annotations

import argparse
import multiprocessing
import threading
import time
from multiprocessing.connection import Connection
from pathlib import Path

from measure import api
from measure_studio import api as studio_api
from tests.camera_server import ServedCamera, serving
from tests.simulated.sessions import still_session

CAMERAS, A_SECOND, WIDTH_PX = 4, 16, 480


def serve(session: Path, rate_hz: float, told: Connection) -> None:
    """Serve a session's pictures until the other end says so."""
    served = {}
    for number in range(CAMERAS):
        files = sorted((session / f"cam{number}").glob("*.jpg"))
        pictures = [file.read_bytes() for file in files]
        served[f"cam{number}"] = ServedCamera(pictures, 1 / rate_hz, stamps=True)
    with serving(served) as addresses:
        told.send(addresses)
        told.recv()


def draw(
    preview: studio_api.Preview, begins_s: float, stop: threading.Event, cpu_s: list[float]
) -> None:
    """Draw previews from a time on, and note what each cost."""
    due_s = begins_s
    while not stop.wait(max(due_s - time.monotonic(), 0.0)):
        for number in range(CAMERAS):
            begun_s = time.thread_time()
            preview.shown(f"cam{number}", WIDTH_PX)
            cpu_s.append(time.thread_time() - begun_s)
        due_s += CAMERAS / A_SECOND


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--rate", type=float, default=10.0)
    given = parser.parse_args()
    ours, theirs = multiprocessing.Pipe()
    session = still_session()
    server = multiprocessing.Process(target=serve, args=(session, given.rate, theirs))
    server.start()
    measure(session, ours.recv(), given.seconds)
    ours.send("over")
    server.join()


def measure(session: Path, addresses: dict[str, str], seconds: float) -> None:
    """Measure live, first without previews and then with them."""
    preview, stop, drawing = studio_api.Preview(), threading.Event(), threading.Event()
    begun: list[float] = []
    cpu_s: list[float] = []
    sets = [0, 0]

    def hear(_: studio_api.LiveState) -> None:
        if not begun:
            begun.append(time.monotonic())
            args = preview, begun[0] + seconds / 2, drawing, cpu_s
            threading.Thread(target=draw, args=args, daemon=True).start()
        ran_s = time.monotonic() - begun[0]
        if ran_s >= seconds:
            stop.set()
        else:
            sets[ran_s >= seconds / 2] += 1

    options = studio_api.LiveOptions(stop=stop, on_image=preview.add)
    cameras = studio_api.parse_cameras([f"{name}={address}" for name, address in addresses.items()])
    bodies = [session / "body.toml"]
    profile, registry = api.load_profile(), api.Registry.discover()
    out = session.parent / "run"
    studio_api.live(
        cameras, out, session / "calibration.toml", bodies, profile, registry, options, hear
    )
    drawing.set()
    half_s = seconds / 2
    print(f"{len(cpu_s) / half_s:.1f} previews a second: {sum(cpu_s) / half_s:.3f} of one core")
    print(f"{1e3 * sum(cpu_s) / len(cpu_s):.1f} ms each")
    print(f"frame sets a second without {sets[0] / half_s:.2f}, with {sets[1] / half_s:.2f}")


if __name__ == "__main__":
    main()
