"""An ONNX file that says of itself what cannot be is refused in one line, whoever sealed it."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest

from measure.errors import EstimatorError
from measure_learning.api import shipped_model
from measure_learning.onnx import OnnxModel
from measure_learning.onnx.graph import seal
from measure_learning.onnx.model import read_metadata

FACTS = OnnxModel.load(shipped_model()).facts


def put(name: str, value: object) -> Callable[[dict[str, Any]], object]:
    return lambda facts: facts.__setitem__(name, value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (put("format", 2), "x: of format 2, this version reads 1"),
        (put("format", [1]), "x: of format \\[1\\]"),
        (put("memory", "many"), "'memory': input should be a valid integer"),
        (put("memory", 10**30), "'memory': "),
        (put("memory", 0), "'memory': input should be greater than or equal to 1"),
        (put("period_s", -1.0), "'period_s': "),
        (put("period_s", None), "'period_s': input should be a valid number"),
        (put("features", []), "'features': list should have at least 1 item"),
        (put("features", [["a"]]), "'features.0.1': field required"),
        (put("features", 7), "'features': "),
        (put("position_mm", [[0.0, 0.0, 0.0]]), "position_mm has 1 rows for 118 features"),
        (put("position_mm", {"a": 1}), "'position_mm': "),
        (put("range", [[0.0, 1.0]]), "range has 1 rows for 118 features"),
        (put("gap_mm", 0.0), "'gap_mm': "),
        (put("settings", "none"), "'settings': "),
        (put("robot", 3), "'robot': input should be a valid string"),
        (put("memoryless", "no"), "'memoryless': input should be a valid boolean"),
        (lambda facts: facts.pop("robot"), "'robot': field required"),
    ],
)
def test_facts_of_wrong_types(change: Callable[[dict[str, Any]], object], words: str) -> None:
    facts = dict(FACTS)
    change(facts)
    with pytest.raises(EstimatorError, match=words) as caught:
        read_metadata("measure", json.dumps(facts), "x")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "[" * 100_000, "9" * 5_000, "[]", "1", "null"])
def test_metadata_that_are_no_table(text: str) -> None:
    for key in ("measure", "card"):
        with pytest.raises(EstimatorError, match=r"x: its metadata `.*` is no "):
            read_metadata(key, text, "x")


@pytest.mark.parametrize("part", [3, {"rows": "all", "trajectories": []}, {"rows": 1}])
def test_a_card_of_wrong_types(part: object) -> None:
    with pytest.raises(EstimatorError, match=r"x: its metadata `card`: 'data\.test"):
        read_metadata("card", json.dumps({"data": {"test": part}}), "x")


def test_a_graph_of_other_tensors_than_it_says() -> None:
    onnx = pytest.importorskip("onnx")
    model = onnx.load_from_string(shipped_model().read_bytes())
    kept = {one.key: one.value for one in model.metadata_props if one.key != "sha256"}
    onnx.helper.set_model_props(model, kept)
    assert OnnxModel(seal(model.SerializeToString())).memory_size == FACTS["memory"]
    kept["measure"] = json.dumps({**FACTS, "memory": FACTS["memory"] + 1})
    onnx.helper.set_model_props(model, kept)
    with pytest.raises(EstimatorError, match="its tensors are not those that its metadata name"):
        OnnxModel(seal(model.SerializeToString()))
