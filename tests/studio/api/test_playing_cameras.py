"""Sessions played as web cameras, by command line and in one call."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
import threading
from contextlib import closing, contextmanager
from itertools import islice

import cv2
import numpy as np
import pytest

from measure.cli import main
from measure.errors import CaptureError, ConfigError
from measure.session import dump_toml
from measure_studio import api as studio_api
from measure_studio.api import PlayOptions, play_cameras
from measure_studio.capture.mjpeg import HttpSource
from tests.receiving import wait_for
from tests.session import videos

TIMES_S = {"cam 0": [10.0, 10.05, 10.1, 10.2], "käm#1": [10.02, 10.07, 10.12, 10.22]}


@pytest.fixture
def session(tmp_path):
    """Pictures of which each is another one, at uneven times; a JPEG has what no encoder writes."""
    folder, tables = tmp_path / "session", []
    for number, (name, times_s) in enumerate(TIMES_S.items()):
        (folder / f"c{number}").mkdir(parents=True)
        for k, _ in enumerate(times_s):
            plain = np.full((48, 64, 3), (20 + 40 * k, 90, 60 * number), np.uint8)
            data = cv2.imencode(".jpg", plain)[1].tobytes()
            (folder / f"c{number}" / f"{k}.jpg").write_bytes(
                data[:2] + b"\xff\xfe\0\4hi" + data[2:]
            )
        rows = "".join(f"{k},{time_s}\n" for k, time_s in enumerate(times_s))
        (folder / f"c{number}.csv").write_text("frame,time_s\n" + rows)
        files = {"images": f"c{number}/*.jpg", "timestamps": f"c{number}.csv"}
        tables.append({"name": name, **files})
    text = dump_toml({"session": {"name": "played"}, "cameras": tables})
    (folder / "session.toml").write_text(text, encoding="utf-8")
    return folder


@contextmanager
def playing(session, **options):
    """Plays it in a thread; yields cameras by name, and what came of it."""
    told, over, heard, sent = [], threading.Event(), threading.Event(), []

    def tell(line):
        told.append(line)
        heard.set()

    chosen = PlayOptions(**{"wait_s": 0.3} | options)
    thread = threading.Thread(
        target=lambda: sent.append(play_cameras(session, chosen, 0, tell, over))
    )
    thread.start()
    try:
        assert heard.wait(30)
        yield (
            {one.name: one.address for one in studio_api.parse_cameras(shlex.split(told[0]))},
            sent,
        )
    finally:
        over.set()
        thread.join(30)


def read(address, count=None):
    """The pictures that come; all until the stream ends, or so many."""
    with closing(HttpSource(address).shots()) as shots:
        return list(islice(shots, count))


@pytest.mark.parametrize("rate", [1.0, 4.0])
def test_every_byte_comes_at_its_own_stamp(session, rate):
    with playing(session, rate=rate) as (cameras, _):
        assert cameras.keys() == TIMES_S.keys()
        seen = {}
        readers = [
            threading.Thread(target=lambda name=name: seen.update({name: read(cameras[name])}))
            for name in cameras
        ]
        for one in readers:
            one.start()
        for one in readers:
            one.join(30)
    for number, (name, times_s) in enumerate(TIMES_S.items()):
        files = sorted((session / f"c{number}").iterdir())
        assert [shot.jpeg for shot in seen[name]] == [file.read_bytes() for file in files]
        stamps = [shot.device_s for shot in seen[name]]
        steps = np.diff(times_s) / rate
        np.testing.assert_allclose(np.diff(stamps), steps, atol=1e-8)
    # Both cameras keep one clock, as in the session.
    apart_s = seen["käm#1"][0].device_s - seen["cam 0"][0].device_s
    assert apart_s == pytest.approx(0.02 / rate, abs=1e-8)


def test_it_waits_for_a_reader_and_ends_with_the_session(session):
    with playing(session, rate=4.0) as (cameras, sent):
        assert not sent
        assert len(read(cameras["cam 0"])) == 4
        wait_for(lambda: sent)
        assert sent == [{"cam 0": 4, "käm#1": 0}]


def test_a_loop_begins_again_and_its_clock_goes_on(session):
    with playing(session, loop=True, rate=4.0) as (cameras, _):
        shots = read(cameras["cam 0"], 13)
    stamps = [shot.device_s for shot in shots]
    assert np.diff(stamps).min() > 0
    assert len({shot.jpeg for shot in shots}) == 4
    # 0.22 s and a period of 0.05 s, four times as fast.
    assert stamps[8] - stamps[0] == pytest.approx(2 * 0.27 / 4, abs=1e-6)


def test_a_video_is_served_as_pictures(session):
    videos.write_video(session / "c.mp4", "libx264", frames=6, options={"qp": "0"})
    tables = [{"name": name, "video": "c.mp4"} for name in "ab"]
    (session / "session.toml").write_text(dump_toml({"session": {"name": "v"}, "cameras": tables}))
    with playing(session, rate=0.5) as (cameras, _):
        shots = read(cameras["a"])
    grays = [cv2.imdecode(np.frombuffer(s.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE) for s in shots]
    levels = [float(gray.mean()) for gray in grays]
    np.testing.assert_allclose(levels, [videos.level(k) for k in range(6)], atol=3)
    np.testing.assert_allclose(np.diff([s.device_s for s in shots]), 1 / 15, atol=1e-3)


def test_another_name_is_not_there(session):
    with playing(session, loop=True) as (cameras, _):
        other = cameras["cam 0"].replace("cam%200", "cam0")
        with pytest.raises(CaptureError, match="404"):
            read(other)


def test_the_command_prints_the_cameras_in_one_line(session, tmp_path):
    command = [sys.executable, "-m", "measure", "play", str(session), "--as-cameras"]
    with subprocess.Popen(
        [*command, "--port", "0", "--wait-s", "0.3"], stdout=subprocess.PIPE, text=True
    ) as process:
        cameras = studio_api.parse_cameras(shlex.split(process.stdout.readline()))
        assert len(read(cameras[0].address)) == 4
        assert process.stdout.read() == "pictures sent: cam 0 4, käm#1 0\n"
    assert process.returncode == 0


def test_what_cannot_be_played_is_refused_in_a_line(session, capsys):
    assert main(["play", str(session), "--as-cameras", "--send", "udp://127.0.0.1:5"]) == 2
    assert "leave out --send" in capsys.readouterr().err
    assert main(["play", str(session.parent), "--as-cameras"]) == 2
    assert "is not a session" in capsys.readouterr().err
    assert main(["play", str(session), "--as-cameras", "--rate", "0"]) == 2
    assert "--rate 0" in capsys.readouterr().err
    assert main(["play", str(session)]) == 2
    assert "--as-cameras" in capsys.readouterr().err


def test_a_taken_port_is_named(session):
    with playing(session, loop=True) as (cameras, _):
        port = int(cameras["cam 0"].split(":")[2].split("/")[0])
        with pytest.raises(ConfigError, match=f"port {port}: nothing can listen there"):
            play_cameras(session, PlayOptions(), port, lambda _: None)


def test_json_is_all_that_is_printed(session, capsys):
    """With nobody who reads it never begins: it is ended from outside."""
    command = [sys.executable, "-m", "measure", "play", str(session), "--as-cameras", "--json"]
    with subprocess.Popen(
        [*command, "--port", "0"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert "http://127.0.0.1:" in process.stderr.readline()
        process.terminate()
        made = json.loads(process.stdout.read())
    assert made["pictures"] == dict.fromkeys(TIMES_S, 0)
