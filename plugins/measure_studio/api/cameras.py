"""The cameras that there are, of this machine and of the network."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from measure.errors import CaptureError, MeasureError
from measure.model import Image
from measure_studio.capture import CameraAddress, Cameras, FoundCamera, Mode, find_devices
from measure_studio.capture.sources import shown

_LISTEN_S = 2.0


def cameras(addresses: Sequence[str] = ()) -> list[FoundCamera]:
    """List cameras, their modes and controls, and whether they stream.

    Without an address it lists the cameras of this machine. Needs the extra `cameras`.

    Args:
        addresses: cameras to test instead, as `measure record` takes them: size, rate and clock of
            each in two seconds, or why there is no picture.
    """
    if not addresses:
        return find_devices()
    given = [CameraAddress(shown(address), address) for address in addresses]
    devices = find_devices() if any(one.is_device for one in given) else []
    by_path = {Path(one.path): one for one in devices}

    def asked(camera: CameraAddress) -> FoundCamera:
        here = by_path.get(Path(camera.device).resolve()) if camera.is_device else None
        return here or _heard(camera)

    with ThreadPoolExecutor(len(given)) as pool:
        return list(pool.map(asked, given))


def _heard(camera: CameraAddress) -> FoundCamera:
    """What comes from an address in two seconds."""
    images: list[Image] = []
    found = FoundCamera("", camera.name)
    try:
        with Cameras({camera.name: camera.source()}) as rig:
            rig.begin([images.append])
            time.sleep(_LISTEN_S)
            rig.stop()
            rig.wait()
            count = rig.counts[camera.name]
        if not images:
            raise CaptureError(f"no picture in {_LISTEN_S:g} s")
        height, width = images[0].pixels.shape[:2]
    except MeasureError as problem:
        return replace(found, problem=str(problem).removeprefix(f"camera '{camera.name}': "))
    form = "video" if images[0].encoded is None else "MJPG"
    rates = () if math.isnan(count.rate_hz) else (count.rate_hz,)
    return replace(found, now=Mode(form, (width, height), rates), own_clock=count.own_clock)
