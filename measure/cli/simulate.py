"""`measure simulate`: a recording of a robot that never was."""

from __future__ import annotations

from measure import api
from measure.cli import console
from measure.cli.console import OutFile, Overwrite


def simulate(
    *,
    out: OutFile,
    overwrite: Overwrite = False,
    seconds: float = 60.0,
    frame_hz: float = 15.0,
    seed: int = 1,
    clock_offset_s: float = 1.5,
    wear: float = 1.0,
) -> None:
    """Render a recording of the simulated RAVEN-II, with its log and its truth.

    Args:
        out: the session's folder. The robot's log is `robot.parquet` in it.
        seconds: length of the recording.
        frame_hz: frame sets per second.
        seed: of motion, restart and pictures.
        clock_offset_s: how far the robot's clock is ahead of the cameras'.
        wear: slack and friction relative to new cables.
    """
    with (
        api.new_folder(out, overwrite, "session.toml"),
        console.progress("rendering", unit="pictures") as report,
    ):
        api.simulate_recording(
            out,
            seconds=seconds,
            frame_hz=frame_hz,
            seed=seed,
            clock_offset_s=clock_offset_s,
            wear=wear,
            progress=report,
        )
    console.print_text(f"written to {out}; measure it with: measure run {out} -o RUN")
