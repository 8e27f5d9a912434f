"""Running a saved estimator: one ONNX file that holds normalisation, features, nets and state.

`contract` states what goes in and comes out. Metadata, as JSON: `measure` and
`card`; last a checksum, as `measure_learning.onnx.seal` appends it. `measure` holds:

- `format`: 1; `estimator`: its name; `settings`: as they were;
- `robot`: its name; `features`: [name, unit] of each, in order;
- `schema`: `StateSchema.to_dict`, with the joints and how logs name them;
- `position_mm`: a matrix (F, 3): a state times it is the reported position;
- `period_s`: of the states learnt from; `memory`: S, at least 1; `memoryless`: whether the memory
  may be left at zeros;
- optional: `joint_sd`: SDs in training of the joints (else of the position); `offset_sd_mm`: per
  axis, of the mean errors that a fit leaves of recordings it has not seen; `range`: of each
  feature, the least and largest value in training, in its unit; `largest_mm`: the length of the
  largest label, which no correction exceeds; `gap_mm`: how far the reported tip may be from that
  of the joints, null where the robot's chain is not known. Older files have no such bounds.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator

from measure.arrays import Bools, Floats, floats
from measure.errors import EstimatorError
from measure.host.dataset import Dataset, Turns
from measure.host.interfaces import Correction
from measure.host.settings import explain_validation
from measure.reading import read_bytes
from measure.robots import StateSchema
from measure_learning.onnx.graph import is_intact

FORMAT = 1
_MAX_MEMORY = 1_000_000


def contract(features: int, memory: int, period_s: float, *, turns: bool = False) -> str:
    """How any ONNX runtime runs a model, for its card and the file itself."""
    said = (
        " `turn_rad` (N, 3), a rotation vector in the base frame, rad, to be applied after the "
        "reported rotation; `turn_covariance` (N, 9), of that, rad^2."
        if turns
        else ""
    )
    return (
        f"Inputs, float32: `features` (N, {features}), a raw state of each of N robots; `memory` "
        f"(N, {memory}), zeros when a trajectory begins, later the last `memory_out`; `tick` "
        f"(N, 1), 1 for the first state and for each at least {0.75 * period_s:g} s (0.75 x "
        f"`period_s`, {period_s:g} s) after the last with a 1, else 0. Outputs: `error_mm` (N, 3), "
        "to be added to the reported tip; `covariance` (N, 9), of that error, row by row, mm^2; "
        "`strangeness` (N, 1), above 1 or NaN for a state unlike the training; `contradiction` "
        "(N, 1), above 1 or NaN for a state whose joints and tip disagree, which is not corrected "
        f"and leaves the memory as it is; `memory_out` (N, {memory}).{said} Use one thread. "
        "Metadata, as JSON: `measure` (robot, features, units, ranges in training) and `card`."
    )


class _Metadata(BaseModel):
    model_config = ConfigDict(strict=True, extra="allow")


class _Facts(_Metadata):
    estimator: str
    settings: dict[str, Any]
    robot: str
    features: Annotated[list[tuple[str, str]], Field(min_length=1)]
    position_mm: list[tuple[FiniteFloat, FiniteFloat, FiniteFloat]]
    period_s: Annotated[FiniteFloat, Field(ge=0)]
    memory: Annotated[int, Field(ge=1, le=_MAX_MEMORY)]
    memoryless: bool
    range: list[tuple[FiniteFloat, FiniteFloat]] | None = None
    largest_mm: Annotated[FiniteFloat, Field(ge=0)] | None = None
    gap_mm: Annotated[FiniteFloat, Field(gt=0)] | None = None
    offset_sd_mm: FiniteFloat = 0.5
    joint_sd: list[FiniteFloat] = []

    @model_validator(mode="after")
    def _one_row_a_feature(self) -> _Facts:
        for name, rows in (("position_mm", self.position_mm), ("range", self.range)):
            if rows is not None and len(rows) != len(self.features):
                raise ValueError(f"{name} has {len(rows)} rows for {len(self.features)} features")
        return self


class _OfChain(_Metadata):
    rows: int
    trajectories: list[str]


class _Card(_Metadata):
    data: dict[str, _OfChain] = {}


_MODELS: dict[str, type[_Metadata]] = {"measure": _Facts, "card": _Card}


def read_metadata(key: str, text: str, where: str) -> dict[str, Any]:
    """The values of the metadata `measure` or `card` of a file, by their JSON.

    EstimatorError: of another format, or a value is missing or of another type.
    """
    place = f"{where}: its metadata `{key}`"
    try:
        values = json.loads(text)
    except (ValueError, RecursionError):
        raise EstimatorError(f"{place} is no JSON that can be read: train it again") from None
    if not isinstance(values, dict):
        raise EstimatorError(f"{place} is no table: train it again")
    if key == "measure" and values.get("format") != FORMAT:
        raise EstimatorError(
            f"{where}: of format {values.get('format')!r:.20}, this version reads {FORMAT}: "
            "train it again"
        )
    try:
        _MODELS[key].model_validate_json(text)
    except ValidationError as error:
        raise EstimatorError(f"{place}: {explain_validation(error, _MODELS[key])}") from None
    return values


_MAX_BYTES = 256 << 20
_WIDTHS = {"error_mm": 3, "covariance": 9, "strangeness": 1, "memory_out": 0}  # 0: the memory's
_OPTIONAL = {"contradiction": 1, "turn_rad": 3, "turn_covariance": 9}
_TICKS = (np.zeros((1, 1), dtype=np.float32), np.ones((1, 1), dtype=np.float32))


@dataclass(frozen=True, eq=False)
class Estimates:
    """Corrections of n states."""

    errors_mm: Floats  # (n, 3) measured minus reported position
    covariances: Floats  # (n, 3, 3) of the errors, in mm^2
    strangeness: Floats  # (n,) above 1 where the state is unlike the training data
    contradiction: Floats  # (n,) above 1 where joints and tip disagree, which is not corrected
    turns: Turns | None = None  # (n,) of the tip's rotation, where that was learnt


@dataclass(frozen=True, eq=False)
class Corrections:
    """Of the states of one trajectory; `error, covariance = ...` takes it apart."""

    error: Floats  # (n, 3) mm, to be added to the reported tip
    covariance: Floats  # (n, 3, 3) of that, mm^2
    unfamiliar: Bools  # (n,) unlike the training: do not rely on the error
    contradictory: Bools  # (n,) tip and joints disagree, or no number: the error is zero

    def __iter__(self) -> Iterator[Floats]:
        return iter((self.error, self.covariance))


def _schema(facts: dict[str, Any], where: str) -> StateSchema:
    """What the features of a model mean, with the joints and how logs name them."""
    with suppress(KeyError, TypeError, ValueError, AttributeError):
        schema = StateSchema.from_dict(facts["schema"])
        if schema.names == tuple(name for name, _ in facts["features"]):
            return schema
    raise EstimatorError(f"{where}: its metadata hold no schema that can be read: train it again")


class OnnxModel:
    """A saved estimator in an onnxruntime session with one thread.

    Attributes:
        features: names of the numbers of a state, in order.
        schema: their units, and how position and joints are read from them.
        facts: the file's metadata `measure`.
    """

    def __init__(self, content: bytes, where: str = "model") -> None:
        import onnxruntime as ort

        options = ort.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 4
        try:
            self._session = ort.InferenceSession(
                content, sess_options=options, providers=["CPUExecutionProvider"]
            )
            texts = self._session.get_modelmeta().custom_metadata_map
        except Exception as error:  # onnxruntime has no common error class
            reason = str(error).strip().splitlines()[0]
            raise EstimatorError(f"{where}: not a usable ONNX file: {reason}") from None
        if "measure" not in texts:
            raise EstimatorError(f"{where}: an ONNX file, but not one `measure train` wrote")
        if not is_intact(content):
            raise EstimatorError(
                f"{where}: damaged, its checksum does not match: copy it again, or train it again"
            )
        self.facts = read_metadata("measure", texts["measure"], where)
        self.card = read_metadata("card", texts.get("card", "{}"), where)
        there = [one.name for one in self._session.get_outputs()]
        self.turns = "turn_rad" in there
        self._widths = _WIDTHS | {name: _OPTIONAL[name] for name in there if name in _OPTIONAL}
        self._check_tensors(where)
        self.where = where
        self.schema = _schema(self.facts, where)
        self.features, self.robot = self.schema.names, self.schema.robot
        self.period_s = float(self.facts["period_s"])
        self.memory_size = int(self.facts["memory"])
        self.reset()

    def _check_tensors(self, where: str) -> None:
        """Refuse a graph whose inputs and outputs are not those that its metadata promise."""
        memory = self.facts["memory"]
        inputs = {"features": len(self.facts["features"]), "memory": memory, "tick": 1}
        outputs = {name: width or memory for name, width in self._widths.items()}
        for wanted, there in (
            (inputs, self._session.get_inputs()),
            (outputs, self._session.get_outputs()),
        ):
            widths = {one.name: one.shape[-1] for one in there if len(one.shape) == 2}
            if widths != wanted or any(one.type != "tensor(float)" for one in there):
                raise EstimatorError(
                    f"{where}: its tensors are not those that its metadata name "
                    f"({', '.join(f'{name} of {width}' for name, width in wanted.items())}): "
                    "train it again"
                )

    @classmethod
    def load(cls, path: Path) -> OnnxModel:
        """Read a file; EstimatorError: missing, corrupted, or not one of ours."""
        return cls(read_bytes(path, EstimatorError, _MAX_BYTES), str(path))

    def check(self, schema: StateSchema) -> None:
        """Refuse another robot's states; EstimatorError: the robot or the features differ."""
        if schema.robot != self.robot:
            raise EstimatorError(
                f"{self.where}: trained for robot '{self.robot}', not '{schema.robot}': "
                "train one for this robot"
            )
        if schema.names != self.features:
            missing = sorted(set(self.features) - set(schema.names))
            lacks = ", ".join(missing[:12]) or "none, but the order differs"
            raise EstimatorError(
                f"{self.where}: expects {len(self.features)} features, the data have "
                f"{len(schema.names)}; missing: {lacks}"
            )
        if not schema.means(self.schema):
            raise EstimatorError(
                f"{self.where}: learnt with another description of robot '{self.robot}', of other "
                "units, joints or kinematics: use the same"
            )

    def another(self) -> OnnxModel:
        """The same network with a history of its own, which begins here."""
        twin = copy.copy(self)
        twin.reset()
        return twin

    def reset(self) -> None:
        """Forget all history."""
        self._memory = np.zeros((1, self.memory_size), dtype=np.float32)
        self._ticked_s = -np.inf

    def update(self, state: Floats, time_s: float) -> Correction:
        """The next state of the running trajectory.

        A model whose memory has a clock (`period_s`) advances it no more often than in training.
        EstimatorError: the state has another number of features.
        """
        due = bool(not time_s - self._ticked_s < 0.75 * self.period_s)  # a NaN stamp is due
        if due:
            self._ticked_s = time_s
        row = np.asarray(state, dtype=np.float32)[None]
        if row.shape != (1, len(self.features)):
            raise EstimatorError(
                f"{self.where}: a state has {len(self.features)} features, got {row[0].shape}"
            )
        found, self._memory = self.step(row, self._memory, _TICKS[due])
        familiar = bool(found.strangeness[0] <= 1.0)  # NaN is unfamiliar too
        contradictory = not found.contradiction[0] <= 1.0
        turn = found.turns and found.turns[0]
        return Correction(
            found.errors_mm[0], found.covariances[0], not familiar, turn, contradictory
        )

    def step(self, states: Any, memory: Any, tick: Any) -> tuple[Estimates, Any]:
        """One step of N independent trajectories."""
        names = list(self._widths)
        made = self._session.run(names, {"features": states, "memory": memory, "tick": tick})
        out = dict(zip(names, made, strict=True))
        after = out.pop("memory_out")
        numbers = {name: values.astype(np.float64) for name, values in out.items()}
        strangeness = numbers["strangeness"][:, 0]
        gap = numbers.get("contradiction")
        turns = None
        if self.turns:
            spread = numbers["turn_covariance"].reshape(-1, 3, 3)
            turns = Turns(numbers["turn_rad"], spread)
        found = Estimates(
            numbers["error_mm"],
            numbers["covariance"].reshape(-1, 3, 3),
            strangeness,
            np.zeros_like(strangeness) if gap is None else gap[:, 0],
            turns,
        )
        return found, after

    def predict(self, data: Dataset) -> Estimates:
        """Corrections of all rows, every trajectory from a fresh start, as `update` gives them."""
        self.check(data.schema)
        count = len(data)
        turns = Turns.unknown(count) if self.turns else None
        errors, covariances = np.empty((count, 3)), np.empty((count, 3, 3))
        out = Estimates(errors, covariances, np.empty(count), np.empty(count), turns)
        if self.facts["memoryless"]:
            for start in range(0, count, 4096):
                rows = np.arange(start, min(start + 4096, count))
                memory = np.zeros((len(rows), self.memory_size), dtype=np.float32)
                self._fill(out, data, rows, memory, np.ones(len(rows), dtype=bool))
        else:
            self._predict_runs(out, data)
        return out

    def correct(self, states: ArrayLike, times_s: ArrayLike | None = None) -> Corrections:
        """Corrections of states (n, features), one trajectory in time order, from its start.

        Args:
            states: numbers in the order of `features`.
            times_s: stamps (n,), increasing; without them the states come as often as in training.
        """
        given = floats("states", states, "n", len(self.features))
        count = len(given)
        times = np.full(count, np.nan) if times_s is None else floats("times_s", times_s, count)
        unknown = np.full((count, 3), np.nan)
        none, rows = np.zeros(count, dtype=bool), np.zeros(count, dtype=np.int64)
        spread = np.tile(np.eye(3), (count, 1, 1))
        data = Dataset(self.schema, given, times, rows, ("states",), unknown, spread, none)
        found = self.predict(data)
        flags = (~(one <= 1.0) for one in (found.strangeness, found.contradiction))
        return Corrections(found.errors_mm, found.covariances, *flags)

    def _fill(self, out: Estimates, data: Dataset, rows: Any, memory: Any, tick: Any) -> Any:
        """Fill in the corrections of rows, each of another trajectory; returns their memory."""
        states = data.states[rows].astype(np.float32)
        part, memory = self.step(states, memory, tick[:, None].astype(np.float32))
        out.errors_mm[rows], out.covariances[rows] = part.errors_mm, part.covariances
        out.strangeness[rows], out.contradiction[rows] = part.strangeness, part.contradiction
        if out.turns is not None and part.turns is not None:
            out.turns[rows] = part.turns
        return memory

    def _predict_runs(self, out: Estimates, data: Dataset) -> None:
        """All trajectories side by side, the longest first, dropping each at its end."""
        runs = sorted((rows for _, rows in data.runs()), key=lambda r: r.start - r.stop)
        starts = np.array([rows.start for rows in runs])
        lengths = np.array([rows.stop - rows.start for rows in runs])
        memory = np.zeros((len(runs), self.memory_size), dtype=np.float32)
        ticked = np.full(len(runs), -np.inf)
        for index in range(int(lengths.max(initial=0))):
            alive = int(np.sum(lengths > index))
            rows = starts[:alive] + index
            times = data.times_s[rows]
            due = ~(times - ticked[:alive] < 0.75 * self.period_s)
            ticked[:alive] = np.where(due, times, ticked[:alive])
            memory = self._fill(out, data, rows, memory[:alive], due)
