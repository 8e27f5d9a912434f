"""Names in strangers' files are never paths: whatever is written stays in the output."""

from __future__ import annotations

import inspect
import json
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from measure import api
from measure.cli import main
from measure.errors import MeasureError
from measure.host import Registry
from measure.model import Image
from measure.session import check_name, open_session, read_body, read_calibration
from measure_lab import api as lab
from measure_learning import api as learning_api
from measure_learning.api import RobotLogs
from measure_learning.core import AssemblySettings
from measure_studio import api as studio_api
from measure_studio.capture import check_names
from tests.session.conftest import SIZE_WH, Recording, jpeg, write_recording


@pytest.fixture
def recording(tmp_path: Path) -> Recording:
    return write_recording(tmp_path / "rec")


HOSTILE = {
    "up": "../../PWNED",
    "absolute": "/tmp/PWNED-by-measure",
    "below": "a/b",
    "backslash": "..\\..\\PWNED",
    "drive": "C:PWNED",
    "parent": "..",
    "dot at the end": "cam.",
    "space at the end": "cam ",
    "NUL": "a\0b",
    "newline": "a\nb",
    "empty": "",
    "300 letters": "x" * 300,
    "90 kanji": "\u7403" * 90,
    "device": "NUL",
    "device with an ending": "com1.front",
    "surrogate": "\ud800",
}
HARMLESS = ("Kamera über der Tür", "左のカメラ", "cam[0].*", "-x")


@pytest.mark.parametrize("name", HOSTILE.values(), ids=HOSTILE)
def test_a_hostile_name_is_refused_in_one_line(name: str) -> None:
    with pytest.raises(ValueError, match=r"name|path|dot|control|long|surrogate") as refused:
        check_name(name)
    assert "\n" not in str(refused.value)
    with pytest.raises(MeasureError, match="a camera's name: "):
        check_names([name])


@pytest.mark.parametrize("name", HARMLESS)
def test_a_harmless_name_is_taken_everywhere(name: str, tmp_path: Path) -> None:
    place = Place.made(tmp_path / "in", name)
    with open_session(place.session) as session:
        assert name in session.streams
        assert {body.name for body in session.bodies} == {name}
    marking = api.begin_marks(place.out / "marks", place.session, place.calibration)
    assert sorted(marking.pictures) == sorted([name, "cam1", "cam2"])
    assert marking.pictures[name].name == f"{name}.png"


def _text(name: str) -> str:
    """As TOML and JSON write it."""
    return json.dumps(name).replace("\\ud800", "\ud800")


@dataclass
class Place:
    """A stranger's files, all of one name, deep in a folder; what is made goes to `out`."""

    name: str
    jail: Path
    session: Path
    out: Path

    @classmethod
    def made(cls, jail: Path, name: str) -> Place:
        place = cls(name, jail, jail / "one" / "two" / "session", jail / "one" / "two" / "out")
        recording = write_recording(place.session)
        place.out.mkdir()
        assert main(["run", str(place.session), "-o", str(place.run), "--profile", "paper"]) == 0
        place.capture.mkdir()
        for file in ("session.toml", "calibration.toml"):
            recording.replace(file, 'name = "cam0"', f"name = {_text(name)}")
        _rename_body(recording.path / "body.toml", name)
        _rename_body(place.run / "body.toml", name)
        file = place.run / "calibration.toml"
        file.write_text(file.read_text().replace('name = "cam0"', f"name = {_text(name)}"))
        shutil.copy(place.calibration, place.capture / "lenses.toml")
        (place.capture / "cam0.png").write_bytes(jpeg(80))
        table = f'[[cameras]]\nname = {_text(name)}\ncalibration = "lenses.toml"\n'
        table += 'marker_image = "cam0.png"\n'
        (place.capture / "capture.toml").write_text(f'[capture]\nname = "x"\n{table}')
        return place

    @property
    def run(self) -> Path:
        return self.session.with_name("run")

    @property
    def capture(self) -> Path:
        return self.session.with_name("capture")

    @property
    def calibration(self) -> Path:
        return self.session / "calibration.toml"

    @property
    def body(self) -> Path:
        return self.session / "body.toml"

    def outside(self) -> dict[Path, bytes]:
        """All files but those that may be written, with what they hold."""
        kept = self.out, self.run
        found = [file for file in self.jail.rglob("*") if file.is_file()]
        return {f: f.read_bytes() for f in found if not any(k in f.parents for k in kept)}


def _rename_body(file: Path, name: str) -> None:
    lines = file.read_text().splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith("name = "))
    ball = next(k for k, line in enumerate(lines) if line == 'name = "green"')
    lines[at], lines[ball] = f"name = {_text(name)}", f"name = {_text(name)}"
    file.write_text("\n".join(lines) + "\n")


def _of_videos(place: Place) -> list[studio_api.CameraAddress]:
    """A camera that is called so, of a file; a name that is typed."""
    video = place.session / "film.avi"
    if not video.exists():
        writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, SIZE_WH)
        for _ in range(5):
            writer.write(np.zeros((SIZE_WH[1], SIZE_WH[0], 3), np.uint8))
        writer.release()
    return [
        studio_api.CameraAddress(place.name, str(video)),
        studio_api.CameraAddress("b", str(video)),
    ]


def _preview(place: Place) -> None:
    preview = studio_api.Preview()
    preview.add(Image(place.name, 0, 0.0, lambda: np.zeros((4, 4, 3), np.uint8)))
    preview.write([place.name], place.out / "stills")


def _marking(place: Place) -> None:
    marking = api.Marking(place.capture)
    marking.points["m"] = np.zeros(3)
    marking.set(next(iter(marking.pictures)), "m", (5.0, 5.0), "as clicked")
    marking.save()


def _record(place: Place) -> None:
    options = studio_api.CaptureOptions(seconds=0.2)
    with suppress(MeasureError):
        studio_api.record(_of_videos(place), place.out / "rec", options, bodies=[place.body])
    studio_api.record(_of_videos(place), place.out / "rec", options)


def _live(place: Place) -> None:
    options = studio_api.LiveOptions(seconds=0.2, record=place.out / "rec")
    profile, registry = api.load_profile("paper"), Registry.discover()
    given = _of_videos(place), place.out / "live", place.calibration, [place.body]
    studio_api.live(*given, profile, registry, options)


def _sampled(place: Place) -> None:
    body = read_body(place.body)
    picture = api.SeenPicture(place.capture / "cam0.png", ())
    api.write_sampled_body(place.out / "b.toml", body, picture, {place.name: (3, 3)}, ())


def _name_body(place: Place) -> None:
    session = place.out / "named"
    session.mkdir()
    shutil.copy(place.session / "session.toml", session)
    studio_api.name_body(session, read_body(place.body))


def _profiled(call: Callable[..., Any], *given: Any) -> Any:
    return call(*given, profile=api.load_profile("paper"), registry=Registry.discover())


WRITES: dict[str, Callable[[Place], Any]] = {
    "Marking": _marking,
    "Preview": _preview,
    "accept": lambda p: lab.accept(p.run, p.session / "cam1.csv", p.out / "page.html"),
    "begin_marks": lambda p: api.begin_marks(p.out / "marks", p.session, p.calibration),
    "calibrate_to": lambda p: [
        api.calibrate_to(of, p.out / f"{of.name}.toml", Registry.discover())
        for of in (p.session, p.capture)
    ],
    "capture_board": lambda p: studio_api.capture_board(
        _of_videos(p), "charuco_8x5_27", p.out / "wave", studio_api.CaptureOptions(seconds=0.2)
    ),
    "capture_body": lambda p: studio_api.capture_body(
        _of_videos(p), p.out / "waved", Registry.discover(), studio_api.CaptureOptions(seconds=0.2)
    ),
    "draw": lambda p: api.draw([], api.drawings([p.capture / "cam0.png"], p.out)),
    "draw_target": lambda p: api.draw_target(p.body, p.out / "body.pdf"),
    "export": lambda p: [api.export(p.run, kind, p.out / f"e.{kind}") for kind in ("csv", "trc")],
    "find_body": lambda p: api.find_body(p.session, Registry.discover(), api.BodySearch(20.0)),
    "live": _live,
    "make_dataset": lambda p: learning_api.make_dataset(
        [p.run], RobotLogs((p.session / "cam1.csv",)), p.out / "d.parquet", AssemblySettings()
    ),
    "mark_event": lambda p: api.mark_event(p.run, p.name),
    "mend": lambda p: _profiled(api.mend, p.session, p.out / "mended"),
    "name_body": _name_body,
    "pivot": lambda p: lab.pivot(p.run),
    "record": _record,
    "refine": lambda p: api.refine(p.session, Registry.discover()),
    "report": lambda p: lab.report(p.run, p.out / "report.html"),
    "robot_recording": lambda p: learning_api.robot_recording(
        p.run, "raven2", p.session / "cam1.csv"
    ),
    "run": lambda p: _profiled(api.run, p.session, p.out / "run"),
    "run_in_stretches": lambda p: _profiled(api.run_in_stretches, p.session, p.out / "run"),
    "run_many": lambda p: _profiled(api.run_many, [p.session], p.out / "many"),
    "sync": lambda p: api.sync(
        p.session, Registry.discover(), api.load_profile("paper"), p.out / "s.toml"
    ),
    "world": lambda p: lab.world(p.calibration, p.run),
    "world_by_board": lambda p: lab.world_by_board(p.calibration, "charuco_8x5_27", p.capture),
    "write_body": lambda p: api.write_body(p.out / "b.toml", read_body(p.body)),
    "write_calibration": lambda p: api.write_calibration(
        p.out / "c.toml", read_calibration(p.calibration)
    ),
    "write_sampled_body": _sampled,
}
"""What is written of a stranger's cameras, bodies and balls; some give it to who writes it."""
NAMELESS = {
    "ablate", "choose_poses", "correct_simulated_robot", "delete_recording", "demo", "demo_cameras",
    "estimate_file", "estimate_online", "new_folder", "output", "recalibrate", "render_demo",
    "rezero", "simulate_dataset", "simulate_recording", "sweep", "train", "write_board",
    "write_measured_board",
}  # fmt: skip
"""What writes, but reads no camera, body or ball of a file."""
READS = {
    "best_balls", "board_frame", "board_length", "body_names", "build_detectors", "build_pipeline",
    "calibrate", "calibrate_by_body", "camera_line", "is_session",
    "camera_names", "cameras", "check", "choose", "compare", "contents_of", "described", "detect",
    "clicked_color", "counted", "drawings", "evaluate", "evaluation_tables", "events",
    "find_target", "inside", "learnt_colors", "load_profile", "measure_bodies", "measure_session",
    "check_other_file", "other_file", "model_file",
    "next_free", "other_board", "own_board", "paper_body", "read_intrinsics", "recordings_in",
    "trail_of", "parse_cameras",
    "parse_click", "parse_expectation", "parse_settings",
    "play", "play_cameras", "profile_names", "read_board", "read_body",
    "read_calibration", "read_trajectory", "register", "relative_measurements", "rests",
    "sampled_color",
    "search_bodies", "shipped_model", "shipped_targets", "target_sheet", "usb_notes", "web_viewer",
}  # fmt: skip


def test_every_function_is_known_to_write_or_not() -> None:
    rooms = api, studio_api, learning_api, lab
    known = {name: getattr(room, name) for room in rooms for name in room.__all__}
    functions = {name for name, one in known.items() if inspect.isfunction(one)}
    writers = {name for name in WRITES if inspect.isfunction(known[name])}
    assert functions == writers | NAMELESS | READS


@pytest.mark.parametrize("kind", ["up", "absolute"])
def test_nothing_outside_the_output_is_touched(kind: str, tmp_path: Path) -> None:
    place = Place.made(tmp_path / "jail", HOSTILE[kind])
    _of_videos(place)
    before = place.outside()
    for name, call in WRITES.items():
        with suppress(MeasureError):
            call(place)
        assert place.outside() == before, name
    assert not Path(HOSTILE["absolute"]).exists()
    assert not Path(f"{HOSTILE['absolute']}.png").exists()


def test_the_law_sees_what_is_written_outside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the rule, `begin_marks` writes two folders up."""
    place = Place.made(tmp_path / "jail", "cam0")
    before = place.outside()

    def trusting(folder: Path, _: str, pixels: Any) -> None:
        cv2.imwrite(str(folder / f"{HOSTILE['up']}.png"), pixels)

    monkeypatch.setattr("measure.api.marking.write_named", trusting)
    with suppress(MeasureError):
        api.begin_marks(place.out / "marks", place.session, place.calibration)
    assert place.outside() != before


def test_a_captures_marks_lie_in_its_folder(tmp_path: Path) -> None:
    """Its `marks` and `markers` are files that are written when it is marked."""
    place = Place.made(tmp_path / "jail", "cam0")
    file = place.capture / "capture.toml"
    (place.capture / "m.csv").write_text("name,x_mm,y_mm,z_mm\nm,0,0,0\n")
    (place.jail / "one" / "marks.csv").write_text("camera,name,u_px,v_px\ncam0,m,5,5\n")
    text = file.read_text().replace("[capture]", '[capture]\nmarkers = "m.csv"')
    file.write_text(text.replace("[capture]", '[capture]\nmarks = "../../marks.csv"'))
    before = place.outside()
    marking = api.Marking(place.capture)
    marking.set("cam0", "m", (9.0, 9.0), "as clicked")
    with pytest.raises(MeasureError, match=r"marks\.csv: lies outside"):
        marking.save()
    assert place.outside() == before


@pytest.mark.parametrize(
    ("file", "old"),
    [("session.toml", '"cam0"'), ("calibration.toml", '"cam0"'), ("body.toml", '"triangle"'),
     ("body.toml", '"green"')],
)  # fmt: skip
def test_names_are_refused_where_files_are_read(recording: Recording, file: str, old: str) -> None:
    recording.replace(file, f"name = {old}", 'name = "../../PWNED"')
    with pytest.raises(MeasureError, match=rf"{file}:\d+: .*'\.\./\.\./PWNED' is a path, not a n"):
        open_session(recording.path)


def test_names_of_another_programs_cameras_are_refused(recording: Recording) -> None:
    calibration = read_calibration(recording.path / "calibration.toml")
    file = recording.path / "foreign.toml"
    api.write_calibration(file, calibration, "anipose")
    file.write_text(file.read_text().replace('"cam0"', '"../../PWNED"'))
    with pytest.raises(MeasureError, match=r"a camera's name: '\.\./\.\./PWNED' is a path"):
        read_calibration(file)
