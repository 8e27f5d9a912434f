"""Other authors' distributions, built, installed, and used by the real command."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from measure.cli import main
from measure.session import read_calibration
from measure.simulation import Still
from measure.testing import example
from tests.calibration.altered import AlteredCapture
from tests.simulated.sessions import rendered
from tests.third_party.conftest import HERE, WHOLE, Environment

pytestmark = pytest.mark.slow

STEADY = """name = "steady"
detector = "blob"
triangulator = "reprojection"
solver = "kabsch"
tracking = "steady"
per_image_timestamps = true
smoothing = false
"""
WITHOUT_CLASH = ("--disable", "acme-clashing")


def test_the_program_is_the_installed_one(environment: Environment):
    code = "import measure, measure_plugins as p; print(measure.__file__, p.__file__)"
    done = environment.run(environment.program("python"), "-c", code)
    assert done.returncode == 0, done.stderr
    assert all(place.startswith(str(environment.folder)) for place in done.stdout.split())


def test_printable_targets_are_installed_with_it(environment: Environment, tmp_path):
    shipped = sorted(path.name for path in (HERE.parents[1] / "calibration_targets").glob("*.toml"))
    assert shipped
    help_text = environment.measure("target", "--help").stdout
    assert all(name.removesuffix(".toml") in help_text for name in shipped)
    sheet = str(tmp_path / "sheet.svg")
    assert environment.measure_json("target", shipped[0], "--out", sheet)["output"] == sheet


@pytest.fixture(scope="module")
def listed(environment: Environment) -> dict[str, Any]:
    """Everything that is installed, with what is wrong with it."""
    return environment.measure_json("plugins", "list")


def test_a_plugin_is_listed_beside_the_built_ins(listed):
    plugins = [p for p in listed["plugins"] if p["distribution"]["name"] != "acme-clashing"]
    (blob,) = [p for p in plugins if p["name"] == "blob"]
    assert blob["kind"] == "detector"
    assert blob["distribution"] == {"name": "acme-blob", "version": "0.3.1"}
    assert blob["summary"] == "Patches of a ball's colour by connected components."
    owners = {p["distribution"]["name"] for p in plugins}
    assert owners == {"triball", *(f"acme-{name}" for name in WHOLE)} - {"acme-count", "acme-rows"}


def test_broken_plugins_are_survived_with_their_reasons(listed):
    reasons = {item["distribution"]["name"]: item["error"] for item in listed["broken"]}
    assert set(reasons) == {"acme-broken", "acme-wrong-hook"}
    assert "No module named 'a_library_that_nobody_has'" in reasons["acme-broken"]
    assert "{'config'} are declared in the hookimpl" in reasons["acme-wrong-hook"]


def test_a_clash_is_reported_naming_both(listed):
    (clash,) = listed["clashes"]
    owners = {item["name"] for item in clash["distributions"]}
    assert (clash["kind"], clash["name"], owners) == (
        "detector",
        "blob",
        {"acme-blob", "acme-clashing"},
    )


def test_plugins_pass_the_conformance_kit_in_their_own_tests(environment: Environment):
    settings = environment.folder / "pytest.ini"
    settings.write_text("[pytest]\n")
    command = (environment.program("python"), "-m", "pytest", "-v", "-p", "no:cacheprovider")
    own = [str(HERE / name / "tests" / f"test_{name}.py") for name in WHOLE]
    done = environment.run(*command, "-c", str(settings), "--noconftest", *own)
    assert done.returncode == 0, done.stdout
    assert all(f"::Test{name.title()}::" in done.stdout for name in WHOLE)


@pytest.fixture(scope="module")
def session() -> Path:
    """Two frame sets of a body that stands still."""
    scene = example()
    return rendered(replace(scene.scene, trajectory=Still(scene.world_from_body)), [0.0, 0.1])


@pytest.fixture(scope="module")
def run(environment: Environment, session, tmp_path_factory) -> Path:
    """The recording, measured by others' stages."""
    out = tmp_path_factory.mktemp("measured") / "run"
    stages = ("--triangulator", "nearest", "--solver", "rigid", "--profile", "steady.toml")
    (environment.folder / "steady.toml").write_text(STEADY)
    with pytest.MonkeyPatch.context() as patch:
        # Compiling hot loops once more, in another place, costs more than running them as Python.
        patch.setenv("NUMBA_DISABLE_JIT", "1")
        done = environment.measure(
            *("run", str(session), "--out", str(out), *stages),
            *("--detector", "blob", "--set", "detector.roundness=0.7", "--no-recording", "--json"),
            *WITHOUT_CLASH,
        )
    assert done.returncode == 0, done.stderr
    json.loads(done.stdout)
    return out


def test_plugins_measure_a_recording(run):
    header, *rows = (run / "poses.csv").read_text().splitlines()
    assert len(rows) == 2
    names = header.split(",")
    for row in rows:
        values = dict(zip(names, row.split(","), strict=True))
        position = [float(values[name]) for name in ("x_mm", "y_mm", "z_mm")]
        # Patches are no outlines: half a pixel of bias and partly hidden balls cost about 1 mm.
        off = np.linalg.norm(position - example().world_from_body.translation)
        assert off < 3, f"{off:.2f} mm off"
    assert "acme-blob" in (run / "run.toml").read_text()


def test_a_command_is_listed_and_runs(environment: Environment, run):
    assert "count    Count the poses of runs." in environment.measure("--help").stdout
    assert environment.measure_json("count", str(run)) == {str(run): 2}


def test_a_format_is_read_and_written(environment: Environment, session, run, tmp_path):
    code = (
        "import sys; from measure import api\n"
        "read, out = api.read_calibration, sys.argv[2]\n"
        "api.write_calibration(out, read(sys.argv[1]), 'rows')\n"
        "print(read(out).names == read(sys.argv[1]).names)"
    )
    given = (str(session / "calibration.toml"), str(tmp_path / "rig.rows"))
    done = environment.run(environment.program("python"), "-c", code, *given)
    assert done.stdout == "True\n", done.stderr
    done = environment.measure("export", str(run), "--format", "rows")
    assert done.returncode == 0, done.stderr
    lines = (run / "export.rows").read_text().splitlines()
    assert [set(json.loads(line)) for line in lines] == [
        {"body", "time_s", "x_mm", "y_mm", "z_mm"}
    ] * 2


def test_a_camera_fit_is_chosen_by_name(environment: Environment, renders, tmp_path):
    capture = AlteredCapture(renders / "E_calibration", tmp_path / "capture", ["cam0", "cam1"])
    out = tmp_path / "cameras.toml"
    words = ("calibrate", str(capture.folder), "--method", "pnp", "--out", str(out))
    assert environment.measure_json(*words)["method"] == "pnp"
    true = read_calibration(renders / "E_calibration" / "truth_calibration.toml")
    for camera in read_calibration(out).cameras:
        off = camera.center - true.camera(camera.name).center
        assert off @ np.linalg.solve(camera.pose_covariance[:3, :3], off) < 20


@pytest.fixture
def without(environment: Environment) -> Iterator[Callable[[str], None]]:
    """Takes a package out of the environment, until the test ends."""
    code = "import measure; print(measure.__file__)"
    place = Path(environment.run(environment.program("python"), "-c", code).stdout.strip())
    site, taken = place.parents[1], []

    def take(name: str) -> None:
        (site / name).rename(environment.folder / name)
        taken.append(name)

    yield take
    for name in taken:
        (environment.folder / name).rename(site / name)


def test_what_is_missing_is_named_and_the_rest_works(
    environment: Environment, session, tmp_path, without, monkeypatch, renders
):
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    names = ("lab", "learning", "studio", "formats", "sinks")
    for name in names:
        without(f"measure_{name}")
    words = ("run", str(session), "-o", str(tmp_path / "run"), "--profile", "paper")
    assert environment.measure(*words, "--no-recording", *WITHOUT_CLASH).returncode == 0
    listed = environment.measure("--help").stdout
    assert " run " in listed
    assert " register " not in listed
    for command, package in (("rests", "lab"), ("train", "learning"), ("studio", "studio")):
        done = environment.measure(command, "x")
        assert done.returncode == 2
        assert f"`measure {command}` comes with the package measure_{package}" in done.stderr
        assert done.stderr.count("\n") == 1
    done = environment.measure("view", str(tmp_path / "run"), "--robot", "raven")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "`--robot` comes with the package measure_learning" in done.stderr
    done = environment.measure("export", str(tmp_path / "run"), "--format", "csv")
    assert done.returncode == 2
    assert "no export format is called 'csv'" in done.stderr
    without("measure_paper")
    words = ("--method", "paper", "--out", str(tmp_path / "c.toml"))
    done = environment.measure("calibrate", str(renders / "E_calibration"), *words)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "`--method paper` comes with the package measure_paper" in done.stderr


def test_an_estimator_learns_and_its_model_runs_without_it(environment: Environment, tmp_path):
    data, model, out = (str(tmp_path / n) for n in ("sim.parquet", "m.onnx", "out.parquet"))
    assert main(["dataset", "--simulate-min", "2", "--seed", "3", "--out", data]) == 0
    for words in (
        ("train", data, "--estimator", "linear", "--out", model),
        ("estimate", model, "--input", data, "--out", out, "--disable", "linear"),
    ):
        done = environment.measure(*words, *WITHOUT_CLASH)
        assert done.returncode == 0, done.stderr
    assert Path(out).exists()


@pytest.mark.parametrize(
    ("detector", "message"),
    [
        ("blob", "detector 'blob' is offered by acme-"),
        ("broken", "detector 'broken' of acme-broken 1.0 is broken: ModuleNotFoundError"),
    ],
)
def test_what_cannot_be_used_stops_the_run_that_names_it(
    environment: Environment, session, tmp_path, detector, message
):
    done = environment.measure(
        "run", str(session), "--out", str(tmp_path / "run"), "--detector", detector
    )
    assert done.returncode == 2
    assert done.stderr.startswith(f"measure: {message}")
    assert done.stderr.count("\n") == 1
