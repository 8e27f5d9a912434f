"""`measure view`: a run in the Rerun viewer."""

from __future__ import annotations

from pathlib import Path

from measure.cli import console
from measure.errors import ConfigError, RunError
from measure.neighbours import VIEWS, lacking, offer


def view(
    run: Path,
    /,
    *,
    web: bool = False,
    bind: str = "127.0.0.1",
    robot: str | None = None,
    robot_log: Path | None = None,
    model: Path | None = None,
    frame: Path | None = None,
    clock_offset_s: float | None = None,
) -> None:
    """Show a run in the viewer.

    Args:
        run: the run's folder, or an .rrd file.
        web: serve the viewer for a browser and print the address, instead of opening a window.
        bind: address to listen on; other machines can look only if you change it.
        robot: show a robot's reported position beside the measured one, in a recording of its own
            (robot.rrd in the run's folder): a known one (see `measure dataset`), a robot.toml or a
            .urdf.
        robot_log: the robot's log; the one that the session names if omitted.
        model: an estimator (.onnx, or `shipped`): its corrected position is shown too.
        frame: where the robot is, written by `measure register`.
        clock_offset_s: robot time minus camera time, if known.
    """
    from measure.viewing.viewer import open_viewer, recording_of

    if robot is None and (robot_log or model or frame):
        raise ConfigError("say with --robot what the robot's states are, such as --robot raven")
    recordings = [recording_of(run)]
    if robot is not None:
        write = offer(VIEWS, "robot", "`--robot`")
        if write is None:
            raise lacking("`--robot`", "measure_learning")
        recordings.append(write(run, robot, robot_log, model, frame, clock_offset_s))
    viewer = open_viewer(recordings, web, bind)
    if viewer.address is not None:
        console.print_text(viewer.address)
    try:
        code = viewer.process.wait()
    finally:
        viewer.process.terminate()
        viewer.process.wait()
    if code > 0:
        raise RunError(
            f"the viewer gave up with exit code {code}, see above; without a screen, add --web"
        )
