"""Which thresholds does anything notice? `python -m benchmarks.constants [ROOM ...]`.

Numbers that modules of tracking, checking or calibration name are doubled and halved; what balls of
known places show is measured, checked and calibrated with them, right and with faults. Printed is
what changes: a word, or an error or a variance by more than a hundredth.
"""

# mypy: disable-error-code=no-untyped-call
from __future__ import annotations

import ast
import importlib
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np

from measure.calibration import refine_rig
from measure.calibration.extrinsics import fit_rig_with_boards
from measure.geometry import RigidTransform
from measure.model import Body, Doubt
from tests.calibration.refining import cases
from tests.calibration.rigs import rig
from tests.checking import test_causes as faults
from tests.measuring.tracking import test_pose_checks as tracked
from tests.scenes import RAVEN, TARGET, displaced, ring
from tests.tracking_rig import run

Outcome = list[str | float]


class Constant(NamedTuple):
    """A number at the top of a module."""

    module: str
    name: str
    value: float

    def multiply(self, share: float) -> None:
        """Wherever the name was imported."""
        whole = isinstance(self.value, int)
        value = max(round(share * self.value), 1) if whole else share * self.value
        for name, module in list(sys.modules.items()):
            if name.startswith("measure") and vars(module).get(self.name) is self.value:
                vars(module)[self.name] = value


def constants(room: str) -> Iterator[Constant]:
    """Those of a room that functions read."""
    for file in sorted(Path(room).rglob("*.py")):
        text, module = file.read_text("utf-8"), ".".join(file.with_suffix("").parts)
        tree, names = ast.parse(text), vars(importlib.import_module(module))
        bodies = [n.body for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)]
        lines = [node for body in bodies for line in body for node in ast.walk(line)]
        read = {node.id for node in lines if isinstance(node, ast.Name)}
        at_top = [t for node in tree.body if isinstance(node, ast.Assign) for t in node.targets]
        for name in (n.id for t in at_top for n in ast.walk(t) if isinstance(n, ast.Name)):
            value = names[name] if name in read else None
            if type(value) in (int, float) and value and "@compiled" not in text:
                yield Constant(module, name, value)


def _places(seen: Sequence[Body | None], time_s: float) -> list[tuple[Body, RigidTransform]]:
    beside = RigidTransform.from_rotvec([0, 0, 1.5], TARGET + np.array([90.0, -40, 20]))
    return [(body or RAVEN, tracked.path(time_s) if body else beside) for body in seen]


def tracking() -> Outcome:
    """Good recordings, and cameras, bodies and balls that are not where files say."""
    cameras, edges = ring(), {"bias": tracked.edges}
    small = Body("33", tuple(replace(b, center_mm=b.center_mm * 33 / 38) for b in RAVEN.balls))
    gone = {"hide": lambda _, camera, t: 0.2 < t < 0.3 or (camera == "cam0" and t > 0.4)}
    out: Outcome = []
    for seen, assumed, rig_of, how in (
        ([RAVEN], RAVEN, cameras, edges),
        ([RAVEN], RAVEN, cameras, {"phases": [0.0, 0.011, 0.024, 0.006], "smoothing": True}),
        ([RAVEN], RAVEN, cameras, gone | {"sharp": False}),
        ([RAVEN], RAVEN, tracked.turned(cameras, "cam1", 0.3), edges | {"assumed": cameras}),
        ([RAVEN], small, cameras, {}),
        ([RAVEN, None], RAVEN, cameras, {}),
    ):
        for one in run(assumed, partial(_places, seen), rig_of, 20, **how)[0]:
            out += [one.status.name, one.reason, *(v.reason.name for v in one.views)]
            if one.pose is not None:
                off = one.pose.world_from_body.difference(tracked.path(one.pose.time_s))
                out += [Doubt.of(flag).code for flag in one.pose.flags]
                out += [float(np.linalg.norm(off[:3])), *np.diag(one.pose.covariance)]
    return out


def checking() -> Outcome:
    """A right rig, and one fault after the other."""
    out, turn = list[str | float](), faults.turned("cam1", np.array([0, np.radians(0.3), 0]))
    moved = {"real": lambda k: turn if k > 11 else faults.CAMERAS}
    late = {"late": lambda k: np.array([0, 0.1, 0, 0]) * (k > 11)}
    bent = displaced(RAVEN, "green", (1, 0, 0))
    for fault in ({}, moved, {"stated": faults.zoomed(1.01, "cam2")}, {"body": bent}, late):
        found = faults.diagnosed(**fault)
        out += [found.misfit, found.left]
        for one in found.causes:
            out += [one.cause.name, one.of, one.level.name, *one.rivals, one.estimate or 0.0]
    return out


def calibrating() -> Outcome:
    """A rig by boards and marks; then bodies that move, before cameras and clocks that are off."""
    world, out = rig(np.random.default_rng(1)), list[str | float]()
    located, tolerances = fit_rig_with_boards(world.start, world.observations)
    out += [*np.diag(located.covariance), tolerances.board_mm, located.mark_sd_px]
    for given in (cases.case(3, 30), cases.case(5, 24, 1.0, drift_px=0.6)):
        found = refine_rig(given.start, cases.BODY, given.recording)
        out += [*cases.errors(found.cameras, given), *np.diag(found.covariance)]
    return out


def outcome(way: Callable[[], Outcome], constant: Constant, share: float) -> Outcome:
    """What comes of it with another value, in a process of its own; what it raises, if it does."""
    with get_context("fork").Pool(1, constant.multiply, (share,)) as pool:
        try:
            return pool.apply_async(way).get(120.0)
        except Exception as error:
            return [type(error).__name__]


def noticed(before: Outcome, after: Outcome) -> str:
    """What differs; empty if nothing does."""
    words = [[one if isinstance(one, str) else "" for one in some] for some in (before, after)]
    if words[0] != words[1]:
        return "words"
    a, b = (np.array([one for one in some if not isinstance(one, str)]) for some in (before, after))
    change = np.nanmax(np.abs(b - a) / np.maximum(np.abs(a), 1e-12))
    return f"{100 * change:.0f} %" if change > 0.01 else ""


def main() -> None:
    """Print a row for each constant."""
    ways = {"measuring": tracking, "checking": checking, "calibration": calibrating}
    for room, way in ((room, ways[room]) for room in sys.argv[1:] or ways):
        _, before = way(), way()  # compiled by the first
        for one in constants(f"measure/{room}"):
            told = [noticed(before, outcome(way, one, share)) for share in (2.0, 0.5)]
            print("|", f"{one.module}.{one.name}", one.value, *told, sep=" | ", flush=True)


if __name__ == "__main__":
    main()
