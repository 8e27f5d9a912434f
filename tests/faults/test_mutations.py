"""Changed files are read or refused in one line; the long part is `mutations.rows`."""

from __future__ import annotations

import random
import signal
from pathlib import Path

import numpy as np
import pytest

from benchmarks.faults.mutations import AT_MOST_BYTES, Mutations, fault_of, moved
from benchmarks.faults.subjects import SUBJECTS, small
from tests.results.conftest import measurement, written

QUICK = tuple(
    subject
    for subject in SUBJECTS
    if subject.words.split()[0] in ("run", "report", "evaluate", "export", "calibrate")
    and "video" not in subject.name
    and "precise" not in subject.name
)
"""Kinds whose commands take no second, and whose kernels load in no time."""


@pytest.mark.slow
def test_changed_files_are_read_or_refused(tmp_path: Path) -> None:
    mutations, draw = Mutations(tmp_path / "all", QUICK, small), random.Random(36)
    outcomes = [mutations.try_one(k, draw) for k in range(9)]
    assert not [one for one in outcomes if one.fault]
    assert 2 < sum(one.refused for one in outcomes) < 9
    assert len({one.subject for one in outcomes}) > 5


@pytest.mark.parametrize(
    ("code", "said", "peak_bytes", "fault"),
    [
        (0, "0 of 6 measured", 1 << 29, ""),
        (3, "wrong: the clock of cam0", 1 << 29, ""),
        (2, "note\nmeasure: no such file", 1 << 29, ""),
        (2, "measure: one\nmeasure: two", 1 << 29, "refuses in more or less than one line"),
        (2, "", 1 << 29, "refuses in more or less than one line"),
        (1, "", 1 << 29, "traceback, or exit code 1"),
        (0, "Traceback (most recent call last):", 1 << 29, "traceback, or exit code 0"),
        (-signal.SIGSEGV, "", 0, "traceback, or exit code -11"),
        (-signal.SIGALRM, "", 0, "hangs"),
        (0, "", AT_MOST_BYTES + 1, "takes 2048 MB"),
    ],
)
def test_what_must_not_be_is_seen(code: int, said: str, peak_bytes: int, fault: str) -> None:
    assert fault_of(code, said, peak_bytes) == fault


@pytest.mark.parametrize(
    ("error", "count"),
    [
        ((0.0, 0, 0, 0, 0, 0), 0),
        ((0.25, 0, 0, 0, 0, 0), 0),
        ((0.3, 0, 0, 0, 0, 0), 4),
        ((0, 0, 0, 0, 0, 0.0025), 0),
        ((0, 0, 0, 0, 0, 0.003), 4),
    ],
)
def test_poses_that_move_by_more_than_they_state_are_counted(
    tmp_path: Path, error: tuple[float, ...], count: int
) -> None:
    """Their standard deviations are 0.1 mm and 1 mrad per axis: 95 % lie within 2.8 of them."""
    runs = []
    for name, off in (("whole", np.zeros(6)), ("changed", np.array(error))):
        runs.append(written(tmp_path / name, [measurement(k, off, lost=k == 3) for k in range(5)]))
    assert moved(*runs) == count
