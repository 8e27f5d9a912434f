"""Poses of running cameras, one after the other, without a run folder."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from functools import partial

from measure.api import Measurement, Profile
from measure.api.measuring import live_pipelines, measure_frame_sets
from measure.api.profiles import build_pipeline
from measure.api.warming_up import warm_pipeline
from measure.errors import ConfigError
from measure.host import Registry
from measure.model import Body
from measure.session import Calibration, check_unit
from measure_studio.api import recording
from measure_studio.capture import Gathering, parse_cameras


def stream(
    cameras: Mapping[str, int | str],
    rig: Calibration,
    body: Body,
    profile: Profile,
    registry: Registry,
) -> Iterator[Measurement]:
    """Measure running cameras until the iterator is closed, or the cameras end.

    Args:
        cameras: by name a number of this computer's cameras, a device or an address.

    Raises:
        MeasureError: a camera cannot be reached, or what is given does not fit together.
    """
    if len(cameras) < 2:
        raise ConfigError(f"a measurement needs at least two cameras, got {len(cameras)}")
    addresses = parse_cameras([f"{name}={address}" for name, address in cameras.items()])
    calibrated = tuple(rig.camera(one.name) for one in addresses)
    check_unit(rig, body, "the rig", "give lengths in mm")
    profile = profile.model_copy(update={"smoothing": False})
    warm = warm_pipeline(profile, registry, body, calibrated)
    sources = recording.sources_of(addresses, calibrated)
    options = recording.CaptureOptions()
    with ExitStack() as stack:
        opened = stack.enter_context(recording.open_rig(sources, calibrated, options))
        gathering = Gathering(list(opened.cameras.addresses), on_read=opened.cameras.note_read)
        over = opened.begin(gathering.add)
        # Each call begins with the frame sets that come then.
        frame_sets = partial(gathering.frame_sets, over, opened.cameras.check)
        build = partial(build_pipeline, profile, registry)
        pipelines = live_pipelines([warm], build, frame_sets)
        for frame_set, (measured,) in measure_frame_sets(pipelines, frame_sets()):
            opened.cameras.note_copies(frame_set.images, measured.copies)
            yield measured
        opened.cameras.check()
