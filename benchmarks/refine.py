"""Errors of cameras before and after `measure refine`, on a recording with known cameras.

    python -m benchmarks.refine SESSION TRUTH [--calibration FIRST] [--slips 5]

SESSION is a recording, TRUTH the calibration of its true cameras, FIRST the calibration to refine.
Before and after are printed: the cameras' pose errors (RMS over the cameras) as they stand and
after the rigid motion that brings the measured body closest to the truth; the error that the
cameras alone cost a body (200 poses in the workspace) in the world, and after that motion; and the
normalised squared error of all cameras (1 if the reported covariance is right). Then the same over
some calibrations without covariances, made by moving the true cameras by 0.5 mm and 0.1 deg (1 sd
per axis). Last, what the recording could do for FIRST at best: the standard deviation of the
cameras' places if every ball's centre were found without a bias, with noise alone.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.calibration import BODY, poses
from benchmarks.command import run_command
from benchmarks.errors import body_cost, rms
from measure.api import refine
from measure.arrays import Floats
from measure.calibration import RefineSettings, refine_rig
from measure.calibration.refining.recording import Recording
from measure.calibration.refining.refine import Refinement
from measure.errors import MeasureError
from measure.geometry import align_points
from measure.host import Registry
from measure.model import Camera
from measure.session import Calibration, read_calibration, write_calibration

SLIP = np.repeat([0.5, np.deg2rad(0.1)], 3)
AT = poses(np.array([0.0, 0.0, 250.0]))
NAMES = ("camera mm", "deg", "aligned mm", "deg", "body mm", "aligned mm")


def figures(found: tuple[Camera, ...], true: tuple[Camera, ...]) -> Floats:
    """The six figures called `NAMES`."""
    shifts = body_cost(found, true, BODY, AT)
    places = np.stack([pose.translation for pose in AT])
    back = align_points(places, places + shifts)
    out = []
    for world in (None, back):
        errors = np.stack(
            [
                (c.world_from_camera if world is None else world @ c.world_from_camera).difference(
                    t.world_from_camera
                )
                for c, t in zip(found, true, strict=True)
            ]
        )
        out += [rms(errors[:, :3]), float(np.degrees(rms(errors[:, 3:])))]
    return np.array([*out, rms(shifts), rms(back.apply(places + shifts) - places)])


def normalised(refinement: Refinement, true: tuple[Camera, ...]) -> float:
    """Squared error of all cameras' poses in units of the reported covariance, per parameter."""
    own = np.concatenate([columns[:6] for columns in refinement.columns.values()])
    errors = np.concatenate(
        [
            t.world_from_camera.difference(c.world_from_camera)
            for c, t in zip(refinement.cameras, true, strict=True)
        ]
    )
    P = refinement.covariance[np.ix_(own, own)]
    return float(errors @ np.linalg.solve(P, errors) / len(errors))


def show(name: str, before: Floats, after: Floats) -> None:
    """One line."""
    cells = "  ".join(
        f"{label} {a:.4f} -> {b:.4f}" for label, a, b in zip(NAMES, before, after, strict=True)
    )
    print(f"{name:10} {cells}", flush=True)


def best_possible(recording: Recording, first: tuple[Camera, ...], joint: Floats) -> None:
    """Print the accuracy that unbiased centres would give, by their noise."""
    for noise_px in (0.1, 0.03, 0.01, 0.003):
        tracks = {}
        for camera in first:
            track = recording.tracks[camera.name]
            place = recording.world_from_body
            arms = np.einsum("nij,nj->ni", place.rotation[track.frame], BODY.centers[track.ball])
            exact = camera.project(arms + place.translation[track.frame])
            noise = np.tile(np.eye(2) * noise_px**2, (len(exact), 1, 1))
            zero = np.zeros(len(exact))
            tracks[camera.name] = replace(track, pixels=exact, covariance=noise, lead_s=zero)
        perfect = replace(recording, tracks=tracks)
        settings = RefineSettings(constant_px=1e-4, least_sd_px=1e-4, body_tolerance_mm=0)
        found = refine_rig(first, BODY, perfect, settings, joint)
        before, after = (
            np.sqrt(np.mean([np.diag(P)[c[:3]].sum() for c in found.columns.values()]))
            for P in (found.prior, found.covariance)
        )
        print(
            f"no bias, noise {noise_px:5} px: camera places {before:.3f} -> {after:.3f} mm (1 sd)"
        )


def try_given(session: str, calibration: str, registry: Registry, true: tuple[Camera, ...]) -> None:
    """Refine a given calibration; print the result and the best possible one."""
    first = read_calibration(calibration)
    result = refine(session, registry, calibration=calibration)
    refinement = result.rig.refinement
    show("given", figures(first.cameras, true), figures(refinement.cameras, true))
    print(f"normalised squared error {normalised(refinement, true):.2f}", *result.notes, sep="\n")
    for clock in result.rig.clocks:
        print(
            f"{clock.camera}: clock {1e3 * clock.offset_s:+.2f} ms, "
            f"sd {1e3 * clock.offset_sd_s:.2f} ms, applied: {result.rig.clocks_applied}"
        )
    joint = first.provenance.get("joint_covariance")
    if joint is not None:
        best_possible(result.rig.recording, first.cameras, np.asarray(joint, dtype=np.float64))


def try_slipped(session: str, count: int, registry: Registry, true: tuple[Camera, ...]) -> None:
    """Refine calibrations without covariances whose cameras are off."""
    rows = []
    for seed in range(count):
        slips = np.random.default_rng(seed).normal(0, SLIP, (len(true), 6))
        cameras = tuple(
            Camera(c.name, c.intrinsics, c.world_from_camera.perturb(slip))
            for c, slip in zip(true, slips, strict=True)
        )
        with TemporaryDirectory() as folder:
            file = Path(folder) / "slipped.toml"
            write_calibration(file, Calibration(cameras))
            try:
                refinement = refine(session, registry, calibration=file).rig.refinement
            except MeasureError as refusal:
                print(f"slipped {seed}: refused: {refusal}")
                continue
        rows.append((figures(cameras, true), figures(refinement.cameras, true)))
        show(f"slipped {seed}", *rows[-1])
        print(f"normalised squared error {normalised(refinement, true):.2f}")
    if rows:
        show("RMS", *np.sqrt(np.mean(np.square(rows), axis=0)))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session")
    parser.add_argument("truth")
    parser.add_argument("--calibration", help="the first calibration to refine")
    parser.add_argument("--slips", type=int, default=5)
    options = parser.parse_args()
    registry, true = Registry.discover(), read_calibration(options.truth).cameras
    if options.calibration is not None:
        try_given(options.session, options.calibration, registry, true)
    try_slipped(options.session, options.slips, registry, true)


if __name__ == "__main__":
    run_command(main)
