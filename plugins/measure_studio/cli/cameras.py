"""`measure cameras`: which cameras there are, and what they can do."""

from __future__ import annotations

from collections.abc import Sequence

from measure.cli import console
from measure.cli.console import JsonFlag
from measure.cli.options import command
from measure_studio import api
from measure_studio.capture import FoundCamera, Mode


@command(api.cameras)
def cameras(found: Sequence[FoundCamera], json: JsonFlag = False) -> None:
    """Print the cameras."""
    if json:
        console.print_json({"cameras": found})
    elif not found:
        console.print_text("this machine has no cameras; of the network, give addresses")
    for one in [] if json else found:
        console.print_text("\n".join(_lines(one)))


def _lines(one: FoundCamera) -> list[str]:
    """What is known of a camera."""
    bus = f", on {one.bus} of {one.bus_mbit_s:g} Mbit/s" if one.bus else ""
    now = f", now {one.path}" if one.path not in ("", one.address) else ""
    lines = [": ".join(filter(None, (one.name, one.address))) + now + bus]
    if one.problem:
        lines.append(f"  {one.problem}")
    if one.now is not None:
        clock = {None: "", True: ", with times of its own", False: ", without times"}
        lines.append(f"  now {_mode(one.now)}{clock[one.own_clock]}")
    lines += [f"  {_mode(mode)}" for mode in one.modes]
    for control in one.controls:
        automatic = f" ({control.setting})" if control.automatic else ""
        lines.append(
            f"  {control.name} = {control.value}{automatic}: {control.takes}; "
            f"default {control.default}"
        )
    return lines


def _mode(mode: Mode) -> str:
    width, height = mode.size_wh
    rates = ", ".join(f"{rate:.3g}" for rate in mode.rates_hz)
    return f"{mode.form} {width}x{height}" + (f" at {rates} a second" if rates else "")
