"""One law for numbers in files: finite, within 1e9, and no truth values or texts."""

from __future__ import annotations

import pytest

from measure.errors import EstimatorError, MeasureError
from measure.reading import check_numbers
from measure.session import open_session, read_calibration
from measure.session.trajectory import read_trajectory
from measure_formats.trackers import tracker_bodies
from measure_learning.robots.urdf import read_urdf
from tests.session.conftest import Recording

HUGE = "9" * 400


@pytest.mark.parametrize("good", [0, -1e9, [1, [2.5, 3]], {"a": 1.0}, None])
def test_numbers_are_numbers(good: object) -> None:
    check_numbers(good)


@pytest.mark.parametrize(
    "bad", [True, "20", float("nan"), float("inf"), 1e308, -2e9, [0, [1, False]], int(HUGE)]
)
def test_all_else_is_none(bad: object) -> None:
    with pytest.raises(ValueError, match="expected a"):
        check_numbers(bad)


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("calibration.toml", "distortion = []", "distortion = [1e308, 0.0, 0.0, 0.0]"),
        ("calibration.toml", "distortion = []", "distortion = [0.0, -1e308, 0.0, 0.0]"),
        ("calibration.toml", "size_wh = [64, 48]", "size_wh = [true, 48]"),
        ("calibration.toml", "translation_mm = [0.0", 'translation_mm = ["0.0"'),
        ("calibration.toml", "translation_mm = [0.0", f"translation_mm = [{HUGE}"),
        ("body.toml", "radius_mm = 20.0", "radius_mm = true"),
        ("body.toml", "radius_mm = 20.0", 'radius_mm = "20"'),
        ("session.toml", 'timestamps = "cam0.csv"', 'timestamps = "cam0.csv"\nbit_depth = "8"'),
    ],
)
def test_a_number_that_is_none_is_named(
    recording: Recording, file: str, old: str, new: str
) -> None:
    recording.replace(file, old, new)
    with pytest.raises(MeasureError, match=rf"{file}:\d+: .*expected a") as refused:
        open_session(recording.path)
    assert "\n" not in str(refused.value)


def test_seconds_since_1970_are_no_lengths(recording: Recording) -> None:
    text = 'timestamps = "cam0.csv"\ntime_offset_s = 1.7e9'
    recording.replace("session.toml", 'timestamps = "cam0.csv"', text)
    with pytest.raises(MeasureError) as refused:
        open_session(recording.path)
    assert "expected a" not in str(refused.value)


KALIBR = """\
cam0: {{intrinsics: [{f}, 900, 640, 360], resolution: [1280, 720]}}
cam1:
  intrinsics: [900, 900, 640, 360]
  resolution: [1280, 720]
  T_cn_cnm1: [[1, 0, 0, {t}], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
"""


@pytest.mark.parametrize("number", [HUGE, "1.0e+308", ".nan", "true"])
@pytest.mark.parametrize("place", ["f", "t"])
def test_kalibrs_numbers(tmp_path, number, place):
    file = tmp_path / "camchain.yaml"
    file.write_text(KALIBR.format(**({"f": 900, "t": 0.2} | {place: number})))
    with pytest.raises(MeasureError, match="finite numbers, within"):
        read_calibration(file)


@pytest.mark.parametrize("number", [HUGE, "1e308"])
def test_multicals_numbers(tmp_path, number):
    one = f'{{"K": [[900, 0, 640], [0, {number}, 360], [0, 0, 1]], "image_size": [1280, 720]}}'
    pose = '{"R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "T": [0, 0, 0]}'
    file = tmp_path / "calibration.json"
    file.write_text(f'{{"cameras": {{"a": {one}}}, "camera_poses": {{"a": {pose}}}}}')
    with pytest.raises(MeasureError, match="finite numbers, within"):
        read_calibration(file)
    file.write_text(f'{{"cameras": {{"a": {one}}}, "camera_poses": {{"a": 5}}}}')
    with pytest.raises(MeasureError, match="maps of maps"):
        read_calibration(file)


@pytest.mark.parametrize("text", ['xyz="1e308 0 0"', 'rpy="0 1e308 0"', f'xyz="0 {HUGE} 0"'])
def test_a_urdfs_numbers(tmp_path, text):
    file = tmp_path / "arm.urdf"
    joint = f'<parent link="a"/><child link="b"/><origin {text}/><axis xyz="0 0 1"/>'
    file.write_text(f'<robot><joint name="j" type="revolute">{joint}</joint></robot>')
    with pytest.raises(EstimatorError, match="is not three numbers within 1e"):
        read_urdf(file)


def test_a_cell_of_any_length_is_refused_in_one_line(tmp_path):
    cell = "7" * 200_000
    table = tmp_path / "truth.csv"
    table.write_text(f"time_s,x_mm,y_mm,z_mm,qw,qx,qy,qz\n{cell},0,0,0,1,0,0,0\n")
    with pytest.raises(MeasureError, match="field larger than field limit"):
        read_trajectory(table)
    text = f"Format Version,1.23,{cell}\n"
    with pytest.raises(MeasureError, match=r"a\.csv:1: field larger than field limit"):
        tracker_bodies(tmp_path / "a.csv", text, MeasureError)
