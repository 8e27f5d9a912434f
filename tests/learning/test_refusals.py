"""What cannot be learnt from or corrected is refused in a line, as typed."""

from __future__ import annotations

import json
import signal
import socket
import threading
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.sinks import free_port
from measure.arrays import Floats
from measure.cli import main
from measure.host import Correction, Dataset
from measure_learning.core import AnswerPacket, EstimateClient, Refusal, StatePacket, files

pytest.importorskip("onnx", reason="fitting needs the extra 'train'")


def _estimate(folder: Path, states: str, *more: str) -> list[str]:
    words = ["estimate", str(folder / "model.onnx"), "--input", str(folder / states)]
    return [*words, "--out", str(folder / "out.csv"), "--overwrite", *more]


def test_recorded_states_that_cannot_be_corrected(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A NaN and a stamp that goes back are counted; their rows hold no number."""
    lines = (folder / "left.csv").read_text().splitlines()
    torque = lines[0].replace('"', "").split(",").index("tau_0")
    for row, column, text in ((5, torque, "nan"), (9, 0, "0.01")):
        cells = lines[row].split(",")
        cells[column] = text
        lines[row] = ",".join(cells)
    (folder / "bad.csv").write_text("\n".join(lines) + "\n")
    capsys.readouterr()
    assert main(_estimate(folder, "bad.csv", "--json")) == 0
    counts = json.loads(capsys.readouterr().out)
    assert counts["corrected"] == len(lines) - 3
    assert counts[Refusal.NOT_A_NUMBER] == counts[Refusal.STALE] == 1
    table = np.genfromtxt(folder / "out.csv", delimiter=",", names=True, usecols=range(3, 6))
    assert np.flatnonzero(np.isnan(table["ex"])).tolist() == [4, 8]
    assert main(_estimate(folder, "bad.csv")) == 0
    told = capsys.readouterr().out
    assert "1 a feature is not a number, 1 stamp not after the last one" in told


def _refused(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """The one line of a command that refuses."""
    capsys.readouterr()
    assert main([str(word) for word in words]) == 2
    err = capsys.readouterr().err.splitlines()
    assert len(err) == 1
    return err[0]


@pytest.mark.parametrize(
    ("words", "kept"),
    [
        ("estimate model.onnx --input left.parquet --out left.parquet", "left.parquet"),
        ("estimate model.onnx --input left.parquet --out again.parquet", "left.parquet"),
        ("estimate model.onnx --input left.parquet --out model.onnx", "model.onnx"),
        (
            "estimate model.onnx --rezero data.parquet --input left.csv --out data.parquet",
            "data.parquet",
        ),
        ("dataset left.csv --robot-log left.parquet --out again.parquet", "left.parquet"),
        ("train data.parquet -o data.onnx --estimator offset", "data.card.json"),
    ],
)
def test_what_is_read_is_not_written_over(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys, words: str, kept: str
) -> None:
    """Nor through a link, nor a data set's card by that of the model that is trained on it."""
    monkeypatch.chdir(folder)
    Path("again.parquet").unlink(missing_ok=True)
    Path("again.parquet").symlink_to("left.parquet")
    before = Path(kept).read_bytes()
    assert "is one of the files to be read" in _refused(capsys, *words.split())
    assert Path(kept).read_bytes() == before


def test_an_output_goes_into_a_folder_that_is_made(folder: Path) -> None:
    out = folder / "new/corrected.csv"
    words = ["estimate", str(folder / "model.onnx"), "--input", str(folder / "left.csv")]
    assert main([*words, "--out", str(out)]) == 0
    assert out.exists()


@pytest.mark.parametrize(("host", "port"), [("127.0.0.1", 99999), ("192.0.2.1", 47118)])
def test_where_nobody_can_listen(
    folder: Path, capsys: pytest.CaptureFixture[str], host: str, port: int
) -> None:
    line = _refused(
        capsys, "estimate", folder / "model.onnx", "--host", host, "--port", port, "--seconds", "1"
    )
    assert f"cannot listen on udp://{host}:{port}" in line


def test_a_port_that_is_taken(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        line = _refused(capsys, "estimate", folder / "model.onnx", "--port", port, "--seconds", "1")
    assert "choose another --port" in line


@pytest.mark.parametrize(
    "words",
    [
        ("simulate", "-o", "x", "--seconds", "-3"),
        ("simulate", "-o", "x", "--seconds", "nan"),
        ("simulate", "-o", "x", "--frame-hz", "0"),
        ("simulate", "-o", "x", "--frame-hz", "inf"),
        ("dataset", "--simulate-min", "-1", "--out", "x.parquet"),
        ("dataset", "--simulate-min", "nan", "--out", "x.parquet"),
        ("dataset", "--simulate-min", "5", "--restarts", "0", "--out", "x.parquet"),
        ("dataset", "run", "--robot-log", "log", "--cut-s", "-5", "--out", "x.parquet"),
        ("dataset", "run", "--robot-log", "log", "--history-hz", "nan", "--out", "x.parquet"),
        ("dataset", "run", "--robot-log", "log", "--history-hz", "1e9", "--out", "x.parquet"),
        ("dataset", "run", "--robot-log", "log", "--clock-offset-s", "inf", "--out", "x.parquet"),
        ("dataset", "--simulate-min", "5", "--seed", "-1", "--out", "x.parquet"),
        ("dataset", "--simulate-min", "5", "--wear", "0", "--out", "x.parquet"),
        ("simulate", "-o", "x", "--seed", "-1"),
        ("simulate", "-o", "x", "--clock-offset-s", "nan"),
        ("simulate", "-o", "x", "--wear", "nan"),
    ],
)
def test_numbers_that_make_no_data(
    tmp_path: Path, monkeypatch, capsys: pytest.CaptureFixture[str], words: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert "expected" in _refused(capsys, *words)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--split-seed", "-1"), "--split-seed -1: expected a number from 0 to"),
        (("--seed", str(2**32)), "--seed 4294967296: expected a number from 0 to"),
        (("--test-share", "nan"), "a test share of nan"),
        (("--validation-share", "5"), "a validation share of 5: expected two above 0"),
        (("--test-share", "0.95"), "that leave something to train on"),
        (("--estimator", "mlp", "--set", "layers=[0]"), "a layer needs at least one unit"),
    ],
)
def test_numbers_that_nothing_is_learnt_with(
    folder: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], reason: str
) -> None:
    given = words if "--estimator" in words else ("--estimator", "offset", *words)
    out = folder / "none.onnx"
    assert reason in _refused(capsys, "train", folder / "data.parquet", "-o", out, *given)
    assert not out.exists()


def test_labels_that_are_all_zero(folder: Path, small: Dataset, capsys) -> None:
    """The share of a change of nothing was a division by zero, once all was learnt."""
    data = folder / "zero.parquet"
    files.write_dataset(data, replace(small, errors_mm=0.0 * small.errors_mm), [], "no errors")
    words = ("train", data, "-o", folder / "none.onnx", "--estimator", "offset")
    assert "all errors of the training trajectories are 0" in _refused(capsys, *words)


def test_a_folder_is_no_data_set(folder: Path, monkeypatch, capsys) -> None:
    (folder / "within").mkdir()
    monkeypatch.chdir(folder / "within")
    words = ("-o", folder / "none.onnx", "--estimator", "offset")
    assert "is a folder, not an ordinary file" in _refused(capsys, "train", ".", *words)


def test_a_setting_that_a_sweep_tries_is_not_fixed_too(folder: Path, capsys) -> None:
    """The fixed one was dropped without a word."""
    space = folder / "space.toml"
    space.write_text("[penalty]\nlow = 1\nhigh = 2\n")
    words = ("sweep", folder / "data.parquet", space, "--journal", folder / "new.log")
    said = _refused(capsys, *words, "--set", "penalty=3")
    assert "--set penalty: " in said
    assert "has a range for it" in said


@pytest.mark.parametrize("seconds", ["-3", "nan"])
def test_times_that_are_none(folder: Path, capsys, seconds: str) -> None:
    words = ("estimate", folder / "model.onnx", "--port", "0", "--seconds", seconds)
    assert f"--seconds {seconds}: expected a number" in _refused(capsys, *words)


def test_a_state_beyond_what_networks_know_is_no_number(folder: Path, capsys) -> None:
    """It became infinite, and was answered."""
    lines = (folder / "left.csv").read_text().splitlines()
    cells = lines[5].split(",")
    cells[lines[0].replace('"', "").split(",").index("tau_0")] = "1e300"
    lines[5] = ",".join(cells)
    (folder / "huge.csv").write_text("\n".join(lines) + "\n")
    capsys.readouterr()
    assert main(_estimate(folder, "huge.csv", "--json")) == 0
    counts = json.loads(capsys.readouterr().out)
    assert counts[Refusal.NOT_A_NUMBER] == 1


def test_outputs_that_cannot_be_written(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Folders, and names that say another format than would be written, used to cost the work."""
    data, log, model = (folder / name for name in ("data.parquet", "left.csv", "model.onnx"))
    space = folder / "space.toml"
    space.write_text("[penalty]\nlow = 1\nhigh = 2\n")
    for suffix in ("onnx", "parquet", "log"):
        (folder / f"taken.{suffix}").mkdir()
    estimate = ("estimate", model, "--input", log, "--out")
    for words, reason in (
        (("train", data, "-o", folder / "taken.onnx"), "is a folder"),
        (("dataset", log, "--robot-log", log, "-o", folder / "taken.parquet"), "is a folder"),
        (("sweep", data, space, "--journal", folder / "taken.log"), "is a folder"),
        ((*estimate, folder / "taken.parquet"), "is a folder"),
        ((*estimate, log / "x.csv"), "left.csv is no folder"),
        ((*estimate, folder / "x.txt"), "must end with .parquet or .csv"),
        (("dataset", log, "--robot-log", log, "-o", folder / "x.csv"), "must end with .parquet"),
        (("dataset", "--simulate-min", 1, "-o", folder / "x.csv"), "must end with .parquet"),
    ):
        assert reason in _refused(capsys, *words)


def test_another_robots_files(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Parquet says whose it is; of what does not say it, the kinematics contradict the tip."""
    other = "right.parquet: holds states of robot 'raven2-right', not of 'raven2-left'"
    poses = folder / "poses.csv"
    poses.write_text("time_s,x_mm,y_mm,z_mm\n0,1,2,3\n")
    capsys.readouterr()
    dataset = ["dataset", str(poses), "--robot-log", str(folder / "right.parquet")]
    for words in (_estimate(folder, "right.parquet"), [*dataset, "-o", str(folder / "no.parquet")]):
        assert main(words) == 2
        told = capsys.readouterr().err
        assert told.startswith("measure: ")
        assert other in told
        assert told.count("\n") == 1
    said = _refused(capsys, *_estimate(folder, "right.csv"))
    assert "right.csv: its states are unlike the training, and the kinematics put the tip" in said


def test_labels_in_metres(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = [*(f"q{i}_cmd" for i in range(1, 7)), *(f"p{axis}_cmd" for axis in "xyz")]
    rows = [f"a,{i},0.001,0.002,0.003," + ",".join(["0.1"] * 9) for i in range(30)]
    (folder / "m.csv").write_text("\n".join(["run,t_s,ex,ey,ez," + ",".join(names), *rows]) + "\n")
    words = ["dataset", str(folder / "m.csv"), "--robot", "dvrk-psm"]
    assert main([*words, "-o", str(folder / "no.parquet")]) == 2
    told = capsys.readouterr().err
    assert "labels of 0.0037 (median) are not millimetres" in told
    assert told.count("\n") == 1
    assert not (folder / "no.parquet").exists()


pytest.importorskip("onnx", reason="fitting needs the extra 'train'")


@pytest.mark.usefixtures("signals")
def test_live_states_that_cannot_be_corrected(
    folder: Path, small: Dataset, capsys: pytest.CaptureFixture[str]
) -> None:
    """Wrong count, NaN, stale stamp, reordering, garbage: each answered with its reason."""
    port, state = free_port(socket.SOCK_DGRAM), small.states[0]
    capsys.readouterr()
    broken = np.where(np.arange(len(state)) == 7, np.nan, state)
    sent: list[tuple[int, float, Floats, Refusal | None]] = [
        (5, 1.0, state, None),
        (7, 1.2, state, None),  # 6 is lost
        (6, 1.3, state, Refusal.REPEATED),
        (8, 1.2, state, Refusal.STALE),
        (8, 1.3, state[:-1], Refusal.FEATURE_COUNT),
        (8, 1.3, broken, Refusal.NOT_A_NUMBER),
        (8, 1.3, state, None),
    ]
    heard = list[AnswerPacket]()

    def ask() -> None:
        with closing(_client(port, state)) as client:
            packets = [StatePacket(number, at_s, values).pack() for number, at_s, values, _ in sent]
            heard.extend(_asked(client, packet) for packet in (*packets, b"garbage"))
        signal.raise_signal(signal.SIGINT)

    robot = threading.Thread(target=ask)
    robot.start()
    words = ["estimate", str(folder / "model.onnx"), "--port", str(port), "--seconds", "60"]
    assert main([*words, "--json"]) == 0
    robot.join()
    *answers, last = heard
    for answer, (sequence, *_, wanted) in zip(answers, sent, strict=True):
        assert answer.sequence == sequence
        assert isinstance(answer.answer, Correction) if wanted is None else answer.answer is wanted
    assert last.answer is Refusal.MALFORMED
    counts = json.loads(capsys.readouterr().out)
    assert counts["lost"] == 5  # 1 to 4 and 6
    refused = {wanted for *_, wanted in sent if wanted} | {Refusal.MALFORMED}
    assert {reason: counts[reason] for reason in Refusal} == {r: r in refused for r in Refusal}


def _client(port: int, state: Floats) -> EstimateClient:
    """Connected, once the server answers."""
    client = EstimateClient(("127.0.0.1", port), timeout_s=20.0)
    for _ in range(200):
        client.send(StatePacket(0, 0.0, state).pack())
        if client.receive() is not None:
            return client
        time.sleep(0.02)
    raise AssertionError("the server does not answer")


def _asked(client: EstimateClient, data: bytes) -> AnswerPacket:
    client.send(data)
    answer = client.receive()
    assert answer is not None
    return answer
