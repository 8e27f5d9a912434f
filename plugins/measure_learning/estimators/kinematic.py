"""Calibrated links: the right answer for a stiff arm, whose errors are those of its description.

The errors of all links, of the base and of the tip are fitted to the labels, and the correction is
the difference between the tips of the calibrated and of the nominal chain.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from measure import host
from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.geometry import RigidTransform
from measure.robots import SerialChain
from measure_learning import onnx
from measure_learning.estimators._inputs import WithinTrajectoryEstimator
from measure_learning.onnx.kinematics import chain_change
from measure_learning.onnx.rotation import LEVER_MM, TurnChain, turn_errors
from measure_learning.robots.links import (
    TURNS,
    LinkEffects,
    link_jacobian,
    link_names,
    usual_sd,
    with_link_errors,
)

_STEPS = 6
_TIP = ("tip_x_mm", "tip_y_mm", "tip_z_mm")


class KinematicSettings(host.Settings):
    """Settings of `kinematic`."""

    unseen: float = host.setting(
        0.7, "Share of its prior SD that a parameter keeps if it is called not identifiable.", gt=0
    )


class KinematicEstimator(WithinTrajectoryEstimator):
    """Errors of the robot's links, fitted as random effects, and of its tip; for stiff arms.

    Its card lists every parameter with its standard deviation, and which are not identifiable.
    """

    name = "kinematic"
    Config = KinematicSettings
    config: KinematicSettings
    memoryless = True

    def learn(
        self, data: host.Dataset, validation: host.Dataset, *, seed: int, report: host.Report
    ) -> None:
        """Gauss-Newton on links and tip, with the links' standard deviations estimated."""
        self._data_schema, chain = data.schema, data.schema.chain
        if chain is None:
            raise EstimatorError(
                f"'kinematic' needs the robot's kinematics, and those of {data.schema.robot} are "
                "not known: describe its joints with alpha_deg in robot.toml, or give a .urdf"
            )
        used, size, turns = data.usable, 6 * chain.size, isinstance(chain, TurnChain)
        if (least := 2 * (3 + size) // 3) > used.sum():
            raise EstimatorError(
                f"'kinematic' fits {3 + size} numbers to {used.sum()} labels: at least {least} are "
                "needed, better a minute of motion"
            )
        q, labels, P = data.joints[used], data.errors_mm[used], data.covariances[used]
        roots = np.linalg.cholesky(P)
        x = np.zeros(3 + size)
        found = LinkEffects(x, x, usual_sd(size), 1.0)
        for step in range(_STEPS):
            bent = _bent(chain, x)
            by_links = link_jacobian(bent, q)
            by_links = LEVER_MM * by_links[:, 3:] if turns else by_links[:, :3]
            tip = bent.pose(q).rotation @ bent.tool[:3, :3].T
            slopes = np.concatenate([LEVER_MM * tip if turns else tip, by_links], axis=2)
            left = labels - _difference(bent, chain, q)
            S = np.linalg.solve(roots, slopes).reshape(-1, len(x))
            r = np.linalg.solve(roots, left[..., None]).ravel()
            normal = S.T @ S, S.T @ r, float(r @ r), len(r)
            found = found.solved(normal, np.zeros(3), x[3:])
            x = x + found.step
            report((step + 1) / _STEPS, f"links fitted: {np.sqrt((left**2).sum(1).mean()):.3f} mm")
        self._chain = _bent(chain, x)
        self.findings = self._said(chain, x, found)

    def compute(
        self, graph: onnx.Graph, features: onnx.Value, memory: onnx.Value, tick: onnx.Value
    ) -> onnx.Core:
        """Tip of the calibrated chain minus that of the nominal one."""
        return onnx.Core(chain_change(graph, self._data_schema, features, self._chain))

    def _said(self, chain: SerialChain, x: Floats, found: LinkEffects) -> tuple[str, ...]:
        scale = np.where(np.resize(TURNS, len(x) - 3), np.degrees(1.0), 1.0)
        values, sd = x * [1, 1, 1, *scale], np.sqrt(np.diag(found.covariance)) * [1, 1, 1, *scale]
        names = [*_TIP, *link_names(chain)]
        unseen = [False] * 3 + list(sd[3:] > self.config.unseen * found.link_sd * scale)
        lines = [
            f"{name}: {value:+.4f}, SD {error:.4f}" + (", not identifiable" if hidden else "")
            for name, value, error, hidden in zip(names, values, sd, unseen, strict=True)
        ]
        return ("Errors of tip and links, in the frame of the joint that follows:", *lines)


def _difference(bent: SerialChain, chain: SerialChain, q: Floats) -> Floats:
    """What labels (n, 3) of a bent chain would be."""
    if isinstance(chain, TurnChain):
        return LEVER_MM * turn_errors(bent.pose(q).rotation, chain.pose(q).rotation)
    return bent.tip_mm(q) - chain.tip_mm(q)


def _bent(chain: SerialChain, x: Floats) -> SerialChain:
    """The chain with its tip off by x[:3] in the last joint's frame, and its links by the rest.

    The tip of a `TurnChain` is off by a rotation.
    """
    tool = chain.tool.copy()
    if isinstance(chain, TurnChain):
        tool[:3, :3] = RigidTransform.from_rotvec(x[:3]).rotation @ tool[:3, :3]
    else:
        tool[:3, 3] += x[:3]
    return replace(with_link_errors(chain, x[3:]), tool=tool)


@host.hookimpl
def measure_estimators() -> list[type[host.Estimator]]:
    """Register the estimator."""
    return [KinematicEstimator]
