from __future__ import annotations

import numpy as np
import pytest

from measure.estimation.rig_model import RigProblem, RigState, Views
from measure.geometry import RigidTransform
from tests.calibration.rigs import cameras


@pytest.mark.parametrize("own_poses", [True, False])
def test_residuals_follow_each_block_as_linearised(own_poses: bool) -> None:
    rng = np.random.default_rng(0)
    values = {"points": rng.normal(0, 20, (3, 3)), "clock cam1": np.zeros(1)}
    values |= {f"offsets cam{k}": rng.normal(0, 0.1, (3, 2)) for k in range(2)}
    turns, rates = rng.normal(0, 0.5, (4, 3)), rng.normal(0, 100, (4, 3, 3))
    poses = RigidTransform.from_rotvec(turns, turns * 40 + [0, 0, 250])
    pose, point = np.divmod(np.arange(12), 3)
    seen = (pose, point, rng.normal(500, 200, (12, 2)), rng.normal(0, 1, (12, 2, 2)), point)
    views = [Views(k, *seen, lead_s=rng.normal(0, 0.01, 12)) for k in range(2)]
    free = {"camera cam0": np.array([0, 2, 4, 6, 9, 11]), "camera cam1": np.arange(18)}
    free |= {name: np.arange(value.size) for name, value in values.items()}
    free |= {} if own_poses else {"poses": np.arange(5, 20)}
    problem = RigProblem(
        RigState(cameras()[:2], poses, values), views, free, {}, own_poses,
        lambda frame, k, lead_s: (rates[frame, k] * lead_s[:, None], rates[frame, k]),
    )  # fmt: skip
    groups = problem.linearise(problem.start).groups
    by_block = {
        name: [g.by_block.get(name, np.zeros((12, 2, len(at)))) for g in groups]
        for name, at in free.items()
    }
    for name, by in [
        *by_block.items(),
        *[("instants", [g.by_instant for g in groups])] * own_poses,
    ]:
        for k, step in enumerate(1e-6 * np.eye(by[0].shape[2])):
            own = step if name == "instants" else np.zeros(6)
            before, after = (
                problem.linearise(problem.step(problem.start, {name: s * step}, s * own)).residuals
                for s in (-1, 1)
            )
            analytic = np.ravel([one[..., k] for one in by])
            np.testing.assert_allclose(
                (before - after) / 2e-6, analytic, atol=1e-6 + 1e-4 * np.abs(analytic).max()
            )
