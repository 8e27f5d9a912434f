"""Clock offsets of any size, from what the cameras of a session see."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from itertools import count

import numpy as np

from measure.api.warming_up import warm_pipeline
from measure.arrays import Floats
from measure.checking.synchronisation import BallTracks, synchronise
from measure.host import Registry
from measure.measuring import Profile
from measure.model import Camera
from measure.processes import Progress
from measure.session import Session

_STEP_S = 0.01
_IMAGE_STEP_S = 1 / 40
"""Images closer in time than this are passed over: balls do not move in between."""


def find_offsets(
    session: Session,
    registry: Registry,
    profile: Profile,
    largest_s: float,
    seconds: float,
    progress: Progress | None = None,
) -> dict[str, float]:
    """Search every camera's pictures for the balls, and find the clocks from their paths.

    Args:
        session: opened; `clocks_apart` if its cameras have no time in common.
        registry: where the plugins come from.
        profile: whose detector searches.
        largest_s: the largest difference of two clocks.
        seconds: how much of each camera's recording is looked at, from its start.
        progress: called with how many pictures are done, and of how many.

    Returns:
        See `synchronise`.
    """
    warm_pipeline(profile, registry, session.body, session.cameras)
    chosen = {name: _spaced(s.times_s, seconds) for name, s in session.streams.items()}
    total = sum(map(len, chosen.values()))
    done = count(1)
    settings = profile.settings.get("detector", {})

    def tracks(camera: Camera) -> BallTracks:
        detector = registry.detector(profile.detector, settings, session.body, camera)
        found = []
        for position in chosen[camera.name]:
            found.append(detector.detect(session.streams[camera.name].read(position), ()))
            if progress is not None:
                progress(next(done), total)
        return BallTracks.of(camera, session.body, found)

    with ThreadPoolExecutor(len(session.cameras)) as pool:
        seen = list(pool.map(tracks, session.cameras))
    return synchronise(seen, largest_s, _STEP_S)


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
