"""Cameras that the others contradict, freed alone: an error that is shared out among all moves all.

Whether one was moved, or its lens zoomed, the recording tells: each is fitted with all other
cameras held, and the one is taken that explains the sightings with the fewest unknowns (Schwarz
1978).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from measure.arrays import Floats
from measure.calibration.refining.recording import Recording
from measure.calibration.refining.refine import Refinement, RefineSettings, refine_rig
from measure.checking.causes import Word
from measure.checking.diagnosis import diagnose
from measure.checking.explaining import explain
from measure.checking.sightings import evidence_of
from measure.errors import CalibrationError
from measure.measuring import Measurement
from measure.model import Body, Camera, Intrinsics

_OF_A_CAMERA = (Word.MOVED, Word.ZOOM, Word.POINT)
_NO_REMEDY = (*_OF_A_CAMERA, Word.MOVED_AT, Word.CLOCK_STEP, Word.SCALE, Word.PLACE)
"""What cameras refined together would share out among them, of all cameras, or midway."""
_MISFIT, _LEFT, _LEFT_SHARE = 1.0, 2.0, 0.2
"""Mean square of residuals, in stated variances, that no healthy recording leaves; and what may be
left of it, and as a share, once the cameras named are turned: where they stand is not asked yet."""
_AS_GOOD = 1.1  # Times what is left otherwise, that a rival may leave to be thought of
_MOST, _HELD = 0.5, 2  # Share that a cause explains; least number of cameras that are held
FREE_SD, HELD_SD = np.repeat([[100.0, 0.3], [1e-3, 1e-6]], 3, axis=1)
"""Of a pose that is as good as unknown, and of one far better known than what is measured."""
ZOOM_SD, _ASPECT_SD, _POINT_SD_PX = 0.2, 2e-4, 100.0
_UNKNOWNS = {True: 6, False: 3}  # Of a moved camera and of a zoomed one: both focal lengths are one


def contradicted(
    measured: Sequence[Measurement], body: Body, cameras: Sequence[Camera]
) -> tuple[str, ...]:
    """The cameras that the others contradict while they agree among each other; none if all do.

    CalibrationError: what is off is not some cameras' alone, and refining would share it out among
    all; or the recording cannot tell which camera is off.
    """
    evidence = evidence_of((), (), measured, body, cameras)
    found, misfit, fit = ([], 0.0, None) if evidence is None else explain(evidence)
    if misfit < _MISFIT or not found or fit is None:
        return ()
    blamed = [one.hypothesis for one in found if one.wrong]
    alone = [h for h in blamed if h.word in _OF_A_CAMERA and h.of and h.since is None]
    names = tuple(dict.fromkeys(h.of for h in alone))
    explained = fit.left < min(_LEFT_SHARE * misfit, _LEFT) and len(alone) == len(blamed)
    explained = explained and len(cameras) - len(names) >= _HELD
    rivals = {
        rival.hypotheses[-1].of
        for one in found
        for rival in one.rivals
        if rival.left < _AS_GOOD * one.fit.left
    }
    if names and explained and rivals <= {*names}:
        return names
    if len(cameras) <= _HELD or (len(names) == 1 and explained):
        raise CalibrationError(
            "cameras contradict each other, and this recording cannot tell which of them is off: "
            "calibrate again, or name the one that was touched with --only"
        )
    if found[0].explains > _MOST and found[0].hypothesis.word in _NO_REMEDY and not alone:
        cause = diagnose(evidence).causes[0]
        message = f"refining would share out among all cameras that {cause.text}: {cause.remedy}"
        raise CalibrationError(message)
    return ()


@dataclass(frozen=True, eq=False)
class FreedRig:
    """Cameras, some of them free, as `refine_rig` takes them, and what that gave."""

    names: tuple[str, ...]
    moved: bool  # whether their poses are free; else their lenses
    cameras: tuple[Camera, ...]
    joint: Floats  # (p, p) the covariance that holds all others where they are
    refinement: Refinement

    def as_stated(
        self, refinement: Refinement, first: Sequence[Camera], joint: Floats | None
    ) -> tuple[tuple[Camera, ...], Floats | None]:
        """A refinement's cameras, those held as they were first; and all covariances, if known.

        What the held ones may be off by, by that covariance, the moved ones are off by as well.
        """
        now = {camera.name: camera for camera in refinement.cameras}
        out = {c.name: replace(c, readout_s=now[c.name].readout_s) for c in first}
        for name in () if self.moved else self.names:
            lens = replace(now[name].intrinsics, covariance=out[name].intrinsics.covariance)
            out[name] = replace(out[name], intrinsics=lens)
        if not self.moved:
            return tuple(out.values()), joint
        P, columns = refinement.covariance, refinement.columns
        held = np.concatenate([columns[c.name][:6] for c in first if c.name not in self.names])
        free = np.concatenate([columns[name][:6] for name in self.names])
        follows = np.linalg.solve(P[np.ix_(held, held)], P[np.ix_(held, free)]).T
        known = P[np.ix_(free, free)] - follows @ P[np.ix_(held, free)]
        if joint is not None:
            ends = np.cumsum([0, *(len(camera.free) for camera in first)])
            rows = {c.name: end + np.arange(6) for c, end in zip(first, ends[:-1], strict=True)}
            to = np.concatenate([rows[name] for name in self.names])
            change = np.eye(len(joint))
            change[to] = 0.0
            others = [rows[camera.name] for camera in first if camera.name not in self.names]
            change[np.ix_(to, np.concatenate(others))] = follows
            joint = change @ joint @ change.T
            joint[np.ix_(to, to)] += known
            known = joint[np.ix_(to, to)]
        for at, name in zip(np.arange(len(free)).reshape(-1, 6), self.names, strict=True):
            moved = replace(now[name], intrinsics=out[name].intrinsics)
            out[name] = replace(
                moved, pose_covariance=known[np.ix_(at, at)], pose_intrinsics_covariance=None
            )
        return tuple(out.values()), joint


def freed(
    cameras: Sequence[Camera],
    names: Sequence[str],
    body: Body,
    recording: Recording,
    settings: RefineSettings | None = None,
) -> FreedRig:
    """Some cameras freed by what of them was off, and refined; CalibrationError as `refine_rig`."""
    tried: list[tuple[float, FreedRig]] = []
    for moved in (True, False):
        rig, joint = loosened(cameras, names, moved)
        refinement = refine_rig(rig, body, recording, settings, joint)
        criterion = 0.0
        for name in names:  # neighbouring pictures are alike
            count = 2 * len(recording.tracks[name].frame) / refinement.noise.correlation
            criterion += 2 * count * float(np.log(max(refinement.rms_px[name][1], 1e-6)))
            criterion += _UNKNOWNS[moved] * float(np.log(count))
        tried.append((criterion, FreedRig(tuple(names), moved, rig, joint, refinement)))
    return min(tried, key=lambda one: one[0])[1]


def loosened(
    cameras: Sequence[Camera], names: Sequence[str], moved: bool
) -> tuple[tuple[Camera, ...], Floats]:
    """The cameras, and a covariance that frees poses or lenses of some and holds all else."""
    out, sds = [], []
    for camera in cameras:
        free, lens = camera.name in names, camera.intrinsics
        zoomed = zoom_prior(lens, _ASPECT_SD, _POINT_SD_PX) if free and not moved else None
        lens = replace(lens, covariance=zoomed)
        out.append(replace(camera, intrinsics=lens, pose_covariance=None))
        sds.append(FREE_SD if free and moved else HELD_SD)
    return tuple(out), joint_prior(out, sds)


def zoom_prior(lens: Intrinsics, aspect_sd: float, point_sd_px: float) -> Floats:
    """The covariance (12, 12) of a lens with free focal length and principal point.

    Args:
        aspect_sd: of its two focal lengths against each other, as a share.
        point_sd_px: of each coordinate of the principal point.
    """
    focal, out = np.diag(lens.matrix)[:2], np.zeros((12, 12))
    out[:2, :2] = ZOOM_SD**2 * np.outer(focal, focal) + np.diag(aspect_sd * focal) ** 2
    out[2:4, 2:4] = point_sd_px**2 * np.eye(2)
    return out


def joint_prior(cameras: Sequence[Camera], pose_sds: Sequence[Floats]) -> Floats:
    """The covariance of all poses, by their standard deviations (6,), and free lens parameters."""
    from scipy.linalg import block_diag

    blocks = []
    for camera, sd in zip(cameras, pose_sds, strict=True):
        blocks.append(np.diag(sd**2))
        lens, free = camera.intrinsics.covariance, camera.intrinsics.free
        if lens is not None and len(free):
            blocks.append(lens[np.ix_(free, free)])
    return np.asarray(block_diag(*blocks), dtype=np.float64)
