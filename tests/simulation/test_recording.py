"""Session folders written from scenes are read back as they were meant."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from measure.session import Calibration, open_session, read_calibration, write_calibration
from measure.simulation import write_session
from measure.simulation.renderer import Renderer
from measure.simulation.scene import Scene
from tests.simulated.catalogue import async_scene, scene_catalogue


def small(scene: Scene) -> Scene:
    """The same scene through cameras of a quarter of the size."""
    from measure.simulation.renderer import reduced

    cameras = tuple(replace(c, intrinsics=reduced(c.intrinsics, 4)) for c in scene.cameras)
    return replace(scene, cameras=cameras)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    scene = small(async_scene())
    folder = tmp_path_factory.mktemp("async")
    seen = []
    write_session(scene, np.arange(3) / 30, folder, progress=lambda *counts: seen.append(counts))
    assert sorted(seen) == [(k, 12) for k in range(1, 13)]
    return scene, folder


def test_an_interrupt_ends_all_cameras_after_the_picture_they_draw(tmp_path) -> None:
    """Whoever meets it: here a thread, by Ctrl-C the one that waits for all of them."""
    scene, seen = small(async_scene()), []

    def interrupt(done: int, total: int | None) -> None:
        seen.append(done)
        if done >= 6:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_session(scene, np.arange(200) / 30, tmp_path, progress=interrupt)
    assert len(seen) <= 6 + 2 * len(scene.cameras)
    assert not (tmp_path / "session.toml").exists()


def test_session_reads_back(recorded) -> None:
    scene, folder = recorded
    session = open_session(folder)
    assert session.name == "async"
    assert session.body.names == scene.body.names
    assert np.array_equal(session.body.centers, scene.body.centers)
    for read, true in zip(session.cameras, scene.cameras, strict=True):
        points = np.array([[0.0, 0.0, 250.0], [50.0, -40.0, 280.0]])
        assert np.abs(read.project(points) - true.project(points)).max() < 1e-9


def test_stamps_are_nominal_times_and_phase(recorded) -> None:
    scene, folder = recorded
    for name, phase in scene.phases_s.items():
        rows = np.loadtxt(folder / f"{name}.csv", delimiter=",", skiprows=1)
        assert np.abs(rows[:, 1] - (np.arange(3) / 30 + phase)).max() < 1e-9


def test_pictures_are_the_rendered_ones(recorded) -> None:
    scene, folder = recorded
    name = scene.cameras[1].name
    phase = scene.phases_s[name]
    written = cv2.imread(str(folder / name / "000002.jpg"))
    rendered = Renderer(scene, name).picture(2 / 30 + phase, 2)
    assert np.abs(written.astype(int) - rendered).mean() < 3


def test_truth_interpolates_to_the_exact_pose(recorded) -> None:
    scene, folder = recorded
    rows = np.loadtxt(folder / "truth.csv", delimiter=",", skiprows=1)
    assert np.diff(rows[:, 0]) == pytest.approx(1 / 480)
    times = np.linspace(0.0, 0.09, 50)
    exact = scene.trajectory.at(times)
    for axis in range(3):
        linear = np.interp(times, rows[:, 0], rows[:, 1 + axis])
        assert np.abs(linear - exact.translation[:, axis]).max() < 2e-3
    near = np.abs(rows[:, :1] - times).argmin(axis=0)
    at_rows = scene.trajectory.at(rows[near, 0])
    assert np.abs(at_rows.quat_wxyz - rows[near, 4:]).max() < 1e-8


@pytest.mark.parametrize("name", scene_catalogue())
def test_calibrations_of_scenes_say_how_their_shutters_roll(name, tmp_path) -> None:
    scene, path = scene_catalogue()[name], tmp_path / "calibration.toml"
    write_calibration(path, Calibration(scene.cameras))
    for camera in read_calibration(path).cameras:
        row_time_s = scene.sensor_of(camera.name).row_time_s
        assert camera.row_delay_s([1.0, 0.0]) @ [1, -1] == pytest.approx(row_time_s, rel=1e-6)
