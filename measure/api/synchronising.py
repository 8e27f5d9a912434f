"""Clock offsets of any size, from what the cameras of a session see; `measure sync` writes them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from itertools import count, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from measure.api.measuring import calibrated_pipeline, measure_frame_sets
from measure.api.outputs import output
from measure.api.profiles import DEFAULT_PROFILE, build_detectors, load_profile
from measure.api.warming_up import warm_pipeline
from measure.arrays import Floats
from measure.checking.clocks import CameraClock, estimate_clocks
from measure.checking.synchronisation import BallTracks, synchronise
from measure.errors import ConfigError, SessionError
from measure.host import Registry
from measure.measuring import Profile
from measure.model import Camera
from measure.processes import Progress, quiet
from measure.session import Session, open_session, session_file
from measure.session.timestamps import add_time_offsets

_FINE_SETS, _FINE_PASSES = 120, 2
"""Frame sets measured to compare the clocks, and how often: images are then paired anew."""
_IMAGE_STEP_S = 1 / 40
"""Images closer in time than this are passed over: balls do not move in between."""


def find_offsets(
    session: Session,
    registry: Registry,
    profile: Profile,
    largest_s: float,
    seconds: float,
    progress: Progress = quiet,
) -> dict[str, float]:
    """Search every camera's pictures for the balls, and `synchronise` the clocks by their paths.

    So many seconds from the start of each camera are looked at; the session is opened
    `clocks_apart` if its cameras have no time in common.
    """
    warm_pipeline(profile, registry, session.body, session.cameras)
    chosen = {name: _spaced(s.times_s, seconds) for name, s in session.streams.items()}
    total = sum(map(len, chosen.values()))
    done = count(1)
    detectors = build_detectors(profile, registry, session.body, session.cameras)

    def tracks(camera: Camera) -> BallTracks:
        found = []
        for position in chosen[camera.name]:
            image = session.streams[camera.name].read(position)
            found.append(detectors[camera.name].detect(image, ()))
            progress(next(done), total)
        return BallTracks.of(camera, session.body, found)

    with ThreadPoolExecutor(len(session.cameras)) as pool:
        seen = list(pool.map(tracks, session.cameras))
    step_s = 0.02 if largest_s > 5 else 0.01
    return synchronise(seen, largest_s, step_s)


def shift_clocks(session: Session, shifts_s: Mapping[str, float]) -> None:
    """Add to the stamps of an opened session's cameras."""
    for name, shift_s in shifts_s.items():
        stream = session.streams[name]
        stream.times_s = stream.times_s + shift_s


def _spaced(times_s: Floats, seconds: float) -> list[int]:
    """Positions of images that are spaced widely enough, up to a time."""
    out = list[int]()
    for i in np.flatnonzero(times_s <= times_s[0] + seconds):
        if not out or times_s[i] - times_s[out[-1]] > _IMAGE_STEP_S:
            out.append(int(i))
    return out


class SyncedClock(NamedTuple):
    """What was added to a camera's stamps, 0 for the first camera; and its standard deviation."""

    offset_s: float
    sd_s: float


def sync(
    session: Path,
    registry: Registry,
    profile: Profile | str = DEFAULT_PROFILE,
    out: Path | None = None,
    overwrite: bool = False,
    seconds: float = 120.0,
    progress: Progress = quiet,
) -> Mapping[str, SyncedClock]:
    """Synchronise cameras that were started by hand, by the balls' motion.

    Writes what to add to each camera's times as `time_offset_s` into the session file; the first
    camera's clock is kept. Refused where the motion cannot tell.

    Args:
        session: the session's folder.
        profile: how to measure the session, by name or TOML file.
        out: a new session file to write instead of the session's own, in the same folder.
        overwrite: replace offsets, or a file, that are there.
        seconds: how much of each recording is looked at, from its start.
    """
    if not seconds > 0:
        raise ConfigError(f"{seconds:g} seconds: must be more than 0")
    # The session's own file is not replaced, but added to.
    with output(out or session_file(session), overwrite or out is None) as written:
        file = session_file(session)
        with open_session(file, clocks_apart=True) as opened:
            # Offsets that may not be replaced are refused before anything is searched.
            add_time_offsets(file, dict.fromkeys(opened.streams, 0.0), overwrite)
            clocks = _synced(opened, registry, load_profile(profile), seconds, progress)
        offsets_s = {name: clock.offset_s for name, clock in clocks.items()}
        written.write_text(add_time_offsets(file, offsets_s, overwrite), "utf-8")
    return clocks


def _synced(
    session: Session, registry: Registry, profile: Profile, seconds: float, progress: Progress
) -> dict[str, SyncedClock]:
    streams = session.streams.values()
    span = max(s.times_s[-1] for s in streams) - min(s.times_s[0] for s in streams)
    found = find_offsets(session, registry, profile, float(span), seconds, progress)
    before = {name: stream.times_s[0] for name, stream in session.streams.items()}
    shift_clocks(session, found)
    sds_s = dict.fromkeys(found, 0.0)
    for _ in range(_FINE_PASSES if len(found) == len(before) else 0):
        clocks = _fine(session, registry, profile)
        shift_clocks(session, {c.camera: c.offset_s for c in clocks})
        sds_s = {c.camera: c.offset_sd_s for c in clocks}
    if lacking := [name for name in before if not sds_s.get(name, np.inf) < np.inf]:
        raise SessionError(
            f"{session.path}: the motion does not tell the clock of {', '.join(lacking)}: it takes "
            "some seconds in which two cameras see the balls move, without repeating itself; and "
            "cameras that stand where the calibration says"
        )
    added = {name: float(s.times_s[0] - before[name]) for name, s in session.streams.items()}
    first = next(iter(added))
    sds_s = {n: math.hypot(sd, sds_s[first]) for n, sd in sds_s.items()} | {first: 0.0}
    return {name: SyncedClock(added[name] - added[first], sds_s[name]) for name in added}


def _fine(session: Session, registry: Registry, profile: Profile) -> tuple[CameraClock, ...]:
    """The clocks by poses, where most cameras have pictures at a time."""
    together = (session.pair().positions >= 0).sum(axis=1)
    window = min(_FINE_SETS, len(together))
    start = int(np.argmax(np.convolve(together, np.ones(window), mode="valid")))
    pipeline = calibrated_pipeline(session, profile, registry, start=start)
    measured = islice(measure_frame_sets([pipeline], session.frame_sets(start=start)), window)
    return estimate_clocks((m for _, (m,) in measured), session.body, session.cameras)
