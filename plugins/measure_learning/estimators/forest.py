"""Seita et al. 2018: first a rigid transform, then a random forest on what is left."""

from __future__ import annotations

from typing import Any

import numpy as np

from measure import host
from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.geometry import align_points
from measure_learning import onnx
from measure_learning.estimators._inputs import WithinTrajectoryEstimator, informative_features


class ForestSettings(host.Settings):
    """Settings of `forest`."""

    trees: int = host.setting(60, "Number of trees.", ge=1)
    leaf_rows: int = host.setting(8, "Least number of rows in a leaf.", ge=1)
    depth: int = host.setting(14, "Largest depth of a tree, in levels.", ge=1)


class ForestEstimator(WithinTrajectoryEstimator):
    """Two phases (Seita 2018): a rigid transform of the position, then a random forest."""

    name = "forest"
    Config = ForestSettings
    config: ForestSettings
    memoryless = True

    def learn(
        self, data: host.Dataset, validation: host.Dataset, *, seed: int, report: host.Report
    ) -> None:
        """Align reported with measured positions, then grow trees on the residuals."""
        ensemble = host.needed("sklearn.ensemble", "train", "'forest'", EstimatorError)
        used = data.usable
        reported = data.reported_mm[used]
        measured = reported + data.errors_mm[used]
        self._schema_read = data.schema.reading_matrix(data.schema.position)
        rigid = align_points(reported, measured)
        self._turn, self._shift = rigid.rotation - np.eye(3), rigid.translation
        residual = measured - rigid.apply(reported)
        self._columns = informative_features(data)
        report(0.1, "aligned")
        grower = ensemble.RandomForestRegressor(
            self.config.trees,
            max_depth=self.config.depth,
            min_samples_leaf=self.config.leaf_rows,
            max_features=0.4,
            random_state=seed,
            n_jobs=1,
        )
        inputs = data.states[used][:, self._columns].astype(np.float32)
        grower.fit(inputs, residual, sample_weight=data.weights()[used])
        self._trees = _flatten(grower)
        report(1.0, "grown")

    def compute(
        self, graph: onnx.Graph, features: onnx.Value, memory: onnx.Value, tick: onnx.Value
    ) -> onnx.Core:
        """(rotation - 1) position + translation + forest."""
        position = graph.op("MatMul", features, self._schema_read)
        rigid = graph.affine(position, self._turn.T, self._shift)
        rest = graph.op(
            "TreeEnsembleRegressor",
            graph.columns(features, self._columns),
            domain="ai.onnx.ml",
            n_targets=3,
            aggregate_function="AVERAGE",
            post_transform="NONE",
            **self._trees,
        )
        return onnx.Core(graph.op("Add", rigid, rest))


def _flatten(forest: Any) -> dict[str, Any]:
    """scikit-learn's trees as the attributes of the operator."""
    trees = [_attributes(number, grown.tree_) for number, grown in enumerate(forest.estimators_)]
    return {key: np.concatenate([tree[key] for tree in trees]).tolist() for key in trees[0]}


def _attributes(number: int, tree: Any) -> dict[str, Any]:
    """Of one tree: nodes (n,), and three targets of each leaf."""
    inner = tree.children_left >= 0
    leaves = np.flatnonzero(~inner)
    return {
        "nodes_treeids": np.full(tree.node_count, number),
        "nodes_nodeids": np.arange(tree.node_count),
        "nodes_featureids": np.where(inner, tree.feature, 0),
        "nodes_values": np.where(inner, _below(tree.threshold), 0.0),
        "nodes_modes": np.where(inner, "BRANCH_LEQ", "LEAF"),
        "nodes_truenodeids": np.where(inner, tree.children_left, 0),
        "nodes_falsenodeids": np.where(inner, tree.children_right, 0),
        "target_treeids": np.full(3 * len(leaves), number),
        "target_nodeids": np.repeat(leaves, 3),
        "target_ids": np.tile(np.arange(3), len(leaves)),
        "target_weights": tree.value[leaves, :, 0].ravel(),
    }


def _below(thresholds: Floats) -> Floats:
    """Thresholds as float32 that split float32 inputs exactly as the float64 ones do."""
    rounded = thresholds.astype(np.float32)
    too_high = rounded.astype(np.float64) > thresholds
    down = np.nextafter(rounded, np.float32(-np.inf))
    return np.where(too_high, down, rounded).astype(np.float64)


@host.hookimpl
def measure_estimators() -> list[type[host.Estimator]]:
    """Register the estimator."""
    return [ForestEstimator]
