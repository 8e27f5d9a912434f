"""Slips of the pen that would cost a result: one clear line, exit code 2, and nothing lost."""

from __future__ import annotations

from pathlib import Path

import pytest

from measure.cli import main
from tests.cli.test_bad_input import complaint, run_words
from tests.results.conftest import write_truth
from tests.session.conftest import Recording, write_recording


@pytest.fixture
def recording(tmp_path: Path) -> Recording:
    return write_recording(tmp_path / "rec")


def test_nothing_is_overwritten_by_a_slip(recording: Recording, capsys) -> None:
    assert main([*run_words(recording)]) == 0
    capsys.readouterr()
    run = recording.path.with_name("run")
    before = (run / "poses.csv").read_bytes()
    both = complaint(capsys, *run_words(recording, "--resume", "--overwrite"))
    assert "--resume goes on with a run, --overwrite throws it away" in both
    said = complaint(capsys, "export", run, "-f", "csv", "-o", run / "poses.csv", "--overwrite")
    assert "poses.csv: is one of the files to be read" in said
    assert (run / "poses.csv").read_bytes() == before


def test_a_run_is_compared_with_its_own_session_file(
    recording: Recording, tmp_path: Path, capsys
) -> None:
    words = run_words(recording)
    session = recording.path / "session.toml"
    write_truth(recording.path / "truth.csv", 1.0)
    write_truth(recording.path / "later.csv", 1.0, start_s=900.0)
    text = session.read_text()
    session.write_text(text.replace("[session]", '[session]\ntruth = "later.csv"'))
    second = recording.path / "second.toml"
    second.write_text(text.replace("[session]", '[session]\ntruth = "truth.csv"'))
    run = str(recording.path.with_name("run"))
    assert main(["run", str(second), *words[2:]]) == 0
    assert main(["evaluate", run]) == 0
    assert main(["report", run]) == 0
    capsys.readouterr()
    assert main(["run", *words[1:], "--overwrite"]) == 0
    capsys.readouterr()
    for words in (["evaluate", run], ["report", run, "--overwrite"]):
        assert "later.csv runs from 900.000" in complaint(capsys, *words)


@pytest.mark.parametrize(
    ("color", "words", "said"),
    [
        ("red", ("--solver", "contours"), "'hough' measures none: take another solver with it ("),
        ("green", (), "are two balls of one colour"),
    ],
)
def test_what_does_not_fit_together_costs_no_run(
    recording: Recording, capsys, color: str, words: tuple[str, ...], said: str
) -> None:
    run = recording.path.with_name("run")
    recording.replace("body.toml", 'color = "red"', f'color = "{color}"')
    assert said in complaint(capsys, *run_words(recording, *words))
    assert not run.exists()
    run.mkdir()
    (run / "run.toml").write_text("an earlier run")
    complaint(capsys, *run_words(recording, *words, "--overwrite"))
    assert (run / "run.toml").read_text() == "an earlier run"


def test_stages_that_fail_at_once_cost_no_run(
    recording: Recording, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    """Neither an earlier one, nor the next one a word more."""
    run = recording.path.with_name("run")
    with monkeypatch.context() as patched:
        patched.setattr("measure_paper.hough.HoughDetector.detect", lambda *_: 1 / 0)
        said = complaint(capsys, *run_words(recording))
        assert "detector 'hough' of triball" in said
        assert "fails (camera" in said
    assert not run.exists()
    assert main([*run_words(recording)]) == 0
    before = (run / "poses.parquet").read_bytes()
    capsys.readouterr()
    with monkeypatch.context() as patched:
        patched.setattr("measure_paper.hough.HoughDetector.detect", lambda *_: 1 / 0)
        complaint(capsys, *run_words(recording, "--overwrite"))
    assert (run / "poses.parquet").read_bytes() == before


def test_a_viewer_that_is_not_there_costs_no_run(
    recording: Recording, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    monkeypatch.setattr("measure.viewing.recording.CONNECT_WITHIN_S", 0.0)
    words = run_words(recording, "--connect", "rerun+http://127.0.0.1:1/proxy")
    assert "no viewer listens at rerun+http://127.0.0.1:1/proxy" in complaint(capsys, *words)
    assert not recording.path.with_name("run").exists()


def test_an_open_quotation_mark_in_a_long_file(recording: Recording, capsys) -> None:
    rows = "".join(f"{k},{0.001 * k}\n" for k in range(20000))
    (recording.path / "cam1.csv").write_text('"frame,time_s\n' + rows)
    assert "is a quotation mark not closed?" in complaint(capsys, *run_words(recording))


@pytest.mark.parametrize("tolerance", ["-1", "nan"])
def test_a_tolerance_that_is_none(recording: Recording, tmp_path: Path, capsys, tolerance) -> None:
    out = tmp_path / "c.toml"
    words = ("refine", recording.path, "-o", out, f"--body-tolerance-mm={tolerance}")
    assert "--body-tolerance-mm" in complaint(capsys, *words)
    assert not out.exists()


def test_a_calibrations_report_has_a_file_of_its_own(recording: Recording, capsys) -> None:
    out = recording.path / "c.html"
    assert "needs a file each" in complaint(capsys, "calibrate", recording.path, "-o", out)


def test_a_run_does_not_go_on_with_another_tolerance(recording: Recording, capsys) -> None:
    body = recording.path / "body.toml"
    assert main([*run_words(recording)]) == 0
    capsys.readouterr()
    body.write_text("tolerance_mm = 0.2\n" + body.read_text())
    assert "body" in complaint(capsys, *run_words(recording, "--resume"))


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("192.0.2.1", "--bind 192.0.2.1: nothing can listen there"),
        ("localhost", "--bind localhost: expected an address such as 127.0.0.1"),
        ("::1", "--bind ::1: expected an address"),
        ("", "--bind : expected an address"),
    ],
)
def test_an_address_where_no_viewer_can_listen(tmp_path, capsys, address: str, said: str) -> None:
    (tmp_path / "run.rrd").write_bytes(b"RRF2")
    assert said in complaint(capsys, "view", tmp_path, "--web", "--bind", address)
