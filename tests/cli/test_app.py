"""The frame: exit codes, one-line errors, lazy imports."""

from __future__ import annotations

import errno
import importlib
import io
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from cyclopts import App

from measure.cli import build_app, console, main
from measure.errors import PluginError, SessionError
from measure.neighbours import commands, load_command
from measure_studio.cli.live import _StateLines
from tests.measurements import measurement

pytestmark = pytest.mark.usefixtures("signals")


def _register(monkeypatch: pytest.MonkeyPatch, function) -> None:
    """Add a sub-command "try" that calls `function`."""

    def built():
        app = build_app()
        app.command(function, name="try")
        return app

    monkeypatch.setattr("measure.cli.app.build_app", built)


def _raise(error: BaseException):
    def function() -> None:
        raise error

    return function


def test_a_mistake_is_one_line_and_exit_code_2(monkeypatch, capsys):
    _register(monkeypatch, _raise(SessionError("session.toml, line 3:\n  no such camera 'cam9'")))
    assert main(["try"]) == 2
    out, err = capsys.readouterr()
    assert (out, err) == ("", "measure: session.toml, line 3: no such camera 'cam9'\n")


def test_a_defect_keeps_its_traceback(monkeypatch):
    _register(monkeypatch, _raise(ZeroDivisionError("ours")))
    with pytest.raises(ZeroDivisionError, match="ours"):
        main(["try"])


def test_ctrl_c_is_one_line_and_exit_code_130(monkeypatch, capsys):
    _register(monkeypatch, _raise(KeyboardInterrupt()))
    assert main(["try"]) == 130
    assert capsys.readouterr().err == "measure: interrupted\n"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_any_command_as_an_interruption_does(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], number: signal.Signals
) -> None:
    given_up = []

    def work() -> None:
        try:
            os.kill(os.getpid(), number)
        finally:
            os.kill(os.getpid(), number)  # `timeout` sends two: what is given up is so all the same
            given_up.append(True)

    _register(monkeypatch, work)
    assert main(["try"]) == 128 + number
    assert capsys.readouterr().err == f"measure: ended by {number.name}\n"
    assert given_up
    assert signal.getsignal(number) is signal.SIG_DFL


def test_a_signal_that_comes_while_an_object_is_destroyed_ends_the_command_all_the_same(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What is raised there Python swallows: a compilation destroys thousands."""

    class Destroyed:
        def __del__(self) -> None:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.001)

    def work() -> None:
        one = Destroyed()
        del one
        time.sleep(20)

    _register(monkeypatch, work)
    begun_s = time.monotonic()
    assert main(["try"]) == 143
    assert time.monotonic() - begun_s < 10
    assert capsys.readouterr().err == "measure: ended by SIGTERM\n"


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError("can't start new thread"),
        OSError(errno.ENOMEM, "Cannot allocate memory"),
        ValueError("OpenCV(5.0) (-4:Insufficient memory) Failed to allocate 5529600 bytes"),
        SessionError("detector 'outline' fails: MemoryError"),
    ],
    ids=repr,
)
def test_too_little_memory_is_one_line(monkeypatch, capsys, error: Exception) -> None:
    """Whoever asked for it in vain: 1.5 GB of address space are not enough."""
    if isinstance(error, SessionError):
        error.__cause__ = MemoryError()
    _register(monkeypatch, _raise(error))
    assert main(["try"]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert "memory" in line
    assert "detector" not in line


def test_a_limit_on_addresses_is_told_before_libraries_crash_of_it(monkeypatch, capsys) -> None:
    _register(monkeypatch, lambda: None)
    for limit, code in ((1_500_000_000, 2), (4_000_000_000, 0)):
        monkeypatch.setattr("measure.cli.app.address_space_bytes", lambda limit=limit: limit)
        assert main(["try"]) == code
    line = capsys.readouterr().err
    assert "may have 1.5 GB of address space (`ulimit -v`), and 3.5 GB are needed" in line
    assert line.count("\n") == 1


def test_a_signal_that_is_ignored_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """As `nohup` has it."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        _register(monkeypatch, lambda: os.kill(os.getpid(), signal.SIGHUP))
        assert main(["try"]) == 0
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize(
    ("key", "mm", "said"),
    [
        ("square_mm", "1e300", "expected a finite number within 1e+09"),
        ("marker_mm", "1e-300", "input should be "),
    ],
)
def test_a_size_that_cannot_be_printed(tmp_path, capsys, key, mm, said):
    """Drawing would end in a traceback."""
    board = (Path(__file__).parents[2] / "calibration_targets/charuco_8x5_27.toml").read_text()
    lines = [f"{key} = {mm}" if line.startswith(key) else line for line in board.splitlines()]
    target = tmp_path / "board.toml"
    target.write_text("\n".join(lines))
    assert main(["target", str(target), "--out", str(tmp_path / "sheet.pdf")]) == 2
    place = f"{target}:{lines.index(f'{key} = {mm}') + 1}: '{key}'"
    assert capsys.readouterr().err.startswith(f"measure: {place}: {said}")


@pytest.mark.parametrize(
    "number", [errno.ENOENT, errno.EISDIR, errno.ENOTDIR, errno.EEXIST, errno.ENOSPC]
)
def test_a_path_that_is_none_of_ours_is_a_mistake(monkeypatch, capsys, number):
    _register(monkeypatch, _raise(OSError(number, "cannot", "nowhere/out.toml")))
    assert main(["try"]) == 2
    assert capsys.readouterr().err == "measure: nowhere/out.toml: cannot\n"


def test_the_folder_of_an_output_is_made(tmp_path):
    target = Path(__file__).parents[2] / "calibration_targets/raven_three_ball.toml"
    sheet = tmp_path / "none/sheet.pdf"
    assert main(["target", str(target), "--out", str(sheet)]) == 0
    assert sheet.stat().st_size


def test_a_profile_whose_package_is_missing_is_left_out_of_what_is_prepared(monkeypatch, capsys):
    def demo(folder, profile, *_):
        if profile.name == "paper":
            raise PluginError("no detector is called 'hough'")

    monkeypatch.setattr("measure.api.demo", demo)
    assert main(["prepare"]) == 0
    assert "left out profile paper: no detector is called 'hough'" in capsys.readouterr().out


@pytest.mark.parametrize("name", [importlib.import_module("measure.errors").__file__, None])
def test_other_errors_of_the_system_are_defects(monkeypatch, name):
    """A file of the program's own that is not there, or none that is named."""
    _register(monkeypatch, _raise(FileNotFoundError(2, "No such file", name)))
    with pytest.raises(FileNotFoundError):
        main(["try"])


def test_the_integer_a_command_returns_is_the_exit_code(monkeypatch):
    _register(monkeypatch, lambda: 3)
    assert main(["try"]) == 3


@pytest.mark.parametrize(
    ("tokens", "message"),
    [
        (["rnu"], "there is no command 'rnu'. Did you mean run?"),
        (["--disabel", "x"], "there is no option '--disabel'. Did you mean --disable?"),
        (["plugins", "--jsno"], "unknown option: --jsno. Did you mean --json?"),
        (["plugins", "show"], "plugins show needs NAME: "),
        (["run", "S"], "run needs --out (or -o): the run's folder, made if it is not there."),
        (["run", "S", "-o"], "run needs --out (or -o): the run's folder, made if it is not there."),
        (["refine", "S"], "refine needs --out (or -o): the calibration to write."),
        (["evaluate"], "evaluate needs RUN: "),
        (
            ["export", "R"],
            "(evo; metres), trc (OpenSim markers), c3d (markers) or mcap (ROS 2; metr",
        ),
        (["plugins", "show", "a", "b"], "'b'"),
    ],
)
def test_usage_errors_are_one_line_and_exit_code_2(capsys, tokens, message):
    assert main(tokens) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert message in err
    assert err.startswith("measure: ")
    assert err.count("\n") == 1
    assert "--help`." in err


def _python(*arguments: str, **options) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, check=False, **options
    )


def test_help_imports_nothing_heavy():
    code = (
        "import sys, json; from measure.cli import main; main(['--help']);"
        "print(json.dumps(sorted(sys.modules)))"
    )
    modules = set(json.loads(_python("-c", code).stdout.splitlines()[-1]))
    assert "cyclopts" in modules
    assert not modules & {
        "numpy", "cv2", "scipy", "rerun", "plotly", "pydantic", "pluggy", "torch", "numba", "av",
        "pyarrow", "onnxruntime", "measure.host", "measure.api",
    }  # fmt: skip


def test_a_run_imports_no_more_than_it_uses():
    """Imports took half of the time of a short recording, `scipy.stats` a quarter of that."""
    code = "import sys; from measure import api; api.run; print(*sys.modules)"
    modules = set(_python("-c", code).stdout.split())
    assert "measure.measuring.pipeline" in modules
    assert not modules & {
        "scipy.signal", "scipy.stats", "rerun", "plotly", "torch", "onnxruntime",
        "scipy.optimize", "scipy.interpolate", "pandas", "measure.results.evaluation",
        "measure.calibration", "measure_studio.capture", "measure.simulation",
    }  # fmt: skip


def test_functions_of_api_load_when_they_are_asked_for():
    code = (
        "import measure.api.run, measure.api.check, sys; from measure import api;"
        "assert 'measure.api.refining' not in sys.modules;"
        "print(*map(callable, (api.run, api.check, api.refine)), {*api.__all__} - {*dir(api)})"
    )
    assert _python("-c", code).stdout.split() == ["True", "True", "True", "set()"]
    with pytest.raises(AttributeError, match="no attribute 'walk'"):
        _ = importlib.import_module("measure.api").walk


def _cpu_s(*arguments: str) -> float:
    """Least CPU time of three runs, children of children not counted."""
    code = (
        "import resource, subprocess, sys;"
        "subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL, check=True);"
        "used = resource.getrusage(resource.RUSAGE_CHILDREN);"
        "print(used.ru_utime + used.ru_stime)"
    )
    command = ("-c", code, sys.executable, *arguments)
    return min(float(_python(*command).stdout) for _ in range(3))


def test_help_costs_little_cpu():
    """0.3 s, of which 0.17 s go to importing what prints it; a busy machine stretches both."""
    printer = _cpu_s("-c", "import cyclopts, rich.console, rich.panel, rich.table")
    assert _cpu_s("-m", "measure", "--help") < 3 * printer


@pytest.mark.parametrize("words", ["plugins list --json", "evaluate nowhere 2>&1"])
def test_a_closed_pipe_is_quiet(words):
    """The reader is gone before a word is written, so that every one of them meets it."""
    command = f"{{ sleep 0.5; exec {sys.executable} -m measure {words}; }} | true"
    done = subprocess.run(
        ["bash", "-c", f"set -o pipefail; {command}"], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (141, "")


def test_only_a_closed_pipe_ends_a_command_quietly(monkeypatch):
    _register(monkeypatch, _raise(SystemExit(3)))
    with pytest.raises(SystemExit, match="3"):
        main(["try"])


def test_closed_streams_are_no_error():
    command = f"{sys.executable} -m measure --version >&- 2>&-"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_letters_that_a_stream_does_not_know_are_escaped(monkeypatch):
    def say() -> None:
        console.print_text("2 px²")
        console.print_table(("µ",), [("°",)])
        console.print_json({"unit": "px²"})

    _register(monkeypatch, say)
    out = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", out)
    assert main(["try"]) == 0
    text, _, rest = out.buffer.getvalue().decode("ascii").partition("{")
    assert r"2 px\xb2" in text
    assert json.loads("{" + rest) == {"unit": "px²"}


def test_a_name_that_is_no_text_is_a_mistake(monkeypatch, tmp_path, capsys):
    _register(monkeypatch, lambda: (tmp_path / "run.toml").write_text("s\udcff", "utf-8"))
    assert main(["try"]) == 2
    assert r"s\udcff: a name that is not in UTF-8 cannot be" in capsys.readouterr().err
    toml = '[session]\nname = "still"\npath = "/data/f\udcff/rec/session.toml"\nsha256 = "ab"\n'
    _register(monkeypatch, lambda: (tmp_path / "run.toml").write_text(toml, "utf-8"))
    assert main(["try"]) == 2
    line = capsys.readouterr().err
    assert line.startswith(r"measure: /data/f\udcff/rec/session.toml: a name that is not in UTF-8")


@pytest.mark.parametrize("command", commands().values(), ids=lambda one: one.name)
def test_a_command_says_of_itself_what_the_table_says(command):
    target = load_command(command.name)
    own = target.help if isinstance(target, App) else target.__doc__
    assert own.partition("\n")[0] == command.line


@pytest.mark.parametrize("asked", [None, "3"])
def test_linear_algebra_stays_on_one_thread_unless_asked(asked):
    """It has to be said before NumPy is loaded."""
    code = (
        "import os, sys\n"
        "from measure.cli import main\n"
        "assert 'numpy' not in sys.modules\n"
        "main(['--version'])\n"
        "print('threads', os.environ['OPENBLAS_NUM_THREADS'])"
    )
    known = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
    given = known if asked is None else {**known, "OPENBLAS_NUM_THREADS": asked}
    ran = subprocess.run(
        [sys.executable, "-c", code], env=given, capture_output=True, text=True, check=True
    )
    assert ran.stdout.splitlines()[-1] == f"threads {asked or 1}"


@pytest.mark.parametrize("words", [["check"], ["plugins", "list"], []])
def test_what_few_need_stands_in_no_help(words, capsys):
    assert main([*words, "--help"]) == 0
    assert "--disable" not in capsys.readouterr().out
    assert main(["plugins", "list", "--disable", "hough"]) == 0
    assert "hough" not in capsys.readouterr().out


def test_help_lists_commands_in_the_order_of_their_use(capsys):
    assert main(["--help"]) == 0
    listed = re.findall(r"^│ (\w+) {2,}", capsys.readouterr().out, re.M)
    assert listed == list(commands())
    assert listed[:2] == ["demo", "studio"]


def test_completion_is_installed_where_the_shell_looks(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert main(["--install-completion", "--shell", "bash"]) == 0
    script = (tmp_path / ".local/share/bash-completion/completions/measure").read_text()
    assert "--clock-samples" in script
    assert all(name in script for name in commands())


def test_a_live_line_says_how_many_cameras_are_there(monkeypatch, capsys):
    monkeypatch.setattr("measure_studio.cli.live.LINE_EVERY_S", 0.0)
    cameras = dict.fromkeys(("cam0", "cam1", "cam2"))
    state = SimpleNamespace(
        latest=(), cameras=cameras, away=("cam1",), rate_hz=30.0, age_s=0.02, causes=()
    )
    _StateLines()(state)
    told = "2 of 3 cameras (cam1 away); 30.0 frame sets per s, known after 20 ms\n"
    assert capsys.readouterr().err == told
    latest = measurement(0, lost=True).without_images({"cam2": "cam0"}, (), {})
    _StateLines()(SimpleNamespace(**{**vars(state), "latest": (latest,), "away": ("cam1", "cam2")}))
    told = "1 of 3 cameras (cam1 away, cam2 shows the pictures of cam0)"
    assert told in capsys.readouterr().err
