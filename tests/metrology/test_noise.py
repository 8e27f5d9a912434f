"""Noise and drift are what was put in: floor, drift, tones; and gaps are not bridged."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from measure.cli import main
from measure.metrology.noise import noise_of
from tests.metrology.recordings import Errors, poses_of, with_rests, write_run

SD_MM, SD_RAD = 0.02, 0.001


def white(rng, count, rate_hz=30.0):
    times = np.arange(count) / rate_hz
    return times, rng.normal(0, [SD_MM] * 3 + [SD_RAD] * 3, (count, 6))


def noise(times, deviations, groups=None):
    groups = np.zeros(len(times), np.int64) if groups is None else groups
    found = noise_of(times, deviations, groups, "the truth")
    assert found is not None
    return found


def test_white_noise_has_its_floor_and_averages_as_the_root_of_time(rng):
    found = noise(*white(rng, 3000))
    assert found.floor == pytest.approx(
        np.sqrt(3) * np.array([SD_MM, np.degrees(SD_RAD)]), rel=0.05
    )
    halves = found.allan[0] / found.allan[4] * np.sqrt(found.averaging_s[0] / found.averaging_s[4])
    assert halves == pytest.approx([1.0, 1.0], rel=0.15)


def test_a_drift_is_known_to_what_it_states(rng):
    ratios = []
    for _ in range(60):
        times, off = white(rng, 300)
        off[:, 0] += 0.05 * times / times[-1]
        found = noise(times, off)
        ratios.append((found.drift - [0.05, 0, 0, 0, 0, 0]) / found.drift_sd)
        assert found.drifts
    assert 0.8 < np.std(ratios) < 1.25


def test_noise_that_wanders_is_no_drift(rng):
    """Consecutive errors that are alike count for fewer; else one in two would pass for a drift."""
    told = 0
    for _ in range(30):
        times, off = white(rng, 600)
        slow = np.convolve(rng.normal(0, 0.02, 640), np.ones(40) / 6, "valid")[:600]
        told += noise(times, off + slow[:, None]).drifts
    assert told <= 6


def test_a_tone_shows_in_the_spectrum_with_its_power(rng):
    times, off = white(rng, 3000)
    off[:, 1] += 0.03 * np.sin(2 * np.pi * 5.0 * times)
    found = noise(times, off)
    assert found.frequency_hz[np.argmax(found.density[:, 0])] == pytest.approx(5.0, abs=0.15)
    step = found.frequency_hz[1] - found.frequency_hz[0]
    power = np.sum(found.density[:, 0] ** 2) * step
    assert power == pytest.approx(3 * SD_MM**2 + 0.03**2 / 2, rel=0.1)


def test_a_step_at_a_gap_or_between_rests_is_no_noise(rng):
    """Means on either side of a gap are no neighbours; a rest has a mean of its own."""
    times, off = white(rng, 600)
    gap = times + 10.0 * (times > 10)
    stepped = off + 5.0 * (times > 10)[:, None]
    assert noise(gap, stepped).allan[:, 0].max() < 2 * SD_MM
    rests = noise(times, stepped, (times > 10).astype(np.int64))
    assert rests.allan[:, 0].max() < 2 * SD_MM
    assert not rests.drifts
    assert noise(times, stepped).allan[:, 0].max() > 1.0


def test_few_poses_have_no_noise(rng):
    times, off = white(rng, 9)
    assert noise_of(times, off, np.zeros(9, np.int64), "the truth") is None


def test_evaluate_and_report_tell_noise_and_drift(tmp_path, capsys, rng):
    """Against a truth in `evaluate`, at the rests in `report` where there is none."""
    truth = with_rests(np.array([[0.0, 0, 200], [60, 0, 200]]), 2.0)
    run = write_run(tmp_path / "run", poses_of(truth, Errors(), rng))
    assert main(["report", str(run)]) == 0
    page = (run / "report.html").read_text()
    assert "Of the unflagged poses about the means of the rests" in page
    rows = "".join(f"{t},{t},0,200,1,0,0,0\n" for t in np.arange(-1.0, 100.0, 0.1).round(1))
    (tmp_path / "truth.csv").write_text("time_s,x_mm,y_mm,z_mm,qw,qx,qy,qz\n" + rows)
    capsys.readouterr()
    assert main(["evaluate", str(run), "--truth", str(tmp_path / "truth.csv"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["noise"]
    assert found["about"] == "the truth"
    assert len(found["allan"]) == len(found["averaging_s"])
    assert main(["evaluate", str(run), "--truth", str(tmp_path / "truth.csv")]) == 0
    assert re.search(r"drift over [\d.]+ s", capsys.readouterr().out)
