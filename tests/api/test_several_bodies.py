"""Two bodies of equal colours in one recording, one relative to the other, by command line."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from measure.cli.app import main
from measure.geometry import RigidTransform
from measure.measuring import Status
from measure.model import Ball, BallColor, Body
from measure.results import read_run, read_runs
from measure.session import read_trajectory, write_body
from measure.simulation import Still
from measure.simulation.catalogue import stems, webcam_scene
from measure.simulation.scene import Actor, ball_shapes
from tests.simulated.mirroring import mirrored
from tests.simulated.sessions import rendered

FRAMES, GONE = 8, 2
"""In the last frame sets the reference is out of view."""
TOOL = {"green": (32.0, 0.0, 0.0), "yellow": (0.0, 34.0, 0.0), "red": (-30.0, -6.0, 8.0)}
BASE = {"green": (0.0, 40.0, 0.0), "yellow": (27.0, -22.0, 0.0), "red": (-25.0, -20.0, 4.0)}
TOOL_PLACE = RigidTransform.from_rotvec(np.array([0.1, -0.2, 0.3]), np.array([58.0, 5.0, 255.0]))
BASE_PLACE = RigidTransform.from_rotvec(np.array([0.2, -0.1, 2.4]), np.array([-58.0, 0.0, 240.0]))


def body(name, places):
    balls = (Ball(n, BallColor.named(n), np.array(p), 11.0) for n, p in places.items())
    return Body(name, tuple(balls))


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """Both at rest, before black cloth."""
    folder = tmp_path_factory.mktemp("two") / "session"
    tool, base = body("tool", TOOL), body("base", BASE)
    scene = mirrored(webcam_scene())
    scene = replace(
        scene,
        body=tool,
        trajectory=Still(TOOL_PLACE),
        attached=stems(tool),
        actors=(Actor((*ball_shapes(base, scene.finish), *stems(base)), Still(BASE_PLACE)),),
    )
    times = np.arange(FRAMES) / 30
    shutil.copytree(rendered(scene, times), folder)
    alone = rendered(replace(scene, name="alone", actors=()), times[-GONE:])
    for camera in scene.cameras:
        for k in range(GONE):
            picture = f"{camera.name}/{FRAMES - GONE + k:06d}.jpg"
            shutil.copy(alone / camera.name / f"{k:06d}.jpg", folder / picture)
    for one in (tool, base):
        write_body(folder / f"{one.name}.toml", one)
    (folder / "body.toml").unlink()
    file, truth = folder / "session.toml", ["time_s,body,x_mm,y_mm,z_mm,qw,qx,qy,qz"]
    bodies = 'bodies = ["tool.toml", "base.toml"]\nreference = "base"'
    file.write_text(file.read_text().replace('body = "body.toml"', bodies))
    for name, place in (("tool", TOOL_PLACE), ("base", BASE_PLACE)):
        row = ",".join(map(repr, [*place.translation.tolist(), *place.quat_wxyz.tolist()]))
        truth += [f"{t},{name},{row}" for t in (-1.0, 2.0)]
    (folder / "truth.csv").write_text("\n".join(truth) + "\n")
    return folder


@pytest.fixture(scope="module")
def run(session):
    out = session / "run"
    assert main(["run", str(session), "--out", str(out)]) == 0
    return out


@pytest.mark.slow
def test_each_is_measured_and_lost_on_its_own(run):
    tool, base = read_runs(run)
    assert [one.body.name for one in (tool, base)] == ["tool", "base"]
    assert tool.poses["status"].to_pylist() == ["ok"] * FRAMES
    assert base.poses["status"].to_pylist() == ["ok"] * (FRAMES - GONE) + ["lost"] * GONE
    for one, place in ((tool, TOOL_PLACE), (base, BASE_PLACE)):
        off = one.world_from_body.difference(place)
        assert np.linalg.norm(off[:, :3], axis=1).max() < 0.1
        assert np.degrees(np.linalg.norm(off[:, 3:], axis=1).max()) < 0.15


@pytest.mark.slow
def test_tables_have_a_row_a_body_and_frame_set(run):
    rows = list(csv.DictReader((run / "poses.csv").read_text().splitlines()))
    assert [(int(r["frame"]), r["body"]) for r in rows[:4]] == [
        (0, "tool"), (0, "base"), (1, "tool"), (1, "base"),
    ]  # fmt: skip
    assert len(rows) == 2 * FRAMES
    relative = list(csv.DictReader((run / "relative.csv").read_text().splitlines()))
    assert {(r["body"], r["reference"]) for r in relative} == {("tool", "base")}
    assert [r["status"] for r in relative] == ["ok"] * (FRAMES - GONE) + [str(Status.LOST)] * GONE
    assert relative[-1]["reason"].startswith("base: lost")
    truth = BASE_PLACE.inverse() @ TOOL_PLACE
    for r in relative[: FRAMES - GONE]:
        place = np.array([float(r[name]) for name in ("x_mm", "y_mm", "z_mm")])
        assert np.linalg.norm(place - truth.translation) < 3 * float(r["position_sd_mm"])


@pytest.mark.slow
def test_what_reads_runs_knows_bodies(run, tmp_path, capsys):
    assert main(["evaluate", str(run), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["bodies"]
    assert found["tool"]["frame_sets"] == FRAMES
    assert main(["report", str(run), "--out", str(tmp_path / "r.html")]) == 0
    page = (tmp_path / "r.html").read_text()
    assert "tool: Trajectory" in page
    assert "base: Trajectory" in page
    assert page.count('src="data:image/jpeg') == 1
    for file_format in ("csv", "trc"):
        out = tmp_path / f"x.{file_format}"
        assert main(["export", str(run), "-f", file_format, "-o", str(out)]) == 0
    assert "tool.green" in (tmp_path / "x.trc").read_text()
    assert (tmp_path / "x.csv").read_text().splitlines()[2].split(",")[:2] == ["0", "base"]
    assert main(["export", str(run), "-f", "tum", "-o", str(tmp_path / "x.tum")]) == 2
    assert "choose one with --body" in capsys.readouterr().err
    to_tum = ["export", str(run), "-f", "tum", "-o", str(tmp_path / "x.tum"), "--body", "base"]
    assert main(to_tum) == 0
    assert len(read_trajectory(tmp_path / "x.tum")) == FRAMES - GONE


@pytest.mark.slow
def test_one_of_them_alone_and_a_run_that_goes_on(session, run, tmp_path, capsys):
    with pytest.raises(Exception, match="several bodies, tool, base: choose one with --body"):
        read_run(run)
    before = (run / "poses.parquet").read_bytes(), (run / "relative.parquet").read_bytes()
    assert main(["run", str(session), "--out", str(run), "--resume"]) == 0
    assert before == ((run / "poses.parquet").read_bytes(), (run / "relative.parquet").read_bytes())
    twins = ["run", str(session), "--out", str(tmp_path / "x"), "--body"]
    again = tmp_path / "again.toml"
    again.write_text((session / "tool.toml").read_text().replace('"tool"', '"again"'))
    assert main([*twins, str(session / "tool.toml"), "--body", str(again)]) == 2
    assert "'tool' and 'again' cannot be distinguished" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()
