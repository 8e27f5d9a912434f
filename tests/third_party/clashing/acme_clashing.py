"""Another detector that calls itself `blob`."""

from __future__ import annotations

from measure.host import Detector, hookimpl


class OtherBlob(Detector):
    """Finds nothing."""

    name = "blob"

    def detect(self, image, expected):
        """See nothing."""
        return []


@hookimpl
def measure_detectors():
    """Register the other `blob`."""
    return [OtherBlob]
