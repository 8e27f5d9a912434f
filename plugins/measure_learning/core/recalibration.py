"""A robot recalibrated in the morning: which poses to visit, and what their measurement changes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np

from measure.arrays import Floats, Ints
from measure.errors import EstimatorError
from measure.geometry import chi_square_quantile
from measure.host import Dataset
from measure.limits import TINY
from measure.robots import StateSchema
from measure_learning.core.correction import read_states, rezero
from measure_learning.core.offsets import (
    OFFSET_SD_MM,
    DriftMonitor,
    Zeroing,
    offset_design,
    without_restarts,
)
from measure_learning.core.training import turns_table
from measure_learning.onnx import Graph, OnnxModel, Value
from measure_learning.onnx.kinematics import chain_change
from measure_learning.robots.links import TURNS, link_names

FEWEST = 12  # poses: fewer independent ones tell too little of the zeros
_CANDIDATES = 3000  # most of them, evenly over what is given
_USUAL_LEFT_MM = 1.0  # per axis, of a model that states nothing of other recordings
_HELD = 0.9  # share of a recording's labels in the 95 % region, from which its promise is kept
_LEAST_SHARE = 0.1  # of the stated variance, as `without_restarts`
_ALIKE = 1e-3  # share of the range of a coordinate within which poses are at one place
_PARTS = "below", "above"
_OWN_SHARE = 1.01  # of what a pose is measured with, with a hundredth of its own


@dataclass(frozen=True, eq=False)
class ChosenPoses:
    """Poses to visit, in the order in which they were given."""

    rows: Ints  # (k,) numbered from 0 among the poses that were given
    states: Floats  # (k, features)
    of: int  # poses that there were to choose from
    sd_before_mm: float  # 3-D, of what the day adds, RMS over all those poses
    sd_after_mm: float  # once the chosen ones are measured


def read_candidates(path: Path, model: OnnxModel) -> tuple[Ints, Floats]:
    """Numbers (n,) and states (n, features) of poses whose joints are in the training's ranges.

    A log, a data set or a table of poses that the arm may visit; of many, evenly spread ones.
    EstimatorError: too few.
    """
    states = np.concatenate([table.states for table in read_states(path, model)])
    good = np.isfinite(states).all(axis=1)
    if (known := model.facts.get("range")) is not None:
        low, high = np.array(known).T
        room = _ALIKE * (high - low) + 1e-6
        inside = (states >= low - room) & (states <= high + room)
        of_joints = model.schema.joints or model.schema.position
        read = model.schema.reading_matrix(of_joints).any(axis=1)  # encoders begin anew each day
        good &= inside[:, read].all(axis=1)
    rows = np.flatnonzero(good)
    if len(rows) < FEWEST:
        raise EstimatorError(
            f"{path}: in {len(rows)} of {len(states)} poses the joints are where the training "
            f"had them, {FEWEST} such poses are needed"
        )
    rows = rows[:: -(-len(rows) // _CANDIDATES)]
    return rows, states[rows]


def choose_poses(model: OnnxModel, path: Path, count: int) -> ChosenPoses:
    """The poses of a file whose measurement leaves least of what a day adds, over all of them.

    One after the other, each is the one that lowers most the mean variance that the errors of
    links, zeros and base have at the tip (I-optimal design, Fedorov 1972). A pose is measured with
    what the model leaves within a recording, which is alike where joints differ by less than they
    vary in training: neighbours tell little more than one of them.
    """
    if count < FEWEST:
        raise EstimatorError(f"{count} poses tell too little of a day: choose {FEWEST} or more")
    numbers, states = read_candidates(path, model)
    if count > len(states):
        raise EstimatorError(f"{path}: has {len(states)} poses to choose {count} from")
    size_mm = model.facts.get("offset_sd_mm", OFFSET_SD_MM)
    design, _ = offset_design(model.schema, states, size_mm)
    joints = model.schema.read(states, model.schema.joints or model.schema.position)
    joints /= np.maximum(model.facts.get("joint_sd") or np.ptp(joints, axis=0), TINY)
    chosen, before, after = _greedy(design, joints, _left_sd_mm(model), count)
    chosen.sort()
    return ChosenPoses(numbers[chosen], states[chosen], len(states), before, after)


def _greedy(
    design: Floats, joints: Floats, left_mm: float, count: int
) -> tuple[Ints, float, float]:
    """Rows of a design (n, 3, p) of unknowns of SD 1; what they leave of its RMS, before, after.

    What else is measured at two rows, of SD `left_mm`, correlates by `joints` (n, k), as a Gaussian
    process. All is conditioned on each choice, as in a pivoted Cholesky decomposition.
    """
    eye, chosen = np.eye(3), list[int]()
    moment = np.einsum("nij,nik->jk", design, design) / len(design)
    before = after = float(np.trace(moment))
    across, own = design, design @ np.swapaxes(design, 1, 2) + _OWN_SHARE * left_mm**2 * eye
    shared = list[tuple[Floats, Floats]]()  # covariance (n, 3, 3) with a choice, its inverse (3, 3)
    for _ in range(count):
        gained = np.linalg.solve(own, across)
        worth = np.einsum("nij,nij->n", gained, across @ moment)
        worth[chosen] = -np.inf
        best = int(np.argmax(worth))
        alike = left_mm**2 * np.exp(-0.5 * np.sum((joints - joints[best]) ** 2, axis=1))
        with_it = design @ design[best].T + alike[:, None, None] * eye
        with_it -= sum(one @ inverse @ one[best].T for one, inverse in shared)
        inverse = np.linalg.inv(own[best])
        after -= worth[best]
        across = across - with_it @ (inverse @ across[best])
        own = own - with_it @ inverse @ np.swapaxes(with_it, 1, 2)
        shared.append((with_it, inverse))
        chosen.append(best)
    return np.array(chosen), float(np.sqrt(before)), float(np.sqrt(after))


def _left_sd_mm(model: OnnxModel) -> float:
    """SD per axis of what the model leaves within a recording that it has not seen."""
    left = (model.card.get("left_out") or {}).get("after_mm")
    if not left:
        return _USUAL_LEFT_MM
    offset = model.facts.get("offset_sd_mm", 0.0)
    return float(np.sqrt(max(left**2 / 3.0 - offset**2, _LEAST_SHARE * left**2 / 3.0)))


@dataclass(frozen=True, eq=False)
class Recalibration:
    """What a morning's poses showed."""

    model: OnnxModel
    zeroing: Zeroing
    monitor: DriftMonitor
    measured: Dataset
    squared: Floats  # (n,) squared Mahalanobis lengths of the poses' residuals, held out
    before_mm: float  # RMS, 3-D, that the model leaves of the poses
    held_out_mm: float  # the same, by the offsets of other poses


def recalibrate(model: OnnxModel, measured: Dataset) -> Recalibration:
    """Joint zeros and base of today, judged by poses that each were left out; none if none help.

    EstimatorError: as `rezero` refuses, the data are of another robot, or no offsets help and the
    poses are not where the model states.
    """
    zeroing, monitor = rezero(model, measured, or_none=True)
    if not zeroing.errors.any() and monitor.ratio > monitor.limit:
        raise EstimatorError(
            f"no offsets explain the {int(measured.usable.sum())} poses, and they are "
            f"{monitor.ratio**0.5:.1f} times as far off as the model states: train again"
        )
    used, left = measured.usable, zeroing.held_out_mm
    estimates = model.predict(measured)
    residuals = (measured.errors_mm - estimates.errors_mm)[used]
    stated = without_restarts(estimates.covariances[used], model.facts.get("offset_sd_mm", 0.0))
    stated = stated + zeroing.covariance + measured.covariances[used]
    squared = np.einsum("ni,ni->n", left, np.linalg.solve(stated, left[..., None])[..., 0])
    before, after = (float(np.sqrt((one**2).sum(axis=1).mean())) for one in (residuals, left))
    return Recalibration(model, zeroing, monitor, measured, squared, before, after)


def corrected_model(found: Recalibration, content: bytes) -> bytes:
    """The model's file with today's offsets in its graph, which states what they leave unknown.

    Of the stated variance, what restarts had in it gives way to what is unknown of the offsets.
    """
    model, zeroing = found.model, found.zeroing
    if "gap_mm" not in model.facts:
        raise EstimatorError(f"{model.where}: of an older version: train it again")
    graph = Graph(f"today{crc32(content):08x}_")
    error, covariance = graph.before("error_mm"), graph.before("covariance")
    moved: Value | Floats = zeroing.errors[None]
    if model.schema.chain is not None:
        moved = chain_change(graph, model.schema, "features", zeroing.today)
    restarts = 3.0 * model.facts.get("offset_sd_mm", 0.0) ** 2
    trace = graph.op("MatMul", covariance, np.eye(3).reshape(9, 1))
    kept = graph.op("Sub", [[1.0]], graph.op("Div", [[restarts]], trace))
    kept = graph.op("Mul", covariance, graph.op("Max", kept, [[_LEAST_SHARE]]))
    stated = graph.op("Add", kept, zeroing.covariance.reshape(1, 9))
    sound = graph.op("LessOrEqual", "contradiction", [[1.0]])
    outputs = {
        "error_mm": graph.op("Where", sound, graph.op("Add", error, moved), error),
        "covariance": graph.op("Where", sound, stated, covariance),
    }
    facts = dict(model.facts)
    if facts.get("largest_mm") is not None:
        facts["largest_mm"] += float(np.linalg.norm(zeroing.mean_mm))
    facts["offset_sd_mm"] = zeroing.sd_mm / np.sqrt(3.0)
    facts["recalibrated"] = _offsets(found)
    return graph.extend(content, outputs, {"measure": facts})


def certificate(found: Recalibration, poses: Floats) -> dict[str, Any]:
    """What holds today, as plain values: offsets, errors by region of `poses`, past recordings."""
    model, left_out = found.model, found.model.card.get("left_out") or {}
    turns = [t | {"held": t["inside_95"] >= _HELD} for t in left_out.get("by_recording", ())]
    limit = chi_square_quantile(0.95, 3)
    return {
        "robot": model.robot,
        "estimator": model.facts["estimator"],
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        "poses": len(found.squared),
        "before_mm": found.before_mm,
        "held_out_mm": found.held_out_mm,
        "inside_95": float((found.squared < limit).mean()),
        "drift": found.monitor.sentence(),
        **_offsets(found),
        "regions": _regions(found, poses),
        "recordings": turns,
    }


def _offsets(found: Recalibration) -> dict[str, Any]:
    """Zeros of the joints and errors of the links, mm and deg; without kinematics of the tip."""
    zeroing, schema = found.zeroing, found.model.schema
    sd = np.sqrt(np.diag(zeroing.spread))
    names: tuple[str, ...] = ("tip_x_mm", "tip_y_mm", "tip_z_mm")
    scale = np.ones(len(sd))
    zeros = []
    if (chain := schema.chain) is not None:
        scale[np.resize(TURNS, len(sd))] = np.degrees(1.0)
        names = link_names(chain)
        rows = zip(chain.joints, schema.joints, *zeroing.joints(), strict=True)
        for joint, reading, *pair in rows:
            value, error = np.array(pair) * (1.0 if joint.prismatic else np.degrees(1.0))
            named = {"joint": reading.terms[0][0], "zero": float(value), "sd": float(error)}
            zeros.append(named | {"unit": "mm" if joint.prismatic else "deg"})
    values = (scale * zeroing.errors).tolist()
    links = {"parameters": list(names), "values": values, "sd": (scale * sd).tolist()}
    return {"zeros": zeros, "links": links}


def _regions(found: Recalibration, poses: Floats) -> list[dict[str, Any]]:
    """Stated SD (3-D, RMS) by octants of the tip's places, below and above the middle of each axis.

    The poses are taken one by one: no history is known of them.
    """
    model, schema = found.model, found.model.schema
    places = schema.position_mm(poses)
    middle = np.median(places, axis=0)
    rows, count = np.arange(len(poses)), len(poses)
    alone = Dataset(
        schema, poses, np.zeros(count), rows, tuple(map(str, rows)), np.zeros((count, 3)),
        np.tile(np.eye(3), (count, 1, 1)), np.zeros(count, dtype=bool),
    )  # fmt: skip
    stated = model.predict(alone).covariances
    stated = without_restarts(stated, model.facts.get("offset_sd_mm", 0.0))
    variance = np.trace(stated + found.zeroing.covariance, axis1=1, axis2=2)
    above, out = places > middle, []
    for code in range(8):
        side = np.array([code >> axis & 1 for axis in range(3)], dtype=bool)
        if (here := (above == side).all(axis=1)).any():
            where = {
                f"{axis}_mm": f"{_PARTS[int(up)]} {at:.0f}"
                for axis, up, at in zip("xyz", side, middle, strict=True)
            }
            sd = float(np.sqrt(variance[here].mean()))
            out.append({**where, "poses": int(here.sum()), "sd_mm": sd})
    return out


def certificate_text(facts: Mapping[str, Any]) -> str:
    """The certificate as Markdown."""
    drift, turns = facts["drift"], facts["recordings"]
    said = (
        f"{facts['poses']} poses: the model `{facts['estimator']}` leaves "
        f"{facts['before_mm']:.3f} mm RMS of them, and {facts['held_out_mm']:.3f} mm with the "
        f"offsets that the other poses show; {facts['inside_95']:.0%} of these are in the stated "
        f"95 % region. {drift[:1].upper()}{drift[1:]}."
    )
    zeros = [(z["joint"], f"{z['zero']:+.4f}", f"{z['sd']:.4f}", z["unit"]) for z in facts["zeros"]]
    links = [
        (name, f"{value:+.4f}", f"{sd:.4f}")
        for name, value, sd in zip(*facts["links"].values(), strict=True)
    ]
    regions = [
        (*(r[f"{axis}_mm"] for axis in "xyz"), r["poses"], f"{r['sd_mm']:.2f}")
        for r in facts["regions"]
    ]
    past = ["None was left out: nothing is promised of another day."]
    if turns:
        held = sum(turn["held"] for turn in turns)
        past = [f"{held} of {len(turns)} have nine of ten labels in the region.", ""]
        past += turns_table(turns)
    parts = [
        [f"# {facts['robot']}, recalibrated {facts['made']}", "", said],
        ["## Zeros, to add to the joints", ""],
        _table(("joint", "zero", "SD", "unit"), zeros),
        ["## All errors of the links, in which zeros and base are", ""],
        _table(("of the frame before the joint", "value", "SD"), links),
        ["## Stated error by region of the tip (SD, 3-D, mm)", ""],
        _table(("x, mm", "y, mm", "z, mm", "poses", "SD"), regions),
        ["## Recordings of the training, each by fits that have not seen it", "", *past],
    ]
    return "".join("\n".join(part) + "\n\n" for part in parts).replace("\n\n\n", "\n\n")


def _table(heads: Sequence[str], rows: Sequence[Sequence[object]]) -> list[str]:
    return ["| " + " | ".join(map(str, row)) + " |" for row in (heads, ["---"] * len(heads), *rows)]


def pose_columns(schema: StateSchema, chosen: ChosenPoses) -> dict[str, Floats]:
    """Columns of a file of poses: their numbers, then the state by its features."""
    named = dict(zip(schema.names, chosen.states.T, strict=True))
    return {"pose": np.arange(1.0, len(chosen.rows) + 1), "row": chosen.rows + 1.0, **named}
