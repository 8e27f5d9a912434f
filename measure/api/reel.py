"""What is shown or sent again of a run: its poses, its measurements and the marks in it."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from functools import cached_property

import numpy as np
import pyarrow as pa

from measure.api.folders import events
from measure.errors import RunError
from measure.geometry import RigidTransform
from measure.host import EventMark, SentPose, SentRun
from measure.measuring import Measurement, Status
from measure.model import BallPosition, Pose
from measure.results import Run
from measure.results.journal import is_missing
from measure.results.stored import rows_of_body
from measure.results.tables import BODY, PLACE, doubts_of, matrices, numbers


class Reel:
    """All that is played of a run."""

    def __init__(self, runs: Sequence[Run]) -> None:
        first = runs[0]
        if not first.poses.num_rows:
            raise RunError(f"{first.path} holds no frame set to play")
        self.times_s, self._runs, reference = first.times_s, runs, ""
        self._tracks = [_PlayedBody(run.poses, run.body.name) for run in runs]
        if not is_missing(first.path, "relative"):
            table = first.relative()
            pairs = zip(table[BODY].to_pylist(), table["reference"].to_pylist(), strict=True)
            for name, reference in dict.fromkeys(pairs):
                self._tracks.append(_PlayedBody(rows_of_body(table, name), name, reference))
        bodies = tuple(run.body for run in runs)
        self._marks = sorted(events(first.path))
        self.run = SentRun(first.path.resolve().name, bodies, first.cameras, reference)

    @cached_property
    def _balls(self) -> list[dict[int, list[BallPosition]]]:
        """The positions of each body's balls by frame set."""
        out: list[dict[int, list[BallPosition]]] = []
        for run in self._runs:
            out.append(defaultdict(list))
            for row in run.balls.to_pylist():
                center = np.array([row[axis] for axis in PLACE[:3]])
                spread = np.reshape(row["covariance_mm2"], (3, 3))
                ball = BallPosition(
                    row["ball"],
                    row["time_s"],
                    center,
                    spread,
                    cameras=tuple(row["cameras"]),
                    residuals_mm=np.zeros(0),
                )
                out[-1][row["index"]].append(ball)
        return out

    def poses(self, number: int, exposed_s: float, known_s: float) -> list[SentPose]:
        """The poses of a frame set."""
        return [track.sent(number, exposed_s, known_s) for track in self._tracks]

    def marks(self, number: int, exposed_s: float, rate: float) -> list[EventMark]:
        """The event marks since the frame set before."""
        before_s = self.times_s[number - 1] if number else -math.inf
        now_s = float(self.times_s[number])
        return [
            EventMark(time_s, exposed_s + (time_s - now_s) / rate, what)
            for time_s, what in self._marks
            if before_s < time_s <= now_s
        ]

    def measurements(self, number: int) -> list[Measurement]:
        """The measurements of a frame set, without what its pictures showed."""
        sent = [track.sent(number, 0.0, 0.0) for track in self._tracks]
        return [
            Measurement(
                *(one.frame, one.time_s, {}, (), tuple(balls[one.frame]), one.pose),
                status=Status(one.status),
                reasons=one.doubts,
            )
            for one, balls in zip(sent, self._balls, strict=False)
        ]


class _PlayedBody:
    """The stored poses of a body, perhaps relative to another."""

    def __init__(self, table: pa.Table, body: str, reference: str = "") -> None:
        self._body, self._reference = body, reference
        self._rows = table.drop_columns([*PLACE, "covariance"]).to_pylist()
        self._places, self._doubts = numbers(table, *PLACE), doubts_of(table)
        self._covariances = matrices(table, "covariance", 6)

    def sent(self, number: int, exposed_s: float, known_s: float) -> SentPose:
        """The pose of a frame set."""
        row, place = self._rows[number], self._places[number]
        pose = None
        if np.isfinite(place[0]):
            pose = Pose(
                row["time_s"],
                RigidTransform.from_quat_wxyz(place[3:], place[:3]),
                self._covariances[number],
                row["residual_mm"],
                row["rms_px"],
                tuple(row["cameras"]),
                tuple(row["balls"]),
                tuple(row["flags"]),
            )
        return SentPose(
            self._body,
            self._reference,
            row["index"],
            row["time_s"],
            exposed_s=exposed_s,
            known_s=known_s,
            status=row["status"],
            reason=row["reason"],
            pose=pose,
            doubts=self._doubts[number],
        )
