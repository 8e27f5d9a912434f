"""What a laboratory makes of poses: rests, a tool's tip, a frame of its own."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from measure.api import Measurement, board_frame
from measure.api.folders import named_pictures
from measure.api.outputs import output
from measure.arrays import Bytes, Floats
from measure.errors import CalibrationError, ConfigError, DegenerateGeometryError, RunError
from measure.geometry import RigidTransform, UncertainTransform
from measure.metrology.poses import PoseTable, SharedErrors
from measure.metrology.rests import SHORTEST_S, Rests, find_rests
from measure.model import Body, Pose
from measure.results import Run, read_run
from measure.results.pose_table import poses_of, rests_of, shared_errors
from measure.results.run import camera_in
from measure.session import (
    JOINT_COVARIANCE,
    Calibration,
    read_calibration,
    write_body,
    write_calibration,
)
from measure_lab.lengths import Pivot, SpinAxis, find_spin_axis, find_tip

_LATEST = 3000  # Poses in which rests are looked for while measuring


@dataclass(frozen=True, eq=False)
class TipResult:
    """A tool's tip."""

    pivot: Pivot  # the tip, its uncertainty, how it was found
    axis: SpinAxis | None  # the tool's axis; None if none was asked for
    body: Body  # the body with its origin at the tip, and its z along the axis if there is one


def rests(run: Path | str, shortest_s: float = SHORTEST_S, body: str | None = None) -> Rests:
    """List where the body stood still, with the displacements between.

    A rest is a stretch in which poses scatter no more than twice as much as where they are
    quietest. Its pose is their mean; what all poses err by alike (cameras, body file, light) stays
    in its uncertainty. Between rests that cancels as far as it is alike at both places. Rests are
    numbered from 0.

    Args:
        run: the run's folder.
        shortest_s: shortest rest.
        body: which body, of a run of several.
    """
    if not 0 < shortest_s < np.inf:
        raise ConfigError(f"--shortest-s {shortest_s:g}: give the seconds of the shortest rest")
    return rests_of(read_run(Path(run), body), shortest_s)


class RestsSoFar:
    """The rests of a body while it is measured, within the latest minutes."""

    def __init__(self, body: Body, calibration: Calibration, poses: int = _LATEST) -> None:
        self._shared = SharedErrors(calibration.cameras, body, calibration.scale_sd)
        self._poses: deque[Pose] = deque(maxlen=poses)

    def add(self, measured: Measurement) -> None:
        """Take a measurement; those without a pose or with a flagged one do not count."""
        if measured.pose is not None and not measured.pose.flags:
            self._poses.append(measured.pose)

    def find(self, shortest_s: float = SHORTEST_S) -> Rests:
        """The rests so far."""
        poses = list(self._poses)
        places = [pose.world_from_body for pose in poses]
        table = PoseTable(
            np.array([pose.time_s for pose in poses]),
            RigidTransform(
                np.array([place.rotation for place in places]).reshape(-1, 3, 3),
                np.array([place.translation for place in places]).reshape(-1, 3),
            ),
            np.array([pose.covariance for pose in poses]).reshape(-1, 6, 6),
        )
        return find_rests(table, self._shared, shortest_s)


def pivot(
    run: Path | str,
    spin: Path | str | None = None,
    body: str | None = None,
    out: Path | None = None,
    overwrite: bool = False,
) -> TipResult:
    """Find a tool's tip from a run in which the tool pivots about it.

    The tip stands in a small hole and the tool is tilted to all sides, by 40 degrees in all or
    more; what else the recording holds is in the way. Refused where the motion cannot show the tip.

    Args:
        run: the run's folder.
        spin: another run, in which the tool is spun about its own axis: the body's z becomes this
            axis, from the tip towards the balls.
        body: which body, of a run of several.
        out: body file to write: the same balls, with the origin at the tip.
    """
    with output(out, overwrite) as file:
        found = _tip(run, spin, body)
        write_body(file, found.body)
    return found


def _tip(run: Path | str, spin: Path | str | None, body: str | None) -> TipResult:
    opened = read_run(Path(run), body)
    with told_of(run):
        found = find_tip(poses_of(opened), shared_errors(opened))
    turn, axis = np.eye(3), None
    if spin is not None:
        spun = read_run(Path(spin), body)
        with told_of(spin):
            axis = find_spin_axis(poses_of(spun), shared_errors(spun), found.tip_mm)
        # The rotation (3, 3) that brings the axis to z and leaves x as near as it can
        z = axis.direction
        x = np.eye(3)[0 if abs(z[0]) < 0.9 else 1]
        x = x - (x @ z) * z
        x /= np.linalg.norm(x)
        turn = np.stack([x, np.cross(z, x), z])
    centers = (opened.body.centers - found.tip_mm) @ turn.T
    return TipResult(found, axis, opened.body.with_centers(centers))


@contextmanager
def told_of(run: Path | str) -> Iterator[None]:
    """Name the run in what its poses do not determine."""
    try:
        yield
    except DegenerateGeometryError as problem:
        raise RunError(f"{run}: {problem}") from None


_SAME_MM = 1e-3  # Cameras further apart than this are not those of the same calibration
_LEAST_SINE = 0.05  # Of the angle between the two edges that three touched points span


def world(
    calibration: Path | str,
    run: Path | str | None = None,
    at_s: float | None = None,
    rest: int | None = None,
    points: Sequence[int] | None = None,
    body: str | None = None,
    board: Path | str | None = None,
    pictures: Path | str | None = None,
    out: Path | None = None,
    overwrite: bool = False,
) -> tuple[Calibration, UncertainTransform]:
    """Set the world's origin by a body, a board or three touches.

    The world becomes the frame of the body at that instant or rest, a frame through three rests of
    a tip, or that of a board, z up from the paper. Covariances of the cameras are carried along.

    Args:
        calibration: that the run was measured with.
        run: a run with the body where you want the world.
        at_s: time of the pose, in seconds as in poses.csv.
        rest: number of a rest (`measure rests`); the longest, if no place is given.
        points: three rests of a pivoted tip instead: at the origin, on the x axis, and in the xy
            plane where y is positive.
        body: which body, of a run of several.
        board: instead of a run, a target file of a board that lies there, or the name of one that
            comes with the program.
        pictures: folder with a picture of the board by each camera, named like the camera.
        out: the calibration to write.

    Returns:
        The calibration, and the new world's pose in the old one.
    """
    with output(out, overwrite) as file:
        if run is not None and board is None and pictures is None:
            found, place = _world_by_run(calibration, run, at_s, rest, points, body)
        elif run is None and board is not None and pictures is not None:
            found, place = world_by_board(calibration, board, pictures)
        else:
            raise ConfigError("say where it is: --run RUN, or --board FILE --pictures FOLDER")
        write_calibration(file, found)
    return found, place


def _world_by_run(
    calibration: Path | str,
    run: Path | str,
    at_s: float | None,
    rest: int | None,
    points: Sequence[int] | None,
    body: str | None,
) -> tuple[Calibration, UncertainTransform]:
    if sum(given is not None for given in (at_s, rest, points)) > 1:
        raise ConfigError("--at, --rest and --points name different places: give one of them")
    opened, given = read_run(Path(run), body), read_calibration(calibration)
    _refuse_others(given, opened, run)
    with told_of(run):
        if at_s is not None:
            place = _pose_at(opened, at_s)
        else:
            place = _of_rests(rests_of(opened), rest, points)
    return _moved(given, place, str(run)), place


def world_by_board(
    calibration: Path | str | Calibration,
    board: Path | str,
    pictures: Path | str | Mapping[str, Bytes],
) -> tuple[Calibration, UncertainTransform]:
    """A calibration whose world is the frame of a board, its z axis towards the cameras.

    Args:
        board: its target file, or the name of one that comes with the program.
        pictures: a folder with a picture of the board by each camera that sees it, named like the
            camera (cam0.png); or the pictures, BGR by camera.
    """
    given = calibration if isinstance(calibration, Calibration) else read_calibration(calibration)
    if isinstance(pictures, Mapping):
        found, origin = pictures, "pictures"
    else:
        found, origin = named_pictures(Path(pictures), given.names), str(Path(pictures))
    place = board_frame(Path(board), given.cameras, found)
    return _moved(given, place, origin), place


def _refuse_others(given: Calibration, run: Run, folder: Path | str) -> None:
    for used in run.cameras:
        off = given.camera(used.name).world_from_camera.difference(used.world_from_camera)
        if np.linalg.norm(off[:3]) > _SAME_MM or np.linalg.norm(off[3:]) > 1e-6:
            raise CalibrationError(
                f"{folder} was measured with another calibration: its camera {used.name} stands "
                "elsewhere; measure the recording with this one, and take that run"
            )


def _pose_at(run: Run, at_s: float) -> UncertainTransform:
    poses = poses_of(run)
    if len(poses):
        near = int(np.argmin(np.abs(poses.times_s - at_s)))
        step = float(np.median(np.diff(run.times_s))) if len(run.times_s) > 1 else np.inf
        if abs(poses.times_s[near] - at_s) <= step:
            return UncertainTransform(poses.world_from_body[near], poses.covariances[near])
    between = f"{run.times_s[0]:.3f} to {run.times_s[-1]:.3f} s" if len(run.times_s) else "nothing"
    raise RunError(f"{run.path} holds no unflagged pose at {at_s:.3f} s: it spans {between}")


def _of_rests(found: Rests, number: int | None, points: Sequence[int] | None) -> UncertainTransform:
    if points is not None:
        return _through(found, points)
    lengths = [rest.end_s - rest.start_s for rest in found.rests]
    chosen = int(np.argmax(lengths)) if number is None and lengths else number or 0
    return UncertainTransform(found.rest(chosen).world_from_body, found.block(chosen, chosen))


def _through(found: Rests, points: Sequence[int]) -> UncertainTransform:
    """The frame of three touched points, and its covariance by numerical derivatives."""
    touched = np.stack([found.rest(n).world_from_body.translation for n in points])
    frame = _frame(touched)
    rows = [6 * n + k for n in points for k in range(3)]
    steps = 1e-4 * np.eye(9).reshape(9, 3, 3)
    J = np.stack([_frame(touched + step).difference(frame) for step in steps], axis=1) / 1e-4
    return UncertainTransform(frame, J @ found.covariance[np.ix_(rows, rows)] @ J.T)


def _frame(points: Floats) -> RigidTransform:
    along, aside = points[1] - points[0], points[2] - points[0]
    normal = np.cross(along, aside)
    sides = float(np.linalg.norm(along) * np.linalg.norm(aside))
    sine = float(np.linalg.norm(normal)) / max(sides, 1e-12)
    if sine < _LEAST_SINE:
        raise DegenerateGeometryError(
            f"the three points lie on one line ({np.degrees(np.arcsin(sine)):.1f} deg): touch the "
            "third well beside it"
        )
    x, z = along / np.linalg.norm(along), normal / np.linalg.norm(normal)
    return RigidTransform(np.stack([x, np.cross(z, x), z], axis=1), points[0])


def _moved(given: Calibration, place: UncertainTransform, origin: str) -> Calibration:
    """The calibration with its world at `place`.

    The frame is that of the pose as measured, an exact change of coordinates: covariances turn with
    it. How well the body itself is known there stands in the provenance.
    """
    new_from_old = place.transform.inverse()
    notes = dict(given.provenance)
    joint = notes.pop(JOINT_COVARIANCE, None)
    sizes = [len(c.free) for c in given.cameras]
    if joint is not None and len(joint) == sum(sizes):
        turn = np.eye(len(joint))
        for start in np.cumsum([0, *sizes[:-1]]):
            for at in (start, start + 3):
                turn[at : at + 3, at : at + 3] = new_from_old.rotation
        notes[JOINT_COVARIANCE] = turn @ np.asarray(joint) @ turn.T
    notes["world"] = {
        "from": origin,
        "quat_wxyz": place.transform.quat_wxyz,
        "translation_mm": place.transform.translation,
        "covariance": place.covariance,
    }
    cameras = tuple(camera_in(new_from_old, c) for c in given.cameras)
    return Calibration(cameras, notes, given.scale_sd)
