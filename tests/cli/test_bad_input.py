"""Whatever is wrong with what a user gives: one clear line and exit code 2."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from measure.cli import main
from measure.results import read_run
from measure.session import read_body, read_calibration, write_body
from tests.results.conftest import write_truth
from tests.session.conftest import Recording, jpeg, write_recording
from tests.session.test_errors import CASES


@pytest.fixture
def recording(tmp_path: Path) -> Recording:
    return write_recording(tmp_path / "rec")


def complaint(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """The one line a command prints when it refuses."""
    assert main([str(word) for word in words]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    lines = [line for line in err.splitlines() if not line.startswith("measuring:")]
    assert len(lines) == 1, err
    assert "Traceback" not in err
    return lines[0]


def run_words(recording: Recording, *more: str) -> tuple[str, ...]:
    out = recording.path.with_name("run")
    return ("run", str(recording.path), "-o", str(out), "--profile", "paper", *more)


@pytest.mark.parametrize("name", ["broken TOML", "wrong type", "clock goes backwards"])
def test_a_bad_session(recording: Recording, name: str, capsys) -> None:
    spoil, *expected = CASES[name]
    spoil(recording)
    line = complaint(capsys, *run_words(recording))
    for part in expected:
        assert part in line
    assert not recording.path.with_name("run").exists(), "nothing was begun"


def test_a_missing_session(recording: Recording, capsys) -> None:
    line = complaint(capsys, "run", recording.path.with_name("recc"), "-o", "x")
    assert "recc: no such file or folder; did you mean rec?" in line


def test_what_is_missing_is_not_sought_among_outputs_that_are_begun(tmp_path, capsys):
    (tmp_path / "seen").mkdir()
    line = complaint(capsys, "calibrate", tmp_path / "nowhere", "--out", tmp_path / "rig.toml")
    assert line.endswith(f"nowhere: no such file or folder; {tmp_path} holds seen")


def test_a_broken_picture_on_the_way_keeps_what_was_measured(recording: Recording, capsys) -> None:
    (recording.path / "cam1/000004.jpg").write_bytes(b"hello")
    line = complaint(capsys, *run_words(recording))
    assert "camera 'cam1', frame 4: " in line
    assert "000004.jpg: not a picture" in line
    run = read_run(recording.path.with_name("run"))
    assert not run.finished
    assert run.poses["index"].to_pylist() == [0, 1, 2, 3]
    (recording.path / "cam1/000004.jpg").write_bytes(jpeg(80))
    (recording.path / "cam0/000005.jpg").write_bytes(jpeg(90))
    line = complaint(capsys, *run_words(recording, "--resume"))
    assert "cannot be resumed: its run was made with other session" in line


def test_numbers_out_of_range(recording: Recording, capsys) -> None:
    line = complaint(capsys, "check", recording.path, "--samples", "0")
    assert "0 samples, 120 clock samples: expected at least 1 and 0" in line
    line = complaint(capsys, "check", recording.path, "--clock-samples", "-1")
    assert "24 samples, -1 clock samples" in line
    out = recording.path.with_name("runs")
    line = complaint(capsys, "run", recording.path, recording.path, "-o", out, "--workers", "0")
    assert "--workers 0: expected at least 1" in line


def test_a_file_where_the_run_shall_be(recording: Recording, capsys) -> None:
    recording.path.with_name("run").write_text("a thesis")
    assert "is a file: choose a new folder with --out" in complaint(capsys, *run_words(recording))
    assert recording.path.with_name("run").read_text() == "a thesis"


def test_a_run_where_no_folder_can_be_made(recording: Recording, capsys) -> None:
    line = complaint(capsys, "run", recording.path, "-o", recording.path / "body.toml/run")
    assert "body.toml/run: cannot write (Not a directory); nothing was begun" in line
    assert "--resume" not in line


def test_a_run_that_finds_nothing_says_where_to_look(recording: Recording, capsys) -> None:
    assert main([*run_words(recording)]) == 0
    said = capsys.readouterr().out
    assert f"to find out why: measure check {recording.path}" in said
    assert "cam1: 3 of 3 pictures are grey" in said  # three equal channels


def test_a_broken_picture_keeps_what_waits_for_later_pictures(recording: Recording, capsys) -> None:
    """`precise` brings pictures to one instant by the poses round it, so it works in arrears."""
    (recording.path / "cam1/000004.jpg").write_bytes(b"hello")
    out = recording.path.with_name("run")
    line = complaint(capsys, "run", recording.path, "-o", out, "--no-recording")
    assert "000004.jpg: not a picture" in line
    assert read_run(out).poses["index"].to_pylist() == [0, 1, 2, 3]


def test_a_torn_picture_is_named_and_measured_without(recording: Recording, capsys) -> None:
    for camera in ("cam1", "cam2"):
        (recording.path / camera / "000002.jpg").write_bytes(jpeg(40)[:-30])
    assert main([*run_words(recording)]) == 0
    lines = [line.strip() for line in capsys.readouterr().out.splitlines()]
    assert "1 x damaged or cut off, and left out: 000002.jpg of cam1, cam2" in lines


def test_a_missing_picture_is_noted_and_measured_without(recording: Recording, capsys) -> None:
    (recording.path / "cam1/000002.jpg").unlink()
    assert main([*run_words(recording)]) == 0
    assert "note: camera 'cam1': 1 of 6 frames have no image" in capsys.readouterr().out
    run = read_run(recording.path.with_name("run"))
    assert run.poses.num_rows == 6
    (lost,) = run.provenance["session"]["notes"]
    assert lost in [note.text for note in run.summary.notes]


def test_an_earlier_run_is_not_overwritten(recording: Recording, capsys) -> None:
    assert main([*run_words(recording)]) == 0
    capsys.readouterr()
    line = complaint(capsys, *run_words(recording))
    assert "is there already: --overwrite replaces it, --resume goes on with it" in line


@pytest.fixture
def small_disk(tmp_path: Path):
    """Mounts a real file system of so many kB."""
    place = tmp_path / "disk"
    place.mkdir()

    def mount(kilobytes: int) -> Path:
        options = ["-t", "tmpfs", "-o", f"size={kilobytes}k"]
        command = ["mount", *options, "tmpfs", str(place)]
        if subprocess.run(command, capture_output=True, check=False).returncode:
            pytest.skip("may not mount a tmpfs here")
        return place

    yield mount
    if place.is_mount():
        subprocess.run(["umount", "--lazy", str(place)], check=True)


@pytest.mark.parametrize("kilobytes", [28, 100])
def test_a_full_disk(tmp_path: Path, small_disk, kilobytes: int, capfd, monkeypatch) -> None:
    monkeypatch.setattr("measure.results.writer.FLUSH_EVERY_S", 0.0)
    recording = write_recording(tmp_path / "rec", cameras=4, frames=12)
    out = small_disk(kilobytes) / "run"
    words = ["run", str(recording.path), "-o", str(out), "--profile", "paper", "--no-recording"]
    code = main(words)
    err = capfd.readouterr().err
    assert "Traceback" not in err
    if code == 0:
        assert kilobytes > 28
        assert read_run(out).finished
        return
    assert code == 2
    lines = [line for line in err.splitlines() if line.startswith("measure: ")]
    assert len(lines) == 1
    assert "disk is full" in lines[0] or "No space left" in lines[0]
    if (out / "poses.csv").exists():
        text = (out / "poses.csv").read_text()
        assert text == "" or text.endswith("\n")
        kept = read_run(out).poses["index"].to_pylist()
        assert kept == list(range(len(kept)))
        assert len(kept) <= text.count("\n")


def test_a_disk_that_fills_up_beside_the_recording(
    recording: Recording, capsys, monkeypatch
) -> None:
    """The run stops while its tables still fit, and goes on once there is room."""
    usage = iter([10**9] * 4)
    real = shutil.disk_usage
    monkeypatch.setattr(
        shutil, "disk_usage", lambda path: real(path)._replace(free=next(usage, 10**6))
    )
    line = complaint(capsys, *run_words(recording))
    assert "run.rrd: the disk is full but for 1000 kB; everything measured before is kept" in line
    folder = recording.path.with_name("run")
    assert read_run(folder).poses["index"].to_pylist() == [0, 1, 2, 3]
    monkeypatch.undo()
    assert main([*run_words(recording, "--resume")]) == 0
    assert "resumed at frame set 4 of 6" in capsys.readouterr().err
    assert read_run(folder).poses["index"].to_pylist() == list(range(6))
    assert read_run(folder).finished


def test_evaluation_of_what_is_no_run_or_no_truth(recording: Recording, tmp_path, capsys) -> None:
    assert "is no run: no such folder" in complaint(capsys, "evaluate", tmp_path / "none")
    assert main([*run_words(recording)]) == 0
    capsys.readouterr()
    run = recording.path.with_name("run")
    assert "has no truth: give one with --truth" in complaint(capsys, "evaluate", run)
    truth = write_truth(tmp_path / "truth.csv", 1.0)
    assert main(["evaluate", str(run), "--truth", str(truth)]) == 0
    out = capsys.readouterr().out
    assert "6 (100.0 %)" in out
    assert "not finite: poses are missing" in out
    late = truth.read_text().replace("\n0.", "\n900.").replace("\n1.", "\n901.")
    truth.write_text(late)
    line = complaint(capsys, "evaluate", run, "--truth", truth)
    assert "it is not its truth" in line
    assert "truh.csv: no such file; did you mean truth.csv?" in complaint(
        capsys, "evaluate", run, "--truth", tmp_path / "truh.csv"
    )


@pytest.mark.parametrize(
    ("name", "kept", "said"),
    [
        ("run.toml", 100, "run.toml: cannot be read (Unterminated"),
        ("poses.parquet", 3000, "poses.parquet: cannot be read ("),
        ("poses.parquet", 0, "poses.parquet: cannot be read ("),
        ("poses.parquet", None, "is torn: it has no poses.parquet"),
    ],
)
def test_a_torn_run(recording: Recording, capsys, name: str, kept: int | None, said: str) -> None:
    assert main([*run_words(recording)]) == 0
    capsys.readouterr()
    run = recording.path.with_name("run")
    whole = (run / name).read_bytes()
    (run / name).unlink()
    if kept is not None:
        assert len(whole) > kept
        (run / name).write_bytes(whole[:kept])
    for words in (("evaluate", run), ("report", run), ("export", run, "-f", "csv")):
        line = complaint(capsys, *words)
        assert said in line
        assert "fetch it from where the run was made, or measure anew with --overwrite" in line
    assert said in complaint(capsys, *run_words(recording, "--resume"))


def test_a_view_of_what_is_no_recording(tmp_path: Path, capsys) -> None:
    (tmp_path / "notes.txt").write_text("hello")
    assert "no recording of a run" in complaint(capsys, "view", tmp_path / "notes.txt")
    assert "no such recording" in complaint(capsys, "view", tmp_path / "none")


def test_a_viewer_that_finds_no_screen_is_an_error(recording: Recording, capfd, monkeypatch):
    assert main([*run_words(recording)]) == 0
    capfd.readouterr()
    monkeypatch.setattr("measure.viewing.viewer.viewer_program", lambda: "false")
    line = complaint(capfd, "view", recording.path.with_name("run"))
    assert "gave up with exit code 1" in line
    assert "--web" in line


def test_export_of_what_cannot_be_exported(recording: Recording, capsys) -> None:
    assert main([*run_words(recording)]) == 0
    capsys.readouterr()
    run = recording.path.with_name("run")
    assert "holds no pose" in complaint(capsys, "export", run, "--format", "tum")
    assert "did you mean c3d?" in complaint(capsys, "export", run, "--format", "c3")


def test_body_and_calibration_given_by_hand(recording: Recording, tmp_path: Path, capsys) -> None:
    body = read_body(recording.path / "body.toml")
    write_body(tmp_path / "mine.toml", body)
    text = (recording.path / "calibration.toml").read_text()
    (tmp_path / "cal.toml").write_text(text.replace("[64, 48]", "[640, 480]", 1))
    assert np.all(np.isfinite(read_calibration(tmp_path / "cal.toml").cameras[0].center))
    line = complaint(capsys, *run_words(recording, "--calibration", str(tmp_path / "cal.toml")))
    assert f"{tmp_path / 'cal.toml'} calibrates 640x480 px" in line
    line = complaint(capsys, *run_words(recording, "--body", str(tmp_path / "min.toml")))
    assert "min.toml: no such file; did you mean mine.toml?" in line
