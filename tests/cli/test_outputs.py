"""One rule for every output: what is there stays, unless `--overwrite` says otherwise."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from measure import api
from measure.api.outputs import check_folder
from measure.cli import build_app, main
from measure.errors import CalibrationError, ConfigError, PluginError
from measure.neighbours import commands
from measure.session import Calibration

RUN, RECORDING = "run.toml", "session.toml"
# By command: what is there in a folder (of a file nothing), and arguments that stand for nothing.
COMMANDS: dict[str, tuple[str, ...]] = {
    "accept": ("", "none", "--lengths", "none"),
    "body": ("", "none", "--radius-mm", "20"),
    "calibrate": ("", "none"),
    "capture": ("capture.toml", "cam0=none", "--board", "charuco_8x5_27"),
    "dataset": ("", "none"),
    "demo": ("session/session.toml", "--frames", "0"),
    "detect": ("none.png", "none.png", "--body", "none"),
    "estimate": ("", "none", "--input", "none"),
    "export": ("", "none", "--format", "csv"),
    "live": (RUN, "none0", "none1", "--calibration", "rig.toml", "--body", "none"),
    "mend": (RECORDING, "none"),
    "pivot": ("", "none"),
    "recalibrate": ("", "shipped", "none"),
    "record": (RECORDING, "cam0=none"),
    "refine": ("", "none"),
    "register": ("",),
    "report": ("", "none"),
    "run": (RUN, "none"),
    "simulate": (RECORDING, "--seconds", "0"),
    "sync": ("", "none"),
    "target": ("", "none.toml"),
    "train": ("", "none"),
    "world": ("", "none", "--run", "none"),
}
FURTHER = {  # Outputs beside `--out`, and what they ask for
    "calibrate --report": ("",),
    "detect --write-body": ("", "--sample", "red=1,2"),
    "live --record": (RECORDING,),
    "refine --body-output": ("",),
}


def test_every_command_with_an_output_is_here_and_says_the_same() -> None:
    app = build_app()
    options = {
        name: {
            o: a
            for a in app[name].assemble_argument_collection(parse_docstring=True)
            for o in a.names
        }
        for name in commands()
    }
    assert {name for name, known in options.items() if "--out" in known} == COMMANDS.keys()
    for name in COMMANDS:
        assert options[name]["--overwrite"].parameter.help == "Replace what is there."
    for command in FURTHER:
        name, option = command.split()
        assert option in options[name]


@pytest.fixture
def folder(tmp_path: Path, rig, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    api.write_calibration(tmp_path / "rig.toml", Calibration(rig[:2]))
    return tmp_path


def _there(out: Path, inside: str) -> Path:
    """What must not be lost: a file, or one in a folder."""
    precious = out / inside
    precious.parent.mkdir(parents=True, exist_ok=True)
    precious.write_text("weeks of work")
    return precious


def _all_files(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("command", [*COMMANDS, *FURTHER])
def test_what_is_there_stays(folder: Path, capsys, command: str) -> None:
    """Refused at once, by the file's name and the option; with it a failure leaves the old."""
    name, option = command.split() if " " in command else (command, "--out")
    inside, *words = COMMANDS[name]
    if command in FURTHER:
        inside, *more = FURTHER[command]
        words += [] if name == "detect" else ["--out", "new"]
        words += more
    out = folder / "there.x"
    precious = _there(out, inside)
    before = _all_files(folder)
    words = [name, *words, option, str(out)]
    assert main(words) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert f"{precious if name == 'detect' else out}: is there already: --overwrite" in line
    assert _all_files(folder) == before
    assert main([*words, "--overwrite"]) == 2
    assert "is there already" not in capsys.readouterr().err
    assert _all_files(folder) == before
    assert {path.name for path in folder.iterdir()} <= {"there.x", "rig.toml"}


def test_a_file_takes_its_place_whole(tmp_path: Path) -> None:
    out = tmp_path / "new" / "table.csv"
    with api.output(out, beside=[".card"]) as file:
        file.write_text("1")
        file.with_suffix(".card").write_text("2")
        assert not out.exists()
    assert out.read_text() + out.with_suffix(".card").read_text() == "12"
    with (
        pytest.raises(ConfigError, match=r"table\.card: is there already"),
        api.output(tmp_path / "new" / "table.txt", beside=[".card"]),
    ):
        pass
    for problem in (KeyboardInterrupt, CalibrationError):
        with pytest.raises(problem, match=r"^$|table\.csv is none$") as caught:
            _fail_half_way(out, problem)
        assert ".new-" not in str(caught.value)
    assert out.read_text() == "1"
    assert sorted(path.name for path in out.parent.iterdir()) == ["table.card", "table.csv"]


def _fail_half_way(out: Path, problem: type[BaseException]) -> None:
    with api.output(out, overwrite=True) as file:
        file.write_text("half")
        raise problem(f"{file} is none" if problem is CalibrationError else "")


def test_only_a_folder_of_its_kind_is_replaced(tmp_path: Path) -> None:
    out = tmp_path / "session"
    _there(out, "thesis.txt")
    before = _all_files(tmp_path)
    with pytest.raises(ConfigError, match="holds no session"), api.new_folder(out, True, RECORDING):
        pass
    assert _all_files(tmp_path) == before
    _there(out, RECORDING)
    with api.new_folder(out, True, RECORDING):
        assert not out.exists()
        _there(out, "new.txt")
    assert [path.name for path in out.iterdir()] == ["new.txt"]
    assert [path.name for path in tmp_path.iterdir()] == ["session"]


@pytest.mark.parametrize("there", [False, True])
def test_of_a_new_folder_nothing_is_left_where_it_was_not_finished(tmp_path: Path, there) -> None:
    out = tmp_path / "session"
    if there:
        out.mkdir()

    def interrupt() -> None:
        _there(out, "cam0.csv")
        _there(out / "cam0", "000000.jpg")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), api.new_folder(out, False, RECORDING):
        interrupt()
    assert _all_files(tmp_path) == {}
    assert out.exists() == there


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes that have a name")
def test_what_is_no_ordinary_file_is_not_replaced(tmp_path: Path) -> None:
    """As root a device node would become a file."""
    pipe, link = tmp_path / "pipe", tmp_path / "link"
    os.mkfifo(pipe)
    link.symlink_to("/dev/null")
    for out, what in ((Path("/dev/null"), "a device"), (pipe, "a pipe"), (link, "a link to")):
        with pytest.raises(ConfigError, match=f"{out}: is {what}"), api.output(out, overwrite=True):
            pass
    assert Path("/dev/null").is_char_device()
    assert pipe.is_fifo()
    (tmp_path / "real").mkdir()
    (tmp_path / "to-real").symlink_to(tmp_path / "real")
    with pytest.raises(ConfigError, match=r"to-real: is a link to .*give the folder"):
        check_folder(tmp_path / "to-real", True, RECORDING)


HOLDING = """
import sys, time
from pathlib import Path
from measure import api

with api.output(Path(sys.argv[1])) as file:
    file.write_text("half")
    print("there", flush=True)
    time.sleep(60)
"""


def test_scratch_of_killed_processes_is_removed_and_that_of_living_ones_is_not(
    tmp_path: Path,
) -> None:
    command = [sys.executable, "-c", HOLDING]
    users = [subprocess.Popen([*command, tmp_path / name], stdout=subprocess.PIPE) for name in "ab"]
    try:
        for user in users:
            assert user.stdout.readline() == b"there\n"
        mine = tmp_path / ".new-abcdefgh"  # of a user's own
        mine.mkdir()
        assert len(list(tmp_path.glob(".new-*.lock"))) == 2
        users[0].kill()
        users[0].wait()
        assert len(list(tmp_path.glob(".new-*/*"))) == 2
        with api.output(tmp_path / "c") as file:
            file.write_text("whole")
        (left,) = tmp_path.glob(".new-*/*")
        assert left.name == "b"
        users[1].kill()
        users[1].wait()
        with api.output(tmp_path / "d") as file:
            file.write_text("whole")
        assert sorted(path.name for path in tmp_path.iterdir()) == [mine.name, "c", "d"]
    finally:
        for user in users:
            user.kill()
            user.communicate()


def test_a_full_disk_is_named_with_the_file_whoever_met_it(tmp_path: Path) -> None:
    """A plugin's own words for it tell neither."""
    out = tmp_path / "model.onnx"
    for number, why in ((errno.ENOSPC, "is full"), (errno.EFBIG, "it is larger than files may be")):
        fault = OSError(number, os.strerror(number))
        for problem in (fault, PluginError("estimator 'offset' fails")):
            problem.__cause__ = None if problem is fault else fault
            with (
                pytest.raises(ConfigError, match=f"model.onnx: cannot be written: .*{why}"),
                api.output(out),
            ):
                raise problem
    with pytest.raises(OSError, match="elsewhere"), api.output(out):
        raise OSError(errno.ENOENT, "elsewhere")
