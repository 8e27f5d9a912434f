from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from measure.errors import RunError, SessionError
from measure.geometry import RigidTransform
from measure.session import Trajectory, read_trajectory


def _pose(time_s: np.ndarray) -> RigidTransform:
    """30 mm at 1 Hz while it turns."""
    angle = 2 * np.pi * np.atleast_1d(time_s)
    shift = 30 * np.stack([np.sin(angle), np.cos(angle), np.sin(2 * angle)], axis=1)
    axis = np.array([0.6, 0.0, 0.8])
    return RigidTransform.from_rotvec(np.sin(angle)[:, None] * axis, shift)


def _sampled(rate_hz: float, end_s: float = 2.0) -> Trajectory:
    times = np.arange(0, end_s, 1 / rate_hz)
    return Trajectory(times, _pose(times))


def test_interpolation_is_exact_at_samples_and_close_between() -> None:
    trajectory = _sampled(240)
    times = trajectory.times_s
    assert np.abs(trajectory.at(times).difference(_pose(times))).max() < 1e-12
    between = np.linspace(times[0], times[-1], 1000)
    left = trajectory.at(between).difference(_pose(between))
    assert np.abs(left[:, :3]).max() < 1e-3
    assert np.abs(left[:, 3:]).max() < 3e-4


def test_positions_are_cubic_not_linear() -> None:
    coarse = _sampled(60)
    middle = coarse.times_s[10:50] + 1 / 120
    true = _pose(middle).translation
    cubic = np.abs(coarse.at(middle).translation - true).max()
    ends = (
        coarse.world_from_body.translation[10:50] + coarse.world_from_body.translation[11:51]
    ) / 2
    assert cubic < 0.1 * np.abs(ends - true).max()


def test_a_time_gives_one_pose_and_times_give_a_batch() -> None:
    trajectory = _sampled(100)
    assert trajectory.at(0.505).translation.shape == (3,)
    assert trajectory.at([0.505]).translation.shape == (1, 3)


def test_nothing_is_extrapolated() -> None:
    trajectory = _sampled(100, 1.0)
    assert trajectory.covers([-0.001, 0.0, 0.5, 0.99, 0.991]).tolist() == [0, 1, 1, 1, 0]
    for time_s in (-0.001, 0.991, float("nan")):
        with pytest.raises(SessionError, match=r"it runs from 0\.000000 to 0\.990000 s"):
            trajectory.at(time_s)


def test_nothing_is_interpolated_across_a_gap() -> None:
    times = np.concatenate([np.arange(0, 1, 0.01), np.arange(1.2, 2, 0.01)])
    trajectory = Trajectory(times, _pose(times))
    assert trajectory.covers([0.985, 0.99, 1.05, 1.2, 1.205]).tolist() == [1, 1, 0, 1, 1]
    with pytest.raises(SessionError, match="with gaps"):
        trajectory.at(1.05)
    near = np.array([0.985, 1.205])
    assert np.abs(trajectory.at(near).difference(_pose(near))[:, :3]).max() < 0.02


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_samples(count: int) -> None:
    times = 0.1 * np.arange(count)
    trajectory = Trajectory(times, _pose(times))
    assert trajectory.covers(times).all()
    assert np.abs(trajectory.at(times).difference(_pose(times))).max() < 1e-12
    assert not trajectory.covers(0.1 * count)[0]


def _csv(path: Path, rows: list[str]) -> Path:
    path.write_text("\n".join(["time_s,x_mm,y_mm,z_mm,qw,qx,qy,qz", *rows]) + "\n")
    return path


def test_rows_without_a_pose_are_passed_over(tmp_path: Path) -> None:
    path = _csv(tmp_path / "p.csv", ["0,1,2,3,1,0,0,0", "0.1,,,,,,,", "0.2,1,2,4,-1,0,0,0"])
    found = read_trajectory(path)
    assert found.times_s.tolist() == [0.0, 0.2]
    assert found.world_from_body.translation[1].tolist() == [1, 2, 4]
    assert found.source == str(path)


def test_tum_is_in_metres_and_ends_with_w(tmp_path: Path) -> None:
    (tmp_path / "t.txt").write_text(
        "# stamp x y z qx qy qz qw\n0 0.1 0.2 0.3 1 0 0 0\n1 0 0 0 0 0 0 1\n"
    )
    found = read_trajectory(tmp_path / "t.txt")
    assert found.world_from_body.translation[0] == pytest.approx([100, 200, 300])
    assert found.world_from_body.quat_wxyz[0] == pytest.approx([0, 1, 0, 0])


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([], "has a header but no rows"),
        (["0,,,,,,,"], "holds no pose"),
        (["0,1,2,3,1,0,0,0", "0,1,2,3,1,0,0,0"], "p.csv:3: time does not increase"),
        (["0,1,2,3,1,0,0,0", "1,nan,2,3,1,0,0,0"], "p.csv:3: a value is missing or not finite"),
        (["0,1,2,3,1,1,0,0"], "p.csv:2: not a rotation: the quaternion's length is 1.414"),
        (["0,1,2,3,1,0,0,0,0"], "p.csv:2: 9 cells under 8 headings"),
        (["0,1,2,x,1,0,0,0"], "p.csv:2: z_mm is 'x', not a number"),
    ],
)
def test_a_bad_trajectory_is_explained(tmp_path: Path, rows: list[str], words: str) -> None:
    with pytest.raises(RunError) as caught:
        read_trajectory(_csv(tmp_path / "p.csv", rows), RunError)
    assert words in str(caught.value)


def test_another_table_is_no_trajectory(tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text("frame,time_s\n0,1\n")
    with pytest.raises(SessionError, match=r"p\.csv:1: the header lacks x_mm, y_mm"):
        read_trajectory(tmp_path / "p.csv")
    (tmp_path / "t.txt").write_text("0 1 2 3 4 5 6 7\n0 1 2\n")
    with pytest.raises(SessionError, match=r"t\.txt:2: a TUM line has eight numbers"):
        read_trajectory(tmp_path / "t.txt")


def test_empty_cells_beyond_the_header_do_no_harm(tmp_path: Path) -> None:
    """As spreadsheets write them."""
    path = _csv(tmp_path / "p.csv", ["0,1,2,3,1,0,0,0,,", "1,1,2,3,1,0,0,0, "])
    assert len(read_trajectory(path).times_s) == 2
