"""The acceptance test: good rigs pass, a wrong scale is found, and the page can be filed."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from benchmarks.acceptance import PAIRS, PLACES, accepted
from measure.cli import main
from measure.geometry import RigidTransform
from measure.results import RunWriter
from tests.metrology.recordings import Errors, measured, poses_of, with_rests, write_run
from tests.results.conftest import BODY, CAMERAS, made_from, measurement, written

TABLE = "from,to,length_mm,sd_mm\n" + "".join(
    f"{a},{b},{np.linalg.norm(PLACES[b] - PLACES[a]):.4f},0.002\n" for a, b in PAIRS
)


@pytest.mark.parametrize("errors", [Errors(), Errors(nearby=0.7)], ids=str)
def test_good_rigs_pass(errors, rng):
    """At most 12 of 200 by the contract; `python -m benchmarks.acceptance` tries as many."""
    assert sum(bool(accepted(errors, rng).contradictions) for _ in range(12)) <= 2


@pytest.mark.parametrize("scale", [1.003, 0.997, 1.01])
def test_a_wrong_scale_is_found_and_told(scale, rng):
    for _ in range(3):
        found = accepted(Errors(nearby=0.7, scale=scale), rng)
        assert found.scale == pytest.approx(scale - 1, abs=0.0005)
        assert found.contradictions[-1].startswith("scale: lengths are")


def test_expanded_uncertainties_are_two_standard_deviations(rng):
    ratios = np.array([accepted(Errors(nearby=0.7), rng).ratios for _ in range(12)])
    assert 0.38 < np.sqrt(np.mean(ratios**2)) < 0.62
    assert np.mean(np.abs(ratios) <= 1) > 0.9


def test_the_command_judges_and_writes_a_page(tmp_path: Path, rng, capsys):
    poses = poses_of(with_rests(PLACES), Errors(nearby=0.7), rng)
    run, table, page = tmp_path / "run", tmp_path / "lengths.csv", tmp_path / "page.html"
    write_run(run, poses)
    table.write_text(TABLE + "0,1,100.0,0.002\n")
    assert main(["accept", str(run), "--lengths", str(table), "-o", str(page), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["passed"]
    assert len(told["length_errors_mm"]) == len(PAIRS) + 1
    assert told["max_mm"] == pytest.approx(np.abs(told["length_errors_mm"]).max())
    assert told["rms_mm"] == pytest.approx(np.sqrt(np.mean(np.square(told["length_errors_mm"]))))
    # Of 100 mm there are five lengths, of the diagonals and the posts the others.
    again = {}
    for known, error in zip(told["known_mm"], told["length_errors_mm"], strict=True):
        again.setdefault(known, []).append(error)
    squares = [np.var(errors) * len(errors) for errors in again.values()]
    spare = sum(len(errors) - 1 for errors in again.values())
    assert told["repeatability_mm"] == pytest.approx(np.sqrt(sum(squares) / spare))
    text = page.read_text()
    assert "Accepted" in text
    assert str(tmp_path) not in text


def test_a_contradiction_ends_with_three_and_names_the_length(tmp_path: Path, rng, capsys):
    run = write_run(tmp_path / "run", poses_of(with_rests(PLACES), Errors(nearby=0.7), rng))
    table = tmp_path / "lengths.csv"
    table.write_text("from;to;length_mm\n0;1;100,0\n1;2;100,58\n")
    assert main(["accept", str(run), "--lengths", str(table)]) == 3
    printed = capsys.readouterr().out
    assert "wrong: length 1 - 2: off by -0.5" in printed
    assert "NOT held" in printed


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("0,9,100", r"lengths.csv:2: there is no rest 9: there are 6 rests, 0 to 5"),
        ("0,0,100", r"lengths.csv:2: rest 0 has no distance from itself"),
        ("0,red,100", r"lengths.csv:2: '0' to 'red' are no two rests .* green, yellow, red"),
        ("0,1,-3", r"lengths.csv:2: length_mm is -3"),
        ("0,1,100,-1", r"lengths.csv:2: sd_mm is -1"),
        ("0,1", r"lengths.csv:2: .*length_mm"),
    ],
)
def test_a_bad_row_is_told_with_its_line(rows, message, tmp_path: Path, rng, capsys):
    run = write_run(tmp_path / "run", poses_of(with_rests(PLACES), Errors(nearby=0.7), rng))
    table = tmp_path / "lengths.csv"
    head = "from,to,length_mm" + (",sd_mm" if rows.count(",") == 3 else "")
    table.write_text(f"{head}\n{rows}\n")
    assert main(["accept", str(run), "--lengths", str(table)]) == 2
    error = capsys.readouterr().err
    assert re.search(message, error), error


def test_balls_are_a_ball_bar(tmp_path: Path, capsys):
    """Distances between the body's own balls, by rays alone."""
    written(tmp_path / "run", map(measurement, range(12)))
    table = tmp_path / "bar.csv"
    lengths = {
        pair: float(np.linalg.norm(np.subtract(*(BODY.centers[BODY.index(b)] for b in pair))))
        for pair in combinations(BODY.names, 2)
    }
    table.write_text(
        "from,to,length_mm\n" + "".join(f"{a},{b},{mm}\n" for (a, b), mm in lengths.items())
    )
    assert main(["accept", str(tmp_path / "run"), "--lengths", str(table), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["max_mm"] < 0.01
    table.write_text("from,to,length_mm\ngreen,red,80\n")
    assert main(["accept", str(tmp_path / "run"), "--lengths", str(table)]) == 3


def test_a_rig_whose_poses_are_all_flagged_is_judged_all_the_same(tmp_path, rng, capsys, caplog):
    """A wrong scale that the run has found flags them all; the lengths say so too."""
    poses = poses_of(with_rests(PLACES), Errors(nearby=0.7, scale=1.01), rng)
    run = write_run(tmp_path / "run", poses, flagged=frozenset(range(len(poses))))
    table = tmp_path / "lengths.csv"
    table.write_text(TABLE)
    assert main(["accept", str(run), "--lengths", str(table)]) == 3
    assert "wrong: scale: lengths are +1.0" in capsys.readouterr().out
    assert "most poses are flagged" in caplog.text


def write_bar(folder: Path, truth, rng, reference: str = "near") -> Path:
    """Two bodies on a bar of 150 mm along x, carried from place to place."""
    near, far = (replace(BODY, name=name) for name in ("near", "far"))
    ends = [poses_of(truth @ RigidTransform(np.eye(3), np.array([x, 0.0, 0.0])), Errors(), rng)
            for x in (0.0, 150.0)]  # fmt: skip
    with RunWriter(folder, made_from(), [near, far], CAMERAS, reference=reference) as writer:
        for k in range(len(truth.translation)):
            writer.append(
                *(measured(k, float(end.times_s[k]), end.world_from_body[k], end.covariances[k],
                           BODY.names) for end in ends)
            )  # fmt: skip
        writer.finish()
    return folder


def test_two_bodies_are_a_ball_bar_at_every_rest(tmp_path: Path, rng, capsys):
    run = write_bar(tmp_path / "run", with_rests(PLACES), rng)
    table = tmp_path / "bar.csv"
    table.write_text("from,to,length_mm\nnear,far,150\n")
    command = ["accept", str(run), "--lengths", str(table), "--json"]
    assert main(command) == 0
    told = json.loads(capsys.readouterr().out)
    assert len(told["length_errors_mm"]) == len(PLACES)
    assert told["max_mm"] < 0.1
    assert np.ptp(told["middles_mm"], axis=0) == pytest.approx(np.ptp(PLACES, axis=0), abs=0.2)
    table.write_text("from,to,length_mm\nnear,far,150.6\n")
    assert main(command) == 3
    table.write_text("from,to,length_mm\nnear,far,150\n0,1,100\n")
    assert main(command) == 2
    assert "choose one with --body" in capsys.readouterr().err


def test_two_bodies_without_a_reference_are_no_ball_bar(tmp_path: Path, rng, capsys):
    run = write_bar(tmp_path / "run", with_rests(PLACES), rng, reference="")
    table = tmp_path / "bar.csv"
    table.write_text("from,to,length_mm\nnear,far,150\n")
    assert main(["accept", str(run), "--lengths", str(table)]) == 2
    assert "measure the recording with --reference" in capsys.readouterr().err
