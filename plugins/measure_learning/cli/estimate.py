"""`measure estimate`: a robot's positions corrected, live or from a file."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from measure import api
from measure.cli import console
from measure.cli.console import JsonFlag, OutFile, Overwrite
from measure.errors import ConfigError
from measure_learning import api as learning_api
from measure_learning.core import Zeroing

_CROWDED = "too many senders"  # The counter of senders that were refused for want of room


def estimate(
    model: Path,
    /,
    *,
    input_: Path | None = None,
    out: Annotated[OutFile | None, Parameter(name=("--out", "-o", "--output"))] = None,
    overwrite: Overwrite = False,
    rezero: Path | None = None,
    true_positions: Path | None = None,
    frame: Path | None = None,
    host: str = "127.0.0.1",
    port: int = 47118,
    seconds: float | None = None,
    realtime: bool = False,
    json: JsonFlag = False,
) -> None:
    """Correct a robot's positions, live or from a file.

    Without `--input` it answers states that come by UDP, one datagram each, until interrupted.
    What cannot be answered is refused and counted, never guessed.

    Args:
        model: an ONNX file made by `measure train`, or `shipped` for the included one.
        input_: recorded states: Parquet, text or a bag.
        out: where to write the errors and the corrected positions with their SDs (.parquet or
            .csv).
        rezero: a short measured data set of today: finds how the joints were homed, and says
            whether the cables have changed.
        true_positions: a table of tip positions measured now and then (time_s on the states' clock,
            x_mm, y_mm, z_mm): the offsets of the joints follow them. Live, they come by UDP.
        frame: the frame.toml that the labels were measured by: the written SDs then include the
            uncertainty of base and tool.
        host: address to listen on; other machines can reach it only if it is not the loopback.
        port: to listen on; 0 takes a free one.
        seconds: stop after this long.
        realtime: before other processes, with memory that is not swapped (Linux, needs rights).
    """
    if input_ is None and out is not None:
        raise ConfigError("--out needs --input: live estimates go back by UDP")
    if input_ is not None and out is None:
        raise ConfigError("--input needs --out, the file for the errors")
    if input_ is None and true_positions is not None:
        raise ConfigError("--true-positions needs --input: live ones come by UDP")
    if input_ is None and frame is not None:
        raise ConfigError("--frame needs --input: what is stated live is of the labels' frame")
    path = learning_api.model_file(model)
    read = [one for one in (input_, path, rezero, true_positions, frame) if one]
    with api.output(out, overwrite, read) as file:
        zeroing = None if rezero is None else _zeroing(path, rezero)
        if input_ is None:
            _serve(path, (host, port), seconds, realtime, zeroing, json)
            return
        counts = learning_api.estimate_file(
            path, input_, file, zeroing, true_positions=true_positions, frame=frame,
            on_drift=console.note,
        )  # fmt: skip
    _conclude(counts, json, f"written to {out}")
    if 2 * counts["unfamiliar"] > counts["corrected"]:
        console.note("most states are unlike the training: is this the robot that it learnt from?")


def _zeroing(model: Path, stretch: Path) -> Zeroing:
    """Offsets after a restart, printed with the drift of the residuals."""
    zeroing, monitor = learning_api.rezero(model, stretch)
    x, y, z = zeroing.mean_mm
    console.note(
        f"offset {x:+.3f} {y:+.3f} {z:+.3f} mm on average (SD {zeroing.sd_mm:.3f}); "
        f"{monitor.sentence()}"
    )
    return zeroing


def _serve(
    model: Path,
    address: tuple[str, int],
    seconds: float | None,
    realtime: bool,
    zeroing: Zeroing | None,
    json: bool,
) -> None:
    warned = False

    def line(server: Any) -> None:
        nonlocal warned
        counts = server.counters.values()
        if counts[_CROWDED] and not warned:
            warned = True
            console.note(
                "too many senders: new ones are refused until one has been silent for a minute"
            )
        console.note(_counted(counts) + (f"; {drift}" if (drift := server.drift()) else ""))

    served = learning_api.estimate_online(
        model,
        address,
        zeroing=zeroing,
        seconds=seconds,
        realtime=realtime,
        on_start=lambda server: console.note("listening on udp://{}:{}".format(*server.address)),
        on_state=line,
        on_refusal=console.note,
    )
    latency = served.latency_us()
    counts = served.counters.values()
    ending = f"one update: median {latency['p50_us']:.0f} us, 99 % {latency['p99_us']:.0f} us"
    if math.isnan(latency["p50_us"]):
        ending = "nobody sent a state"
    _conclude({**counts, **latency}, json, ending)


def _conclude(counts: dict[str, Any], json: bool, ending: str) -> None:
    if json:
        console.print_json(counts)
    else:
        console.print_text(f"{_counted(counts)}; {ending}")


def _counted(counts: dict[str, Any]) -> str:
    """Counters in words; what never happened is left out, but corrections always stand."""
    words = [f"{counts['corrected']} corrected"]
    words += [
        f"{number} {name}"
        for name, number in counts.items()
        if number and name != "corrected" and not name.endswith("_us")
    ]
    return ", ".join(words)
