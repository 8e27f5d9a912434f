"""A sink that appends every pose to a text file, a line each."""

from __future__ import annotations

from io import FileIO

from measure.errors import ConfigError
from measure.host import SentPose, Settings, Sink, hookimpl, setting


class TailSettings(Settings):
    """Settings of the `tail` sink."""

    max_sd_mm: float = setting(1.0, "Poses less sure than this are left out.", unit="mm", gt=0)


class TailSink(Sink):
    """Lines of time and position, for `tail -f` or a named pipe."""

    name = "tail"
    form = "tail:FILE"
    Config = TailSettings
    config: TailSettings

    def prepare(self) -> None:
        if not self.address:
            raise ConfigError("expected a file")
        self._file: FileIO | None = None

    def open(self) -> None:
        self._file = FileIO(self.address, "a")

    def send(self, pose: SentPose) -> None:
        if self._file is None or pose.pose is None or pose.reference:
            return
        if pose.pose.position_sd_mm <= self.config.max_sd_mm:
            x, y, z = pose.pose.world_from_body.translation
            line = f"{pose.time_s:.6f} {pose.body} {x:.3f} {y:.3f} {z:.3f}\n"
            self._file.write(line.encode())

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
        self._file = None


@hookimpl
def measure_sinks() -> list[type[Sink]]:
    """Register `tail`."""
    return [TailSink]
