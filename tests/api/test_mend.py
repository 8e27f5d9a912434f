"""What is off is taken out of copies, by value; and what cannot be told or mended is refused.

The pictures are black but for a mark in their first corner: what they are searched to show is made
up from the cameras, the body and the times that are true.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from measure.api.check import Look, Looking
from measure.checking import Level, SearchSample, search_sample, with_velocities
from measure.checking.arrangement import arrangement_causes
from measure.checking.body import BodyCheck
from measure.checking.causes import BY_HAND, Cause, Word
from measure.checking.diagnosis import Diagnosis, diagnose
from measure.checking.mending import MENDS
from measure.checking.motion import MotionCheck
from measure.checking.pictures import gaps_alone
from measure.checking.sightings import evidence_of
from measure.cli import main
from measure.geometry import RigidTransform
from measure.host import Registry
from measure.model import Body, Camera
from measure.session import (
    Calibration,
    Session,
    open_session,
    read_body,
    read_calibration,
    write_body,
    write_calibration,
)
from measure_studio.api import CaptureRequest
from measure_studio.page.bench import Bench
from measure_studio.page.recordings_page import Recordings
from tests.checking.test_arrangement import rig
from tests.checking.test_causes import path
from tests.scenes import RAVEN, moved, see

CAMERAS = rig(4)
COUNT, RATE = 16, 30.0
_MARK = 32  # px, of a square in the first corner


@dataclass
class Truth:
    """What is true of a recording, whatever its files say."""

    cameras: dict[str, Camera] = field(default_factory=lambda: dict(CAMERAS))
    later: dict[str, Camera] = field(default_factory=dict)  # from the middle on
    body: Body = RAVEN
    path: Callable[[float], RigidTransform] = path
    arranged: bool = True  # pictures are where and as they should be: no look is taken

    def camera(self, name: str, frame: int) -> Camera:
        """Where a camera stands when it takes a picture."""
        return (
            self.later.get(name, self.cameras[name]) if frame >= COUNT // 2 else self.cameras[name]
        )


def looked(session: Session, truth: Truth) -> Look:
    """What a look would show, of detections without a picture."""
    every, samples = list[dict[str, Any]](), list[SearchSample]()
    pairing = session.pair()
    mirrored = {
        n: _mark_is_elsewhere(stream.read(0).pixels) for n, stream in session.streams.items()
    }
    for positions, time_s in zip(pairing.positions, pairing.times_s, strict=True):
        found: dict[str, Any] = {}
        for at, (name, stream) in zip(positions.tolist(), session.streams.items(), strict=True):
            if at < 0:
                continue
            device, frame = Path(stream.source).parent.name, int(stream.frames[at])
            camera = truth.camera(device, frame)
            rng = np.random.default_rng([int(device[-1]), frame])
            seen = see({device: camera}, truth.body, truth.path, 0.1, rng, [frame / RATE])
            right = camera.intrinsics.size_wh[0] - 1.0
            found[name] = [
                replace(
                    d, camera=name, time_s=float(stream.times_s[at]),
                    center_px=d.center_px * [-1, 1] + [right, 0] if mirrored[name] else d.center_px,
                )
                for d in seen
            ]  # fmt: skip
        every.append(found)
        samples.append(search_sample(found, session.body, session.cameras, float(time_s)))
    causes = tuple[Cause, ...]()
    if not truth.arranged:
        causes = tuple(arrangement_causes(every, samples, session.body, session.cameras))
    gaps_s = gaps_alone({name: stream.times_s for name, stream in session.streams.items()})
    evidence = evidence_of(
        with_velocities(samples), every, (), session.body, session.cameras, gaps_s
    )
    diagnosis = Diagnosis() if causes else diagnose(evidence)
    return Look(
        len(samples), samples, BodyCheck(), MotionCheck(), (), causes or diagnosis.causes,
        diagnosis, (), evidence,
    )  # fmt: skip


def _mark_is_elsewhere(pixels: np.ndarray) -> bool:
    return float(pixels[: _MARK // 2, : _MARK // 2].mean()) < 100


class Recorded:
    """A session whose files say what may be wrong, of a truth."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.truth = folder, Truth()
        folder.mkdir()
        picture = np.zeros((720, 1280, 3), np.uint8)
        picture[:_MARK, :_MARK] = 255
        data = cv2.imencode(".png", picture)[1].tobytes()
        tables = ""
        for name in CAMERAS:
            (folder / name).mkdir()
            for k in range(COUNT):
                (folder / name / f"{k:03d}.png").write_bytes(data)
            self.stamp(name, lambda k: k / RATE)
            tables += f'[[cameras]]\nname = "{name}"\nimages = "{name}/*.png"\n'
            tables += f'timestamps = "{name}.csv"\n\n'
        head = '[session]\nname = "made up"\nbody = "body.toml"\ncalibration = "calibration.toml"\n'
        (folder / "session.toml").write_text(f"{head}\n{tables}")
        write_body(folder / "body.toml", RAVEN)
        self.state(CAMERAS)

    def stamp(self, name: str, time_s: Callable[[int], float]) -> None:
        rows = "".join(f"{k},{time_s(k):.9f}\n" for k in range(COUNT))
        (self.folder / f"{name}.csv").write_text(f"frame,time_s\n{rows}")

    def state(self, cameras: dict[str, Camera]) -> None:
        write_calibration(self.folder / "calibration.toml", Calibration(tuple(cameras.values())))


@pytest.fixture
def recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Recorded:
    made = Recorded(tmp_path / "session")
    monkeypatch.setattr(
        Looking, "with_clocks_set", lambda looking: looked(looking.session, made.truth)
    )
    monkeypatch.setattr(Looking, "__post_init__", lambda _: None)
    return made


def files_in(folder: Path) -> dict[Path, bytes]:
    return {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def mended(recorded: Recorded, out: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """What the command says and has written, once it has succeeded; nothing else was touched."""
    before = files_in(recorded.folder)
    assert main(["mend", str(recorded.folder), "-o", str(out), "--json"]) == 0
    assert files_in(recorded.folder) == before
    assert not [file for file in out.rglob("*") if file.suffix == ".png"]
    told: dict[str, Any] = json.loads(capsys.readouterr().out)
    return told


def with_pose(name: str, step: list[float]) -> dict[str, Camera]:
    """The cameras, one of which stands and points elsewhere (in its own axes, mm and rad)."""
    camera = CAMERAS[name]
    axes = camera.world_from_camera.rotation
    chart = np.concatenate([axes @ step[:3], axes @ step[3:]])
    return {**CAMERAS, name: moved(camera, camera.world_from_camera.perturb(chart))}


NUDGE = [3.0, -2.0, 1.0, 0.004, -0.003, 0.002]


def test_a_healthy_recording_is_copied(recorded, tmp_path, capsys) -> None:
    out = tmp_path / "out"
    told = mended(recorded, out, capsys)
    assert told["changed"] == []
    assert told["before"] == told["after"]
    assert told["after"]["residual_sd"] < 1
    assert told["after"]["pose_share"] == 1
    with open_session(out) as again, open_session(recorded.folder) as first:
        assert [s.files for s in again.streams.values()] == [
            s.files for s in first.streams.values()
        ]
        for name, stream in first.streams.items():
            assert again.streams[name].times_s == pytest.approx(stream.times_s)
        for one, other in zip(again.cameras, first.cameras, strict=True):
            difference = one.world_from_camera.difference(other.world_from_camera)
            assert np.abs(difference).max() < 1e-9
        assert np.array_equal(again.body.centers, first.body.centers)


def test_a_nudged_camera_is_put_back(recorded, tmp_path, capsys) -> None:
    recorded.state(with_pose("cam2", NUDGE))
    out = tmp_path / "out"
    told = mended(recorded, out, capsys)
    (change,) = told["changed"]
    assert (change["code"], change["subject"], change["level"]) == ("moved", "cam2", "wrong")
    contract = {"estimate", "sd", "unit", "since_s", "rivals", "remedy", "changed"}
    assert contract <= change.keys()
    assert told["after"]["residual_sd"] < 0.7 < 2 < told["before"]["residual_sd"]
    found = read_calibration(out / "calibration.toml")
    for camera in found.cameras:
        off = camera.world_from_camera.difference(CAMERAS[camera.name].world_from_camera)
        assert np.linalg.norm(off[:3]) < (1.0 if camera.name == "cam2" else 1e-6)
        assert np.degrees(np.linalg.norm(off[3:])) < (0.1 if camera.name == "cam2" else 1e-6)
    assert (found.camera("cam2").pose_covariance is None) is False
    assert found.provenance["mended"] == change["changed"]


@pytest.mark.parametrize("nudged", [True, False])
def test_the_studio_mends_a_copy_and_says_what_was_off(recorded, nudged) -> None:
    """A healthy recording leaves no copy behind."""
    recorded.state(with_pose("cam2", NUDGE) if nudged else CAMERAS)
    bench = Bench(recorded.folder.parent, Registry.discover(), True, CaptureRequest())
    recordings = Recordings(bench)
    recordings.mend(recorded.folder)
    bench.job.wait(60.0)
    assert bench.job.problem == ""
    said = recordings.mended[recorded.folder]
    assert (recorded.folder.parent / "session-mended-1").is_dir() == nudged
    if nudged:
        parts = ("what was off", "by how much", "changed", "better", "what else could be meant")
        assert [line.split(":")[0] for line in said] == [*parts]
        assert "cam2" in said[0]
    else:
        assert said == ["made up: nothing to mend"]


def test_a_late_clock_is_set_right(recorded, tmp_path, capsys) -> None:
    recorded.stamp("cam1", lambda k: k / RATE + 0.012)
    out = tmp_path / "out"
    told = mended(recorded, out, capsys)
    assert [(c["code"], c["subject"]) for c in told["changed"]] == [("clock", "cam1")]
    with open_session(out) as session:
        late_s = session.streams["cam1"].times_s - np.arange(COUNT) / RATE
    assert np.abs(late_s).max() < 0.0008


def test_a_clock_that_stepped_is_one_again(recorded, tmp_path, capsys) -> None:
    recorded.stamp("cam1", lambda k: k / RATE + 0.1 * (k >= COUNT // 2 + 1))
    out = tmp_path / "out"
    told = mended(recorded, out, capsys)
    assert told["changed"][0]["code"] == "clock-step"
    with open_session(out) as session:
        assert session.streams["cam1"].times_s == pytest.approx(np.arange(COUNT) / RATE, abs=1e-3)


def test_a_camera_touched_midway_is_two_cameras(recorded, tmp_path, capsys) -> None:
    recorded.truth.later = with_pose("cam3", [0, 0, 0, 0.005, -0.004, 0])
    out = tmp_path / "out"
    told = mended(recorded, out, capsys)
    assert [(c["code"], c["subject"]) for c in told["changed"]] == [("moved-at", "cam3")]
    found = read_calibration(out / "calibration.toml")
    assert found.names == ("cam0", "cam1", "cam2", "cam3", "cam3-later")
    off = found.camera("cam3-later").world_from_camera.difference(
        recorded.truth.later["cam3"].world_from_camera
    )
    assert np.linalg.norm(off[:3]) < 1.5
    assert np.degrees(np.linalg.norm(off[3:])) < 0.1
    with open_session(out) as session:
        frames = [session.streams[name].frames.tolist() for name in ("cam3", "cam3-later")]
    assert frames[0][-1] < COUNT // 2 + 1
    assert frames[0] == [*range(len(frames[0]))]
    assert frames[1] == [*range(COUNT - len(frames[1]), COUNT)]
    assert COUNT - 2 <= len(frames[0]) + len(frames[1]) <= COUNT


def test_exchanged_pictures_are_under_their_own_names(recorded, tmp_path, capsys) -> None:
    recorded.truth.arranged = False
    text = (recorded.folder / "session.toml").read_text()
    for old, new in (("cam0/", "x/"), ("cam2/", "cam0/"), ("x/", "cam2/")):
        text = text.replace(f'images = "{old}', f'images = "{new}')
    (recorded.folder / "session.toml").write_text(text)
    out = tmp_path / "out"
    told = mended(recorded, out, capsys)
    assert [c["code"] for c in told["changed"]] == ["exchanged-cameras"]
    assert told["after"]["pose_share"] == 1
    tables = tomllib.loads((out / "session.toml").read_text())["cameras"]
    shown = {table["name"]: Path(table["images"]).parent for table in tables}
    assert shown == {name: recorded.folder / name for name in CAMERAS}


def test_mirrored_pictures_are_turned_back_as_they_are_read(recorded, tmp_path, capsys) -> None:
    recorded.truth.arranged = False
    files = sorted((recorded.folder / "cam1").iterdir())
    data = cv2.imencode(".png", np.ascontiguousarray(cv2.imread(str(files[0]))[:, ::-1]))[1]
    for file in files:
        file.write_bytes(data.tobytes())
    out = tmp_path / "out"
    told = mended(recorded, out, capsys)
    assert [(c["code"], c["subject"]) for c in told["changed"]] == [("mirrored", "cam1")]
    with open_session(out) as session, open_session(recorded.folder) as first:
        stored, read = (s.streams["cam1"].read(3).pixels for s in (first, session))
        assert np.array_equal(read, stored[:, ::-1])


def test_a_radius_and_a_place_are_corrected_in_the_body(recorded, tmp_path, capsys) -> None:
    green, yellow, red = RAVEN.balls
    wrong = replace(yellow, center_mm=yellow.center_mm + np.array([0, 3.0, 0]))
    write_body(
        recorded.folder / "body.toml",
        replace(RAVEN, balls=(replace(green, radius_mm=green.radius_mm * 1.2), wrong, red)),
    )
    out = tmp_path / "out"
    told = mended(recorded, out, capsys)
    assert {c["code"] for c in told["changed"]} == {"radius", "ball-place"}
    found = read_body(out / "body.toml")
    assert found.radii == pytest.approx(RAVEN.radii, abs=0.3)
    assert found.centers == pytest.approx(RAVEN.centers, abs=0.15)


def test_two_faults_are_mended_one_after_the_other(recorded, tmp_path, capsys) -> None:
    recorded.stamp("cam1", lambda k: k / RATE + 0.012)
    recorded.state(with_pose("cam3", NUDGE))
    told = mended(recorded, tmp_path / "out", capsys)
    assert {(c["code"], c["subject"]) for c in told["changed"]} >= {
        ("clock", "cam1"), ("moved", "cam3"),
    }  # fmt: skip
    assert told["after"]["residual_sd"] < 0.8


def refused(recorded: Recorded, out: Path, capsys: pytest.CaptureFixture[str]) -> str:
    assert main(["mend", str(recorded.folder), "-o", str(out)]) == 3
    assert not out.exists()
    said = capsys.readouterr().out
    assert said.count("\n") == 1
    return said


def test_rivals_that_need_different_mends_are_refused(recorded, tmp_path, capsys) -> None:
    """A body that glides in one direction hardly: its late picture is one of a turned camera."""
    recorded.truth.path = lambda time_s: RigidTransform(
        path(0.0).rotation, path(0.0).translation + np.array([60.0, 30.0, 0.0]) * time_s
    )
    recorded.stamp("cam1", lambda k: k / RATE + 0.04)
    said = refused(recorded, tmp_path / "out", capsys)
    assert "both were tried, both explain it" in said
    assert "the clock of cam1 is off" in said
    assert "cam1 was moved" in said
    assert "move the body faster, and to and fro, and ask again" in said


def test_what_only_a_person_can_mend_is_refused(recorded, tmp_path, capsys, monkeypatch) -> None:
    cause = Cause(
        Word.INTERLACED, "cam1", "pictures are woven", "switch to progressive", Level.WRONG
    )
    right = Looking.with_clocks_set
    monkeypatch.setattr(
        Looking, "with_clocks_set", lambda looking: replace(right(looking), causes=(cause,))
    )
    said = refused(recorded, tmp_path / "out", capsys)
    assert "pictures are woven: this can only be mended by hand: switch to progressive" in said


def test_a_mend_that_helps_nothing_is_refused(recorded, tmp_path, capsys, monkeypatch) -> None:
    cause = Cause(Word.CLOCK, "cam1", "cam1 is late", "add it", Level.WRONG, 30.0, 1.0, "ms")
    right = Looking.with_clocks_set
    monkeypatch.setattr(
        Looking, "with_clocks_set", lambda looking: replace(right(looking), causes=(cause,))
    )
    said = refused(recorded, tmp_path / "out", capsys)
    assert "cam1 is late: mending this makes the recording fit no better" in said


def test_every_cause_is_mended_or_left_to_a_person() -> None:
    assert {*MENDS} ^ {*BY_HAND} == {*Word}


def test_bad_input_is_refused_in_a_line(recorded, tmp_path, capsys) -> None:
    there = tmp_path / "there"
    there.mkdir()
    (there / "file").touch()
    own, out = str(recorded.folder), str(tmp_path / "out")
    for words in ([out, "-o", "x"], [own, "-o", str(there)], [own, "-o", own, "--overwrite"]):
        assert main(["mend", *words]) == 2
        assert capsys.readouterr().err.count("\n") == 1
