"""A live soak: `python -m benchmarks.faults soak --count SECONDS`.

`measure live` measures four cameras that deliver a rendered session at 15 pictures a second, while
each has, every few seconds, a fault drawn at random. Its poses are compared with the exact truth,
what it says of outages with when they began, and its memory is watched.
"""

from __future__ import annotations

import json
import os
import random
import re
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from benchmarks.faults.cameras import FAULTS
from benchmarks.faults.hostile_camera import LOGIN, TOKEN, Fault, HostileCamera, hostile
from measure.session import read_trajectory
from tests.simulated.sessions import STILL_HZ, STILL_SETS, still_session

NAMES = tuple(f"cam{k}" for k in range(4))
PERIOD_S = 1 / 15
TOLD_S = 1.0
"""Latest time at which an outage may be told, after the third missing picture was due."""
CLOCK_S = 5e-3
"""How well the time of a pose is known: a camera's clock is tied to ours by arriving pictures."""
WRONG_SD, WRONG_MM = 5.0, 0.5
"""A believed pose is wrong if it is off by more than both."""
WARM_S = 60.0
"""Memory is watched by the least of so long a time, from the third such time on."""
_LINE = re.compile(r"(cam\d) is (away|back)\b")


@dataclass
class Trial:
    """A fault of a camera, and what was said of it."""

    camera: str
    fault: Fault
    begun_s: float
    last_good_s: float
    ended_s: float = float("nan")
    away_s: list[float] = field(default_factory=list)
    back_s: list[float] = field(default_factory=list)

    @property
    def told_after_s(self) -> float:
        """From the third missing picture on; NaN if it was not told."""
        due_s = self.last_good_s + 3 * PERIOD_S
        return self.away_s[0] - due_s if self.away_s else float("nan")

    def verdict(self) -> str:
        """Whether it was told as it should be."""
        if self.fault.silences is False:
            return "silent" if not self.away_s else "told though pictures came"
        if self.fault.silences is None and not self.away_s:
            return "silent"
        if not self.away_s:
            return "NOT TOLD"
        if len(self.away_s) > 1:
            return f"TOLD {len(self.away_s)} TIMES"
        if self.told_after_s > TOLD_S and self.fault.silences:
            return "TOLD LATE"
        return "told" if len(self.back_s) == 1 else "NEVER BACK"


class Watcher:
    """What `measure live` says: lines on stderr, poses by UDP, and its memory."""

    def __init__(self, process: subprocess.Popen[str], poses: socket.socket) -> None:
        self.process, self._poses = process, poses
        self.lines: list[tuple[float, str]] = []
        self.poses: list[dict[str, Any]] = []
        self.memory_mb: list[tuple[float, float]] = []
        self.trials: dict[str, Trial] = {}
        self.needless: list[str] = []
        self.threads = [
            threading.Thread(target=one, daemon=True)
            for one in (self._read_lines, self._read_poses, self._read_memory)
        ]
        for thread in self.threads:
            thread.start()

    def _read_lines(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            now = time.time()
            self.lines.append((now, line.rstrip()))
            found = _LINE.match(line)
            if found is None:
                continue
            name, what = found.groups()
            trial = self.trials.get(name)
            if trial is None:
                self.needless.append(line.rstrip())
            else:
                (trial.away_s if what == "away" else trial.back_s).append(now)

    def _read_poses(self) -> None:
        while self.process.poll() is None:
            try:
                self.poses.append(json.loads(self._poses.recv(65_536)))
            except TimeoutError:
                continue

    def _read_memory(self) -> None:
        begun = time.time()
        while self.process.poll() is None:
            text = Path(f"/proc/{self.process.pid}/status").read_text("utf-8")
            resident = re.search(r"VmRSS:\s+(\d+)", text)
            if resident is not None:
                self.memory_mb.append((time.time() - begun, int(resident[1]) / 1024))
            time.sleep(1.0)

    def wait_for(self, text: str, seconds: float) -> None:
        """Wait until a line says so."""
        until = time.time() + seconds
        while not any(text in line for _, line in self.lines):
            if time.time() > until or self.process.poll() is not None:
                raise AssertionError(f"'{text}' was never said: {self.lines[-3:]}")
            time.sleep(0.1)


def plague(
    camera: HostileCamera,
    name: str,
    watcher: Watcher,
    draw: random.Random,
    until_s: float,
    done: list[Trial],
) -> None:
    """Give a camera one fault after the other, each after it has been well for a while."""
    while True:
        time.sleep(draw.uniform(6.0, 20.0))
        if time.time() > until_s - 30.0 or watcher.process.poll() is not None:
            return
        fault = draw.choice(FAULTS)
        trial = watcher.trials[name] = Trial(name, fault, time.time(), camera.good_s)
        camera.fault = fault
        if fault.silences:
            time.sleep(2 * PERIOD_S)
            trial.last_good_s = camera.good_s
        time.sleep(draw.uniform(2.0, 8.0))
        camera.fault = None
        trial.ended_s = time.time()
        while time.time() - trial.ended_s < 40.0 and len(trial.back_s) < len(trial.away_s):
            time.sleep(0.1)
        time.sleep(3.0)  # what is said of it later is said once too often
        done.append(trial)
        del watcher.trials[name]


def soak(
    seconds: float, seed: int, session: Path, folder: Path
) -> tuple[Watcher, list[Trial], list[HostileCamera]]:
    """Let it run."""
    draw = random.Random(seed)
    pictures = [[f.read_bytes() for f in sorted((session / n).glob("*.jpg"))] for n in NAMES]
    begun_s = time.time()
    cameras = [
        HostileCamera(mine, pictures[k - 1], PERIOD_S, begun_s) for k, mine in enumerate(pictures)
    ]
    done: list[Trial] = []
    with ExitStack() as stack:
        addresses = stack.enter_context(hostile(cameras))
        receiver = stack.enter_context(closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)))
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(0.5)
        words = ["live", *(f"{n}={a}" for n, a in zip(NAMES, addresses, strict=True))]
        words += ["-o", str(folder / "run"), "--calibration", str(session / "calibration.toml")]
        words += ["--body", str(session / "body.toml"), "--no-recording", "--images", "none"]
        words += ["--send", f"udp://127.0.0.1:{receiver.getsockname()[1]}"]
        printed = stack.enter_context((folder / "printed.txt").open("w"))
        process = stack.enter_context(_command([*words, "--seconds", str(seconds)], printed))
        stack.callback(process.kill)
        watcher = Watcher(process, receiver)
        watcher.wait_for("known after", 120.0)
        until_s = time.time() + seconds
        threads = [
            threading.Thread(
                target=plague,
                args=(cameras[k], name, watcher, random.Random(draw.random()), until_s, done),
            )
            for k, name in enumerate(NAMES)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        process.wait(60.0)
        for thread in watcher.threads:
            thread.join(5.0)
    return watcher, done, cameras


def _command(words: list[str], printed: TextIO) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "measure", *words],
        stdout=printed,
        stderr=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[2],
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )


def errors(watcher: Watcher, camera: HostileCamera, session: Path) -> np.ndarray:
    """Distance (mm) and standard deviations (n, 2) of believed poses from the truth."""
    truth = read_trajectory(session / "truth.csv")
    places = truth.at(np.arange(STILL_SETS) / STILL_HZ).translation[camera.order()]
    out = []
    for pose in watcher.poses:
        if pose["status"] != "ok":
            continue
        turns = (pose["time_s"] + np.linspace(-CLOCK_S, CLOCK_S, 21) - camera.begun_s) / PERIOD_S
        k = np.floor(turns).astype(int)
        part = (turns - k)[:, None]
        there = (1 - part) * places[k % len(places)] + part * places[(k + 1) % len(places)]
        off = np.array([pose["x_mm"], pose["y_mm"], pose["z_mm"]]) - there
        best = np.argmin(np.linalg.norm(off, axis=1))
        shape = np.reshape(pose["covariance"], (6, 6))[:3, :3]
        sd = np.sqrt(off[best] @ np.linalg.solve(shape, off[best]))
        out.append((np.linalg.norm(off[best]), sd, pose["time_s"]))
    return np.array(out).reshape(-1, 3)


def growth_mb(memory_mb: list[tuple[float, float]]) -> float:
    """By how much the least memory of a minute grew after the first two."""
    least: dict[int, float] = {}
    for at_s, size in memory_mb:
        minute = int(at_s // WARM_S)
        least[minute] = min(size, least.get(minute, size))
    later = [size for minute, size in sorted(least.items()) if minute >= 2]
    return max(later) - later[0] if later else float("nan")


def rows(count: int, seed: int) -> list[tuple[str, str]]:
    """Soak for `count` seconds; what was tried, and what came out."""
    session = still_session()
    with tempfile.TemporaryDirectory() as folder:
        watcher, trials, cameras = soak(count, seed, session, Path(folder))
        said = "\n".join(line for _, line in watcher.lines)
        (Path(folder) / "said.txt").write_text(said)
        secrets = [LOGIN.partition(":")[2].encode(), TOKEN.encode()]
        kept = [path for path in Path(folder).rglob("*") if path.is_file()]
        leaks = [path.name for path in kept if any(w in path.read_bytes() for w in secrets)]
        leaks += [one for camera in cameras for one in camera.leaked]
    off = errors(watcher, cameras[0], session)
    by_fault = {fault.name: [t for t in trials if t.fault is fault] for fault in FAULTS}
    out = [
        (f"{name} ({len(some)} times)", _judged(some)) for name, some in by_fault.items() if some
    ]
    statuses = Counter(str(pose["status"]) for pose in watcher.poses)
    told = [t.told_after_s for t in trials if t.fault.silences and t.away_s]
    out += [
        ("exit code", str(watcher.process.returncode)),
        ("poses", ", ".join(f"{n} {s}" for s, n in statuses.items())),
        (f"believed poses off by more than {WRONG_MM:g} mm and {WRONG_SD:g} SD", _accuracy(off)),
        (
            "outages told after the third missing picture",
            f"{len(told)}, after {np.median(told):.2f} s, at most {max(told):.2f} s"
            if told
            else "none",
        ),
        ("outages told where there was none", "; ".join(watcher.needless) or "none"),
        ("memory", f"grew by {growth_mb(watcher.memory_mb):.1f} MB after the first two minutes"),
        ("passwords seen", ", ".join(leaks) or "none"),
    ]
    return out


def _accuracy(off: np.ndarray) -> str:
    far, unlikely = off[:, 0] > WRONG_MM, off[:, 1] > WRONG_SD
    rms = np.sqrt(np.mean(off[:, 0] ** 2)) if len(off) else np.nan
    return (
        f"{np.sum(far & unlikely)} of {len(off)} (by the first: {np.sum(far)}, by the second: "
        f"{np.sum(unlikely)}); RMS {rms:.3f} mm, at most {off[:, 0].max(initial=0):.3f} mm and "
        f"{off[:, 1].max(initial=0):.1f} SD"
    )


def _judged(trials: list[Trial]) -> str:
    counts = Counter(trial.verdict() for trial in trials)
    return ", ".join(f"{n} {verdict}" for verdict, n in counts.items())
