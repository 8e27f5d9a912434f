"""What an ONNX file of ours says of itself, checked: anyone can write and seal such a file."""

from __future__ import annotations

import json
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator

from measure.errors import EstimatorError
from measure.host.settings import explain_validation

FORMAT = 1
_MAX_MEMORY = 1_000_000


def contract(features: int, memory: int, period_s: float) -> str:
    """How any ONNX runtime runs a model, for its card and the file itself."""
    return (
        f"Inputs, float32: `features` (N, {features}), a raw state of each of N robots; `memory` "
        f"(N, {memory}), zeros when a trajectory begins, later the last `memory_out`; `tick` "
        f"(N, 1), 1 for the first state and for each at least {0.75 * period_s:g} s (0.75 x "
        f"`period_s`, {period_s:g} s) after the last with a 1, else 0. Outputs: `error_mm` (N, 3), "
        "to be added to the reported tip; `covariance` (N, 9), of that error, row by row, mm^2; "
        "`strangeness` (N, 1), above 1 or NaN for a state unlike the training; `memory_out` "
        f"(N, {memory}). Use one thread. Metadata, as JSON: `measure` (robot, features, units) and "
        "`card`."
    )


class _Facts(BaseModel):
    model_config = ConfigDict(strict=True, extra="allow")

    estimator: str
    settings: dict[str, Any]
    robot: str
    features: Annotated[list[tuple[str, str]], Field(min_length=1)]
    position_mm: list[tuple[FiniteFloat, FiniteFloat, FiniteFloat]]
    period_s: Annotated[FiniteFloat, Field(ge=0)]
    memory: Annotated[int, Field(ge=1, le=_MAX_MEMORY)]
    memoryless: bool
    offset_sd_mm: FiniteFloat = 0.5
    joint_sd: list[FiniteFloat] = []

    @model_validator(mode="after")
    def _one_row_a_feature(self) -> _Facts:
        if len(self.position_mm) != len(self.features):
            raise ValueError(
                f"position_mm has {len(self.position_mm)} rows for {len(self.features)} features"
            )
        return self


class _Part(BaseModel):
    model_config = ConfigDict(strict=True, extra="allow")

    rows: int
    trajectories: list[str]


class _Card(BaseModel):
    model_config = ConfigDict(strict=True, extra="allow")

    data: dict[str, _Part] = {}


def read_facts(text: str, where: str) -> dict[str, Any]:
    """The values of the metadata `measure` (see `measure.host.onnx_model`).

    Args:
        text: JSON.
        where: the file, for messages.

    Raises:
        EstimatorError: of another format, or a value is missing or of another type.
    """
    place = f"{where}: its metadata `measure`"
    facts = _table(text, place)
    if facts.get("format") != FORMAT:
        raise EstimatorError(
            f"{where}: of format {facts.get('format')!r:.20}, this version reads {FORMAT}: "
            "train it again"
        )
    _check(text, place, _Facts)
    return facts


def read_card(text: str, where: str) -> dict[str, Any]:
    """The values of the metadata `card`.

    Raises:
        EstimatorError: a value that is read back is of another type.
    """
    place = f"{where}: its metadata `card`"
    card = _table(text, place)
    _check(text, place, _Card)
    return card


def _table(text: str, place: str) -> dict[str, Any]:
    try:
        values = json.loads(text)
    except (ValueError, RecursionError):
        raise EstimatorError(f"{place} is no JSON that can be read: train it again") from None
    if not isinstance(values, dict):
        raise EstimatorError(f"{place} is no table: train it again")
    return values


def _check(text: str, place: str, model: type[BaseModel]) -> None:
    try:
        model.model_validate_json(text)
    except ValidationError as error:
        raise EstimatorError(f"{place}: {explain_validation(error, model)}") from None
