"""A laboratory's one bag, pictures and joints in it: measured, registered, paired by commands."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from measure.cli import main
from measure.geometry import RigidTransform
from measure.model import paper_body
from measure.session import Trajectory, dump_toml
from measure.simulation import Lighting, Material, Scene
from measure.simulation.catalogue import WORKSPACE_MM, lamps, paper_rig, stems
from measure_learning.core.frames import read_frame
from measure_learning.robots import find_schema
from tests.session.test_bag_pictures import START_S, Bag
from tests.simulated.sessions import rendered

rosbags = pytest.importorskip("rosbags")
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
HOME = np.deg2rad([0.0, -100, -110, -60, 90, 0])
HAND = RigidTransform.from_rotvec([0.0, 0.1, 0.3], [5.0, -4.0, 40.0])
LATE_S = 0.3
"""Of the joints' stamps against those of the pictures."""


def moved(times: np.ndarray) -> np.ndarray:
    """Joints (n, 6) in rad: the wrist turns by 12 degrees either way, the arm by 2."""
    rates, swing = np.array([0.5, 0.7, 0.9, 1.1, 0.8, 1.3]), np.deg2rad([2, 2, 2, 12, 12, 12])
    return HOME + swing * np.sin(rates * times[:, None] + np.arange(6))


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, RigidTransform]:
    """A session folder with one bag, and where the arm's base is."""
    folder = tmp_path_factory.mktemp("laboratory")
    chain = find_schema("ur5e").chain
    at_home = chain.pose(HOME) @ HAND
    base = RigidTransform(np.eye(3), WORKSPACE_MM) @ at_home.inverse()
    times, logged = np.arange(0.0, 18.0, 0.4), np.arange(-1.0, 19.0, 0.02)
    way = Trajectory(logged, base @ chain.pose(moved(logged)) @ HAND)
    body, light = paper_body(), Lighting(lamps(1), (0.15,) * 3, (0.12,) * 3, shadows=True)
    finish, rig = Material((1.0, 1.0, 1.0), 0.03, 0.08), paper_rig()
    scene = Scene("arm", body, rig, way, light, finish=finish, attached=stems(body), seed=1)
    made = rendered(scene, times)
    with Bag(folder / "lab.mcap") as bag:
        for camera in (c.name for c in rig):
            stamps = np.loadtxt(made / f"{camera}.csv", delimiter=",", skiprows=1)[:, 1]
            pictures = sorted(made.joinpath(camera).glob("*.jpg"))
            for time_s, file in zip(stamps, pictures, strict=True):
                topic = f"/{camera}/image_raw/compressed"
                bag.jpeg(topic, START_S + time_s, file.read_bytes())
        names = [f"{joint}_joint" for joint in JOINTS]
        for time_s, q in zip(logged + START_S + LATE_S, moved(logged), strict=True):
            bag.joints("/joint_states", time_s, names, q)
    for name in ("calibration.toml", "body.toml"):
        shutil.copy(made / name, folder)
    tables = [{"name": c.name, "video": f"lab#/{c.name}/image_raw/compressed"} for c in rig]
    about = {"name": "arm", "body": "body.toml", "calibration": "calibration.toml"}
    (folder / "session.toml").write_text(dump_toml({"session": about, "cameras": tables}))
    return folder, base


@pytest.mark.slow
def test_one_bag_is_enough(
    arm: tuple[Path, RigidTransform], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, base = arm
    run, frame = str(tmp_path / "run"), str(tmp_path / "frame.toml")
    robot = ["--robot-log", str(folder / "lab"), "--robot", "ur5e"]
    assert main(["run", str(folder), "-o", run, "--images", "none"]) == 0
    assert main(["register", run, *robot, "-o", frame]) == 0
    found = read_frame(Path(frame))
    # Poses of a quarter of a millimetre, and links that may be off by half.
    off = found.world_from_base.difference(base)
    sd = np.sqrt(np.diag(found.covariance)[:6])
    assert np.all(np.abs(off) < 4 * sd)
    capsys.readouterr()
    words = ["--frame", frame, "-o", str(tmp_path / "data.parquet"), "--json"]
    assert main(["dataset", run, *robot, *words]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["labels"]["rms_mm"] < 1.0
    assert said["recordings"][0]["clock"]["offset_s"] == pytest.approx(LATE_S, abs=0.02)
