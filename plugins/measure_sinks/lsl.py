"""The sink `lsl`: a stream of the Lab Streaming Layer, beside EEG and all else that is recorded."""

from __future__ import annotations

import time
from typing import Any

from measure.errors import ConfigError
from measure.host import EventMark, SentPose, Sink, hookimpl, needed
from measure.host.interfaces import PLACE, pose_columns

_STATUS = ("ok", "flagged", "lost", "skipped")
_CHANNELS = (
    *((name, "Position", "millimeters") for name in PLACE[:3]),
    *((name, "Orientation", "none") for name in PLACE[3:]),
    ("position_sd_mm", "Accuracy", "millimeters"),
    ("rotation_sd_deg", "Accuracy", "degrees"),
    ("status", "Status", "none"),
)


class LslSink(Sink):
    """A stream with a sample for every frame set, and a stream of event marks.

    Each body and relative pose has ten channels. Without a pose their numbers are NaN; the status
    is 0 ok, 1 flagged, 2 lost, 3 skipped.
    """

    name = "lsl"
    form = "lsl:NAME"

    def prepare(self) -> None:
        """Read the address and load the libraries."""
        if not self.address:
            raise ConfigError("expected a name for the stream")
        self._lsl = needed("pylsl", "lsl")
        # Once, as the clock may be set later. An interruption between the two makes it too small.
        self._begun_s = max(time.time() - float(self._lsl.local_clock()) for _ in range(10))
        self._poses: Any = None
        self._marks: Any = None
        self._sample, self._of, self._exposed_s = list[float](), -1, 0.0

    def open(self) -> None:
        """Offer the streams."""
        streams = self.run.streams
        info = self._info(self.address, "MoCap", len(_CHANNELS) * len(streams))
        labels, types, units = zip(*_CHANNELS, strict=True)
        names = ["_in_".join(filter(None, one)) for one in streams]
        info.set_channel_labels([f"{name}_{label}" for name in names for label in labels])
        info.set_channel_types(list(types) * len(streams))
        info.set_channel_units(list(units) * len(streams))
        info.desc().append_child_value("status", " ".join(_STATUS))
        self._poses = self._lsl.StreamOutlet(info)
        self._marks = self._lsl.StreamOutlet(self._info(f"{self.address}-marks", "Markers", 1))

    def send(self, pose: SentPose) -> None:
        """Put it in the sample of its frame set, which is sent when it is complete."""
        streams, stream = self.run.streams, (pose.body, pose.reference)
        if pose.frame != self._of:
            self._push()
            self._sample = [float("nan")] * len(_CHANNELS) * len(streams)
            self._of, self._exposed_s = pose.frame, pose.exposed_s
        if stream in streams:
            values = pose_columns(pose.pose) | {"status": float(_STATUS.index(pose.status))}
            at = streams.index(stream) * len(_CHANNELS)
            self._sample[at : at + len(_CHANNELS)] = [values[name] for name, *_ in _CHANNELS]
        if stream == streams[-1]:
            self._push()

    def send_mark(self, mark: EventMark) -> None:
        """A sample at the mark's time."""
        self._marks.push_sample([mark.text], mark.marked_s - self._begun_s)

    def close(self) -> None:
        """Withdraw the streams."""
        self._poses = self._marks = None
        self._sample = []

    def _push(self) -> None:
        if self._sample:
            self._poses.push_sample(self._sample, self._exposed_s - self._begun_s)
        self._sample, self._of = [], -1

    def _info(self, name: str, kind: str, channels: int) -> Any:
        """The description of a stream of irregular rate, in double precision or text."""
        form = self._lsl.cf_string if kind == "Markers" else self._lsl.cf_double64
        return self._lsl.StreamInfo(name, kind, channels, 0.0, form, f"triball:{name}")


@hookimpl
def measure_sinks() -> list[type[Sink]]:
    """Register `lsl`."""
    return [LslSink]
